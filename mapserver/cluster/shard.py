"""A shard: the place index of some of the fleet's maps, in a process of its own.

It holds nothing that the server's record has not. A shard that was started again is empty, and says so by
another `incarnation`; the server then fills it again.
"""

from __future__ import annotations

import pickle
import secrets
from collections.abc import Collection, Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import MapweaveError
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.mapserver.retrieval.place_index import PlaceIndex
from mapweave.mapserver.retrieval.ranking import NearestLandmarks


class OutOfDate(MapweaveError):
    """A shard lacks changes that it should have."""


class State(NamedTuple):
    """What a shard has.

    Attributes:
        incarnation: random, drawn when it began to be filled.
        number: of the last change it has, without gaps from 1 on.
    """

    incarnation: str
    number: int


class Shard:
    """A share of the place index. One thread changes it; any may ask."""

    def __init__(self) -> None:
        """Begin empty."""
        self._index = PlaceIndex()
        self._nodes: dict[NodeId, Node] = {}

    def change(self, nodes: Iterable[Node], gone: Collection[NodeId] = ()) -> None:
        """Put nodes, or replace them, and forget others."""
        for node_id in gone:
            node = self._nodes.pop(node_id, None)
            self._index.remove(node_id, None if node is None else node.landmarks.codes)
        nodes = list(nodes)
        self._nodes.update((node.id, node) for node in nodes)
        self._index.extend(nodes)

    def nearest(self, codes: NDArray[np.uint8]) -> NearestLandmarks:
        """The nearest landmarks of features; see `PlaceIndex.nearest`."""
        return self._index.nearest(codes)

    def overlaps(self, node: Node) -> dict[NodeId, float]:
        """Which nodes of this shard overlap with a node; see `PlaceIndex.overlaps`."""
        return self._index.overlaps(node, self._nodes.get)


class ShardServer:
    """A shard that is asked by messages, whose order it checks: a message may be lost, or the process."""

    def __init__(self) -> None:
        """Begin empty."""
        self._reset()

    def call(self, request: bytes) -> bytes:
        """Answer a request made by one of the functions below.

        Raises:
            OutOfDate: it lacks what the asker knows to have sent.
        """
        method, arguments = pickle.loads(request)
        return pickle.dumps(getattr(self, f"_{method}")(*arguments))

    def _hello(self) -> State:
        return self._state

    def _reset(self) -> State:
        self._shard, self._state = Shard(), State(secrets.token_hex(8), 0)
        return self._state

    def _change(self, state: State, nodes: list[Node], gone: list[NodeId]) -> State:
        if state != (self._state.incarnation, self._state.number + 1):
            raise OutOfDate(f"has {self._state}, and not what comes before {state}")
        self._shard.change(nodes, gone)
        self._state = state
        return state

    def _ask(self, state: State, question: bytes) -> Any:
        if state.incarnation != self._state.incarnation or state.number > self._state.number:
            raise OutOfDate(f"has {self._state}, and not {state}")
        method, *arguments = pickle.loads(question)
        return getattr(self._shard, method)(*arguments)


HELLO = pickle.dumps(("hello", ()))
"""Asks for the state."""
RESET = pickle.dumps(("reset", ()))
"""Asks to forget everything; the answer is the new state."""


def change_request(state: State, nodes: list[Node], gone: list[NodeId]) -> bytes:
    """Change a shard; `state` is that which follows."""
    return pickle.dumps(("change", (state, nodes, gone)))


def question_of(method: str, *arguments: Any) -> bytes:
    """A question to any shard: the name of a method of `Shard`, and what it is called with."""
    return pickle.dumps((method, *arguments))


def ask_request(state: State, question: bytes) -> bytes:
    """Ask a shard that must have come at least to a state."""
    return pickle.dumps(("ask", (state, question)))

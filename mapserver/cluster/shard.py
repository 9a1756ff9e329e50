"""A shard: the place index of some of the fleet's maps, in a process of its own.

It holds nothing that the server's record has not. A shard that was started again is empty, and says so by
another `incarnation`; the server then fills it again.
"""

import secrets
from collections.abc import Collection, Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import MapweaveError
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.mapserver.cluster.messages import (
    Answer,
    Ask,
    Nearest,
    NearestAnswer,
    OverlapsAnswer,
    Question,
    Reset,
    ShardChange,
    ShardRequest,
    State,
    answer_message,
    decoded,
    encoded,
)
from mapweave.mapserver.retrieval.place_index import PlaceIndex
from mapweave.mapserver.retrieval.ranking import NearestLandmarks


class OutOfDate(MapweaveError):
    """A shard lacks changes that it should have."""


class Shard:
    """A share of the place index. One thread changes it; any may ask."""

    def __init__(self) -> None:
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

    def nearest(self, codes: NDArray[np.uint8], count: int, wanted: int) -> NearestLandmarks:
        """The nearest landmarks of features; see `PlaceIndex.nearest`."""
        return self._index.nearest(codes, count, wanted)

    def overlaps(self, node: Node) -> dict[NodeId, float]:
        """Which nodes of this shard overlap with a node; see `PlaceIndex.overlaps`."""
        return self._index.overlaps(node, self._nodes.get)

    def answer(self, question: Question) -> Answer:
        """The answer to a question."""
        if isinstance(question, Nearest):
            return self.nearest(question.codes, question.count, question.wanted)
        return self.overlaps(*question.nodes.nodes)


class ShardServer:
    """A shard that is asked by messages, whose order it checks: a message may be lost, or the process."""

    def __init__(self) -> None:
        self._reset()

    def call(self, request: bytes) -> bytes:
        """Answer a request, see mapweave.mapserver.cluster.messages.

        Raises:
            InvalidMessage: it is none.
            OutOfDate: it lacks what the asker knows to have sent.
        """
        return encoded(self._answer(decoded(request, ShardRequest)))

    def _answer(self, request: ShardRequest) -> Any:
        match request:
            case Reset():
                self._reset()
            case ShardChange():
                self._change(request)
            case Ask():
                return self._ask(request)
        return self._state

    def _reset(self) -> None:
        self._shard, self._state = Shard(), State(secrets.token_hex(8), 0)

    def _change(self, change: ShardChange) -> None:
        if change.state != replace(self._state, number=self._state.number + 1):
            raise OutOfDate(f"has {self._state}, and not what comes before {change.state}")
        self._shard.change(change.nodes.nodes, change.gone.nodes)
        self._state = change.state

    def _ask(self, ask: Ask) -> NearestAnswer | OverlapsAnswer:
        if ask.state.incarnation != self._state.incarnation or ask.state.number > self._state.number:
            raise OutOfDate(f"has {self._state}, and not {ask.state}")
        return answer_message(self._shard.answer(decoded(ask.question, Question)))

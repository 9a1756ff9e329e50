"""The place index in several shards: asked at once, answered as one.

The nearest landmarks of a feature are the nearest of each shard's nearest. As long as every landmark is
compared, votes, and with them the candidates of a view, are those of one index of all nodes. In cells each
shard searches as many as an index of its share alone. Overlaps of two nodes depend on these two alone.
"""

import time
import zlib
from collections.abc import Collection, Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.query import View
from mapweave.mapserver.cluster.messages import (
    MOST_NEAREST,
    ComparedNodes,
    Nearest,
    Overlaps,
    Question,
    encoded,
)
from mapweave.mapserver.cluster.shard_link import ShardLink
from mapweave.mapserver.retrieval.place_database import NodeOf
from mapweave.mapserver.retrieval.place_index import PlaceIndexSettings
from mapweave.mapserver.retrieval.ranking import IncompleteSearch, NearestLandmarks, Ranked
from mapweave.mapserver.retrieval.wanted_landmarks import nearest_wanted


class ShardedIndex:
    """Shards as if they were one PlaceIndex; see mapweave.mapserver.retrieval.place_database.NodeIndex."""

    def __init__(self, links: Sequence[ShardLink]) -> None:
        """Take the shards; they are started and closed with this."""
        self._links = tuple(links)
        self._votes = PlaceIndexSettings().votes

    def start(self) -> None:
        """Begin to fill the shards."""
        for link in self._links:
            link.start()

    def close(self) -> None:
        """Stop. Idempotent."""
        for link in self._links:
            link.close()

    def __len__(self) -> int:
        return sum(map(len, self._links))

    def __contains__(self, node_id: NodeId) -> bool:
        return node_id in self._of(node_id.map)

    @property
    def status(self) -> str:
        """The state for people, for example `4 of 4 shards`."""
        current = sum(link.current for link in self._links)
        words = f"{current} of {len(self._links)} shards"
        helped = sum(link.answers and not link.current for link in self._links)
        return f"{words}; {helped} in this process" if helped else words

    def announce(self, node: Node) -> None:
        """Add a node, or replace it; any thread may do so."""
        self.add(node)

    def add(self, node: Node) -> None:
        """Add a node, or replace it."""
        self._of(node.id.map).change([node])

    def extend(self, nodes: Iterable[Node]) -> None:
        """Add nodes, or replace them."""
        parts: dict[int, list[Node]] = {}
        for node in nodes:
            parts.setdefault(self._number(node.id.map), []).append(node)
        for number, part in parts.items():
            self._links[number].change(part)

    def remove(self, node_id: NodeId, codes: NDArray[np.uint8] | None = None) -> None:
        """Forget a node. One that is not there is no error; the shard knows its descriptors."""
        self._of(node_id.map).change((), [node_id])

    def query(self, view: View, k: int = 5, exclude: Collection[NodeId] = ()) -> Ranked:
        """Rank nodes by their similarity to a view; says what could not be searched in time."""
        unwanted, answering = frozenset(exclude), self._links
        numbers: dict[NodeId, int] = {}

        def search(features: NDArray[np.int64], count: int) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
            nonlocal answering
            codes = view.codes[features]
            parts, silent = self._asked(
                [(link, Nearest(codes, count, link.wanted(unwanted))) for link in answering]
            )
            answering = tuple(link for link in answering if link not in silent)
            nothing = NearestLandmarks.none(len(features), count)
            nearest = NearestLandmarks.together([*parts, nothing], count)
            own = [numbers.setdefault(node, len(numbers)) for node in nearest.nodes]
            return nearest.squared, np.array([*own, -1])[nearest.owners]

        def hidden(found: NDArray[np.int64]) -> NDArray[np.bool_]:
            return np.array([*(node in unwanted for node in numbers), False])[found]

        if unwanted:
            squared, owners = nearest_wanted(search, len(view), self._votes, hidden, MOST_NEAREST)
        else:
            squared, owners = search(np.arange(len(view)), self._votes)
        silent = len(self._links) - len(answering)
        missing = f"{silent} of {len(self._links)} shards of the map did not answer" if silent else ""
        return Ranked(NearestLandmarks(squared, owners, tuple(numbers)).ranked(k), missing)

    def overlaps(self, node: Node, node_of: NodeOf) -> dict[NodeId, float]:
        """Overlaps of a node with all others; waits for a shard that does not answer, or its stand-in.

        Args:
            node: itself need not be here.
            node_of: not needed: a shard has its nodes.

        Raises:
            IncompleteSearch: this is closed.
        """
        question, left = Overlaps(ComparedNodes.of([node])), self._links
        overlaps_by_node: dict[NodeId, float] = {}
        while left:
            parts, left = self._asked([(link, question) for link in left])
            for part in parts:
                overlaps_by_node |= part
            for link in left:
                if not link.wait():
                    raise IncompleteSearch("the server ends")
        overlaps_by_node.pop(node.id, None)
        return overlaps_by_node

    def _asked(
        self, questions: Sequence[tuple[ShardLink, Question]]
    ) -> tuple[list[Any], tuple[ShardLink, ...]]:
        """Ask shards at once: the answers, and the shards that gave none in time."""
        # The same question to all is encoded once.
        distinct = {id(question): question for _, question in questions}
        messages = {name: encoded(question) for name, question in distinct.items()}
        asked = [(link, link.ask(question, messages[id(question)])) for link, question in questions]
        # Stand-ins work in this thread: others work meanwhile.
        asked.sort(key=lambda item: item[0].current)
        end = time.monotonic() + max(link.timeout for link, _ in questions)
        answers, silent = [], []
        for link, answer in asked:
            try:
                if answer is None:
                    raise IncompleteSearch(link.name)
                answers.append(answer(end - time.monotonic()))
            except Exception:  # noqa: BLE001 - the link has noted it, and the answer says so
                silent.append(link)
        return answers, tuple(silent)

    def _number(self, map_id: MapId) -> int:
        return zlib.crc32(f"{map_id.agent}/{map_id.epoch}".encode()) % len(self._links)

    def _of(self, map_id: MapId) -> ShardLink:
        return self._links[self._number(map_id)]

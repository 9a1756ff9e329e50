"""Messages between a server, its shards and its workers: those of `mapweave.wire.typed`, bounded and checked.

Nothing of them names code. Numbers travel as they are, so what is found elsewhere is what one server finds.
Landmarks are not packed as robots pack them: that takes longer than to compare them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import InvalidMessage
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.landmark_tables import SYMBOLS
from mapweave.hybridmap.limits import MAX_NUMBER
from mapweave.hybridmap.node import CODE_BYTES, Landmarks, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.mapserver.retrieval.compared_landmarks import MOST_LANDMARKS, bounded
from mapweave.mapserver.retrieval.ranking import NearestLandmarks
from mapweave.merge.pose_graph.links import Link, RefusedLink
from mapweave.merge.pose_graph.verdicts import Verdict
from mapweave.wire.packing import Limit, pack
from mapweave.wire.typed import decode, packed

Pairs = Sequence[tuple[Node, Node]]

MOST_BYTES = 4 << 20
"""Of a message. The longest has little more than half as many: the nearest landmarks of a view with as many
features as there may be, each in a map of its own."""
MOST_NEAREST = 32_000
"""Landmarks of an answer, of all features together: 16 of each of as many as there may be."""
LIMIT = Limit("message of the cluster", MOST_BYTES, 1 << 18)
"""Values: 260 000, eight for each of the nearest landmarks."""
NOWHERE = PoseGaussian(Pose2(), np.zeros((3, 3)))
"""Of a node that is compared: its pose in its map plays no part."""


@dataclass(frozen=True)
class State:
    """What a shard has.

    Attributes:
        incarnation: random, drawn when it began to be filled.
        number: of the last change it has, without gaps from 1 on.
    """

    incarnation: str
    number: int


@dataclass(frozen=True, eq=False)
class Ids:
    """Ids of N nodes.

    Attributes:
        maps: each once.
        rows: (N, 2) which of the maps, and the number in it.
    """

    maps: tuple[MapId, ...]
    rows: NDArray[np.int64]

    def __post_init__(self) -> None:
        """Refuse other shapes, maps that are not there and numbers out of range (InvalidMessage)."""
        _shaped(self.rows, 2)
        _rows(self.rows[:, 0], 0, len(self.maps))
        _rows(self.rows[:, 1], 0, MAX_NUMBER + 1)

    @staticmethod
    def of(nodes: Iterable[NodeId]) -> Ids:
        """Make it of nodes."""
        maps: dict[tuple[str, int], int] = {}
        rows = [(maps.setdefault(node[:2], len(maps)), node[2]) for node in nodes]
        return Ids(tuple(MapId(*map_id) for map_id in maps), np.array(rows, np.int64).reshape(-1, 2))

    @property
    def nodes(self) -> tuple[NodeId, ...]:
        """The ids, in order."""
        maps = self.maps
        return tuple(NodeId(maps[m].agent, maps[m].epoch, number) for m, number in self.rows.tolist())


@dataclass(frozen=True, eq=False)
class ComparedNodes:
    """What comparing needs of N nodes, see `mapweave.mapserver.retrieval.compared_landmarks.bounded`.

    Attributes:
        ids: of the nodes.
        cameras: each once.
        camera: (N, 1) which of these took a node.
        ends: (N, 1) where the landmarks of a node end, and those of the next one begin.
        landmarks: of all nodes.
    """

    ids: Ids
    cameras: tuple[Camera, ...]
    camera: NDArray[np.int64]
    ends: NDArray[np.int64]
    landmarks: Landmarks

    def __post_init__(self) -> None:
        """Refuse what does not belong together, and codes that are none (InvalidMessage)."""
        _shaped(self.camera, 1)
        _shaped(self.ends, 1)
        _rows(self.camera, 0, len(self.cameras))
        _rows(np.diff(self.ends, axis=0, prepend=0), 0, MOST_LANDMARKS + 1)
        _rows(self.landmarks.codes, 0, SYMBOLS)
        counts = {len(self.ids.rows), len(self.camera), len(self.ends)}
        if len(counts) > 1 or self.ends[-1:].sum() != len(self.landmarks):
            raise InvalidMessage("columns of nodes that do not belong together")

    @staticmethod
    def of(nodes: Sequence[Node]) -> ComparedNodes:
        """Make it of nodes."""
        cameras = {camera: k for k, camera in enumerate(dict.fromkeys(node.camera for node in nodes))}
        parts = [Landmarks.empty(), *(bounded(node).landmarks for node in nodes)]
        return ComparedNodes(
            Ids.of(node.id for node in nodes),
            tuple(cameras),
            np.array([cameras[node.camera] for node in nodes], np.int64)[:, None],
            np.cumsum([len(part) for part in parts])[1:, None],
            Landmarks(
                np.concatenate([part.pixels for part in parts]),
                np.concatenate([part.codes for part in parts]),
                np.concatenate([part.depths for part in parts]),
                np.concatenate([part.depth_sigmas for part in parts]),
            ),
        )

    @property
    def nodes(self) -> list[Node]:
        """Nodes that compare as they do; each has landmarks of its own, so that it can be forgotten."""
        ends = [0, *self.ends[:, 0].tolist()]
        return [
            Node(node_id, 0, NOWHERE, self.cameras[camera], self.landmarks.take(np.arange(start, end)))
            for node_id, camera, (start, end) in zip(
                self.ids.nodes, self.camera[:, 0].tolist(), pairwise(ends), strict=True
            )
        ]


@dataclass(frozen=True)
class Hello:
    """Asks a shard for its state."""

    TAG = "hello"


@dataclass(frozen=True)
class Reset:
    """Asks a shard to forget everything; the answer is the new state."""

    TAG = "reset"


@dataclass(frozen=True, eq=False)
class ShardChange:
    """A change of the nodes that a shard holds.

    Attributes:
        state: that which follows.
        nodes: that come, or replace others.
        gone: nodes that it is to forget.
    """

    state: State
    nodes: ComparedNodes
    gone: Ids
    TAG = "change"


@dataclass(frozen=True)
class Ask:
    """Asks a shard.

    Attributes:
        state: to which it must have come at least.
        question: a message, the same for all shards.
    """

    state: State
    question: bytes
    TAG = "ask"


@dataclass(frozen=True, eq=False)
class Nearest:
    """Asks for so many nearest landmarks of features, (N, 32) codes; see `PlaceIndex.nearest`."""

    codes: NDArray[np.uint8]
    count: int
    wanted: int
    TAG = "nearest"

    def __post_init__(self) -> None:
        """Refuse other shapes, codes that are none, and too many landmarks (InvalidMessage)."""
        _shaped(self.codes, CODE_BYTES)
        _rows(self.codes, 0, SYMBOLS)
        if self.count < 1 or self.count * len(self.codes) > MOST_NEAREST:
            raise InvalidMessage(f"{self.count} landmarks of each of {len(self.codes)} features")
        if self.wanted < 0:
            raise InvalidMessage(f"{self.wanted} landmarks are wanted")


@dataclass(frozen=True, eq=False)
class Overlaps:
    """Asks which nodes of a shard overlap with one node; see `PlaceIndex.overlaps`."""

    nodes: ComparedNodes
    TAG = "overlaps"

    def __post_init__(self) -> None:
        """Refuse more or fewer nodes (InvalidMessage)."""
        if len(self.nodes.ends) != 1:
            raise InvalidMessage(f"overlaps of {len(self.nodes.ends)} nodes instead of one")


@dataclass(frozen=True, eq=False)
class NearestAnswer:
    """The nearest landmarks, see NearestLandmarks."""

    squared: NDArray[np.float32]
    owners: NDArray[np.int64]
    nodes: Ids

    def __post_init__(self) -> None:
        """Refuse what does not belong together (InvalidMessage)."""
        if self.squared.ndim != 2 or self.squared.shape != self.owners.shape:
            raise InvalidMessage("nearest landmarks that do not belong together")
        _rows(self.owners, -1, len(self.nodes.rows))


@dataclass(frozen=True, eq=False)
class OverlapsAnswer:
    """Nodes, and the overlap of each, (N, 1)."""

    nodes: Ids
    overlaps: NDArray[np.float64]

    def __post_init__(self) -> None:
        """Refuse what does not belong together (InvalidMessage)."""
        _shaped(self.overlaps, 1)
        if len(self.overlaps) != len(self.nodes.rows):
            raise InvalidMessage("overlaps that do not belong to their nodes")


ShardRequest = Hello | Reset | ShardChange | Ask
Question = Nearest | Overlaps


@dataclass(frozen=True, eq=False)
class Comparison:
    """Asks a worker to compare nodes.

    Attributes:
        nodes: each once.
        pairs: (K, 2) rows of them.
    """

    nodes: ComparedNodes
    pairs: NDArray[np.int64]

    def __post_init__(self) -> None:
        """Refuse rows of no node, and other shapes (InvalidMessage)."""
        _shaped(self.pairs, 2)
        _rows(self.pairs, 0, len(self.nodes.ends))

    @staticmethod
    def of(pairs: Pairs) -> Comparison:
        """Make it of pairs of nodes."""
        nodes = {node.id: node for pair in pairs for node in pair}
        row = {node_id: k for k, node_id in enumerate(nodes)}
        rows = np.array([[row[a.id], row[b.id]] for a, b in pairs], np.int64).reshape(-1, 2)
        return Comparison(ComparedNodes.of([*nodes.values()]), rows)

    def node_pairs(self) -> list[tuple[Node, Node]]:
        """The pairs."""
        nodes = self.nodes.nodes
        return [(nodes[a], nodes[b]) for a, b in self.pairs.tolist()]


@dataclass(frozen=True, eq=False)
class FoundLink:
    """A link: mean and covariance of its pose, 12 numbers, (K, 2) shared landmarks, and its evidence."""

    a: NodeId
    b: NodeId
    a_from_b: NDArray[np.float64]
    shared: NDArray[np.int64]
    evidence: dict[str, float]
    TAG = "link"

    def __post_init__(self) -> None:
        """Refuse other shapes (InvalidMessage)."""
        _shaped(self.a_from_b[None], 12)
        _shaped(self.shared, 2)


@dataclass(frozen=True, eq=False)
class NoLink:
    """Why there is no link."""

    a: NodeId
    b: NodeId
    reason: str
    TAG = "none"


@dataclass(frozen=True, eq=False)
class ComparisonAnswer:
    """The verdicts, in the order of the pairs."""

    verdicts: tuple[FoundLink | NoLink, ...]

    @staticmethod
    def of(verdicts: Iterable[Verdict]) -> ComparisonAnswer:
        """Make it of what `mapweave.mapserver.merging.node_comparisons.compare` gives."""
        return ComparisonAnswer(tuple(map(_sent, verdicts)))

    def verdicts_on(self, pairs: Pairs) -> list[Verdict]:
        """The verdicts.

        Raises:
            InvalidMessage: they are on other pairs, or share landmarks that these have not.
        """
        asked = [sorted(pair, key=lambda node: node.id) for pair in pairs]
        if [(one.a, one.b) for one in self.verdicts] != [(a.id, b.id) for a, b in asked]:
            raise InvalidMessage("verdicts on other pairs than those that were asked for")
        for one, pair in zip(self.verdicts, asked, strict=True):
            if isinstance(one, FoundLink):
                for column, node in zip(one.shared.T, pair, strict=True):
                    _rows(column, 0, len(node.landmarks))
        return [*map(_received, self.verdicts)]


def _sent(verdict: Verdict) -> FoundLink | NoLink:
    if isinstance(verdict, RefusedLink):
        return NoLink(verdict.a, verdict.b, verdict.reason)
    pose = verdict.a_from_b
    numbers = np.concatenate([pose.mean.vector, pose.covariance.ravel()])
    return FoundLink(verdict.a, verdict.b, numbers, verdict.shared, verdict.evidence)


def _received(one: FoundLink | NoLink) -> Verdict:
    if isinstance(one, NoLink):
        return RefusedLink(one.a, one.b, one.reason)
    pose = PoseGaussian(Pose2.from_vector(one.a_from_b[:3]), one.a_from_b[3:].reshape(3, 3))
    return Link(one.a, one.b, pose, one.shared, one.evidence)


def encoded(message: object) -> bytes:
    """Any of the messages above as bytes."""
    return pack(packed(message))


def decoded(data: bytes, kind: Any) -> Any:
    """A message of one of the kinds above, or of a union of them.

    Raises:
        InvalidMessage: it is none.
    """
    return decode(data, kind, LIMIT)


Answer = NearestLandmarks | dict[NodeId, float]
"""To a Nearest, or to Overlaps: by node."""


def answer_message(answer: Answer) -> NearestAnswer | OverlapsAnswer:
    """A shard's answer."""
    if isinstance(answer, dict):
        return OverlapsAnswer(Ids.of(answer), np.array([*answer.values()], np.float64)[:, None])
    return NearestAnswer(answer.squared, answer.owners, Ids.of(answer.nodes))


def answer_to(question: Question, data: bytes) -> Answer:
    """What a shard's answer says.

    Raises:
        InvalidMessage: it is no answer to this question.
    """
    if isinstance(question, Overlaps):
        overlaps: OverlapsAnswer = decoded(data, OverlapsAnswer)
        return dict(zip(overlaps.nodes.nodes, overlaps.overlaps[:, 0].tolist(), strict=True))
    nearest: NearestAnswer = decoded(data, NearestAnswer)
    if len(nearest.squared) != len(question.codes):
        raise InvalidMessage("nearest landmarks of other features than those that were asked for")
    return NearestLandmarks(nearest.squared, nearest.owners, nearest.nodes.nodes)


def _shaped(array: NDArray[Any], columns: int) -> None:
    if array.ndim != 2 or array.shape[1] != columns:
        raise InvalidMessage(f"an array of {array.shape} instead of {columns} columns")


def _rows(rows: NDArray[Any], least: int, end: int) -> None:
    if ((rows < least) | (rows >= end)).any():
        raise InvalidMessage(f"a number that is not from {least} to {end - 1}")

"""What manual constraints are about: nodes or maps kept apart, nodes linked by hand, and what is retired.

Each has a `TAG` that tells it from the others in messages, and a `key`: of constraints with one key the last
holds.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, tzinfo
from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from mapweave.hybridmap.area import Area
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import MapId, NodeId, check_name, read_number
from mapweave.hybridmap.limits import MAX_STAMP_NS, Key, LandmarkCount, Stamp
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from mapweave.hybridmap.wall_time import LONGEST, NANOSECONDS, read_time

Ends = tuple[NodeId, NodeId] | tuple[MapId, MapId]
"""Two nodes, or two maps; the smaller first."""

EXAMPLE = "two nodes look like r0.1.17 r1.1.5, two maps like r0.1 r1.1"

MOST_NODES = 1000
"""Of one constraint."""
NAMED = 4
"""Nodes that are named where more are meant."""


@dataclass(frozen=True, slots=True)
class Apart:
    """Two nodes, or two maps, shall not be linked.

    Attributes:
        ends: two different ones. Of two maps it holds for every link between them, also for those to come.
    """

    TAG: ClassVar[str] = "apart"
    ends: Ends

    def __post_init__(self) -> None:
        """Put the ends in order; refuse one that is given twice (InvalidValue)."""
        first, second = sorted(self.ends)
        if len(first) != len(second) or first == second:
            raise InvalidValue("give two different nodes, or two different maps")
        object.__setattr__(self, "ends", (first, second))

    @property
    def key(self) -> tuple[str, ...]:
        """Tells it from others."""
        return self.TAG, *map(str, self.ends)

    @property
    def maps(self) -> frozenset[MapId]:
        """The maps that it concerns."""
        return frozenset(MapId(*end[:2]) for end in self.ends)

    def __str__(self) -> str:
        """In words: `r0.1.17 and r1.1.5`."""
        return f"{self.ends[0]} and {self.ends[1]}"


@dataclass(frozen=True, slots=True)
class Linked:
    """Two nodes see one place, whatever the merge makes of it.

    Attributes:
        a: the smaller id.
        b: the greater one, of the same map or of another.
        pose: of b's robot frame in a's, `a_from_b`; None where the images shall say it, and where a link is
            taken back.
        covariance: of `pose`, upper triangle by rows, in b (see PoseGaussian).
        shared: landmarks of a and of b that agree on the pose; none if it was given by hand.
        evidence: numbers that support it, see mapweave.registration.recognition; none likewise.
    """

    TAG: ClassVar[str] = "link"
    a: NodeId
    b: NodeId
    pose: Pose2 | None = None
    covariance: Annotated[tuple[float, ...], Meta(max_length=6)] = ()
    shared: tuple[tuple[LandmarkCount, LandmarkCount], ...] = ()
    evidence: Annotated[tuple[tuple[Key, float], ...], Meta(max_length=64)] = ()

    def __post_init__(self) -> None:
        """Put the smaller node first; refuse one node twice, and a covariance that is none (InvalidValue)."""
        if self.a == self.b:
            raise InvalidValue(f"{self.a} twice: give two different nodes")
        if len(self.covariance) != (6 if self.covariance else 0) or (self.covariance and self.pose is None):
            raise InvalidValue("a link has a pose with a covariance of 6 numbers, or neither")
        pose = self.pose and (PoseGaussian(self.pose, self._matrix()) if self.covariance else self.pose)
        if self.a > self.b:
            first, second = self.b, self.a
            object.__setattr__(self, "a", first)
            object.__setattr__(self, "b", second)
            object.__setattr__(self, "shared", tuple((one, other) for other, one in self.shared))
            back = pose and pose.inverse()
            mean = back.mean if isinstance(back, PoseGaussian) else back
            object.__setattr__(self, "pose", mean)
            if isinstance(back, PoseGaussian):
                object.__setattr__(self, "covariance", _upper(back.covariance))

    @staticmethod
    def of(
        a: NodeId,
        b: NodeId,
        a_from_b: PoseGaussian,
        shared: NDArray[np.int64] | None = None,
        evidence: Mapping[str, float] | None = None,
    ) -> Linked:
        """The subject with the pose, and what supports it."""
        pairs = () if shared is None else tuple((int(one), int(other)) for one, other in shared)
        numbers = tuple((name, float(value)) for name, value in sorted((evidence or {}).items()))
        return Linked(a, b, a_from_b.mean, _upper(a_from_b.covariance), pairs, numbers)

    @property
    def a_from_b(self) -> PoseGaussian:
        """The pose; raises InvalidValue if there is none."""
        if self.pose is None or not self.covariance:
            raise InvalidValue(f"the link of {self} has no pose")
        return PoseGaussian(self.pose, self._matrix())

    def _matrix(self) -> Array:
        matrix = np.zeros((3, 3))
        matrix[np.triu_indices(3)] = self.covariance
        return matrix + np.triu(matrix, 1).T

    @property
    def key(self) -> tuple[str, ...]:
        """Tells it from others: there is one link between two nodes."""
        return self.TAG, str(self.a), str(self.b)

    @property
    def maps(self) -> frozenset[MapId]:
        """The maps that it concerns."""
        return frozenset((self.a.map, self.b.map))

    def __str__(self) -> str:
        """In words: `r0.1.17 and r1.1.5`."""
        return f"{self.a} and {self.b}"


@dataclass(frozen=True, slots=True)
class RetiredMap:
    """A map takes no part in anything.

    Attributes:
        map: which.
    """

    TAG: ClassVar[str] = "map"
    map: MapId

    @property
    def key(self) -> tuple[str, ...]:
        """Tells it from others."""
        return self.TAG, str(self.map)

    @property
    def maps(self) -> frozenset[MapId]:
        """The map."""
        return frozenset((self.map,))

    def __str__(self) -> str:
        """In words: `map r0.1`."""
        return f"map {self.map}"


@dataclass(frozen=True, slots=True)
class RetiredNodes:
    """Some nodes take no part in anything.

    Attributes:
        nodes: which, in order.
    """

    TAG: ClassVar[str] = "nodes"
    nodes: Annotated[tuple[NodeId, ...], Meta(max_length=MOST_NODES)]

    def __post_init__(self) -> None:
        """Put them in order, each once; refuse none or too many (InvalidValue)."""
        object.__setattr__(self, "nodes", tuple(sorted(set(self.nodes))))
        if not 1 <= len(self.nodes) <= MOST_NODES:
            raise InvalidValue(f"give 1 to {MOST_NODES} nodes, not {len(self.nodes)}")

    @property
    def key(self) -> tuple[str, ...]:
        """Tells them from others."""
        return self.TAG, *map(str, self.nodes)

    @property
    def maps(self) -> frozenset[MapId]:
        """The maps that it concerns."""
        return frozenset(node.map for node in self.nodes)

    def __str__(self) -> str:
        """In words: `node r0.1.17` or `nodes r0.1.3 and r0.1.5`."""
        return nodes_in_words(self.nodes)


@dataclass(frozen=True, slots=True)
class RetiredArea:
    """All nodes in an area take no part in anything, of all maps, also those to come.

    Attributes:
        area: where; by the merged map as it is without any retired area.
    """

    TAG: ClassVar[str] = "area"
    area: Area

    @property
    def key(self) -> tuple[str, ...]:
        """Tells it from others."""
        return self.TAG, str(self.area.anchor), *(f"{x!r},{y!r}" for x, y in self.area.corners)

    @property
    def maps(self) -> frozenset[MapId]:
        """The anchor's map; which others it concerns only the merge knows."""
        return frozenset((self.area.anchor.map,))

    def __str__(self) -> str:
        """In words: `the area of 4 corners at r0.1.17`."""
        return f"the area of {len(self.area.corners)} corners at {self.area.anchor}"


@dataclass(frozen=True, slots=True)
class RetiredWindow:
    """The nodes of a map between two times take no part in anything, also those to come.

    Attributes:
        map: which.
        begin_ns: the first stamp of a node that is retired.
        end_ns: the last one.
    """

    TAG: ClassVar[str] = "window"
    map: MapId
    begin_ns: Stamp
    end_ns: Stamp

    def __post_init__(self) -> None:
        """Refuse an end before the beginning, and what is no time (InvalidValue)."""
        if not (0 <= self.begin_ns <= MAX_STAMP_NS and 0 <= self.end_ns <= MAX_STAMP_NS):
            raise InvalidValue(f"a time window is between 0 and {MAX_STAMP_NS} ns since 1970")
        if self.begin_ns > self.end_ns:
            begin, end = _time(self.begin_ns), _time(self.end_ns)
            if begin == end:
                begin, end = f"{begin} ({self.begin_ns} ns)", f"{end} ({self.end_ns} ns)"
            raise InvalidValue(
                f"a time window ends after it begins: its end, {end}, is before its beginning, {begin}"
            )

    @property
    def key(self) -> tuple[str, ...]:
        """Tells it from others."""
        return self.TAG, str(self.map), str(self.begin_ns), str(self.end_ns)

    @property
    def maps(self) -> frozenset[MapId]:
        """The map."""
        return frozenset((self.map,))

    def holds(self, node: Node) -> bool:
        """Whether a node is in it."""
        return node.id.map == self.map and self.begin_ns <= node.stamp_ns <= self.end_ns

    def __str__(self) -> str:
        """In words: `map r0.1 from 2026-03-01 12:00:00 UTC until 2026-03-01 12:05:00 UTC`."""
        return f"map {self.map} {period_in_words(self.begin_ns, self.end_ns)}".rstrip()


Subject = Apart | Linked | RetiredMap | RetiredNodes | RetiredArea | RetiredWindow
"""What a manual constraint is about."""


def read_ends(first: str, second: str) -> Ends:
    """Two nodes or two maps as people write them.

    Raises:
        InvalidValue: they are neither.
    """
    a, b = read_end(first), read_end(second)
    if isinstance(a, NodeId) and isinstance(b, NodeId):
        return a, b
    if isinstance(a, NodeId) or isinstance(b, NodeId):
        raise InvalidValue(f"{first} and {second} are a node and a map: {EXAMPLE}")
    return a, b


def read_end(word: str) -> NodeId | MapId:
    """A node (r0.1.17) or a map (r0.1).

    Raises:
        InvalidValue: it is neither.
    """
    parts = word.split(".")
    if len(parts) == 3:
        return NodeId.parse(word)
    epoch = read_number(parts[1]) if len(parts) == 2 else None
    if epoch is None:
        raise InvalidValue(f"{word!r} is neither a node nor a map: {EXAMPLE}")
    return MapId(check_name(parts[0]), epoch)


def read_retired(words: Iterable[str]) -> RetiredMap | RetiredNodes:
    """One map, or some nodes, as people write them.

    Raises:
        InvalidValue: they are neither.
    """
    ends = [read_end(word) for word in words]
    nodes = tuple(end for end in ends if isinstance(end, NodeId))
    if nodes and len(nodes) == len(ends):
        return RetiredNodes(nodes)
    if len(ends) == 1 and isinstance(ends[0], MapId):
        return RetiredMap(ends[0])
    raise InvalidValue("give one map (r0.1), or nodes (r0.1.17 r0.1.18)")


def read_pose(numbers: Iterable[float]) -> Pose2:
    """X and y in m, and the heading in degrees, as people write them.

    Raises:
        InvalidValue: they are not three finite numbers, or the heading is more than a whole turn.
    """
    values = [float(number) for number in numbers]
    if len(values) != 3 or not all(math.isfinite(value) for value in values):
        raise InvalidValue("a pose is three numbers, X,Y,DEGREES: the second node seen from the first")
    if abs(values[2]) > 360.0:
        raise InvalidValue(f"a heading of {values[2]:g} degrees is more than a whole turn: give -360 to 360")
    return Pose2(values[0], values[1], math.radians(values[2]))


def read_window(
    which: MapId, begin: str | int, end: str | int, now_ns: int, zone: tzinfo | None = UTC
) -> RetiredWindow:
    """A time window of a map; without a beginning or an end it has none.

    Args:
        which: the map.
        begin: ns since 1970, or as people write it (mapweave.hybridmap.wall_time), of the past if it has no
            date; empty: no beginning.
        end: likewise.
        now_ns: the present.
        zone: of times that name none; None: this machine's.

    Raises:
        InvalidValue: it is no time, or the end is before the beginning.
    """
    stamps = []
    for word, default in ((begin, 0), (end, MAX_STAMP_NS)):
        if isinstance(word, int) or (word.isdecimal() and len(word) <= LONGEST):
            stamps.append(min(int(word), MAX_STAMP_NS))
        else:
            stamps.append(read_time(word, now_ns, zone, past=True) if word else default)
    return RetiredWindow(which, *stamps)


def nodes_in_words(nodes: Iterable[NodeId]) -> str:
    """Nodes in words, for example `nodes r0.1.3 and r0.1.5`; of many some, and their number."""
    names = [str(node) for node in nodes]
    if len(names) == 1:
        return f"node {names[0]}"
    if len(names) > NAMED:
        return f"nodes {', '.join(names[:NAMED])} and {len(names) - NAMED} more"
    return f"nodes {', '.join(names[:-1])} and {names[-1]}"


def _upper(covariance: Array) -> tuple[float, ...]:
    return tuple(float(value) for value in covariance[np.triu_indices(3)])


def period_in_words(begin_ns: int, end_ns: int) -> str:
    """A period: `from 2026-03-01 12:00:00 UTC until 2026-03-01 12:05:00 UTC`; empty for all times."""
    begin = f"from {_time(begin_ns)}" if begin_ns else ""
    end = f"until {_time(end_ns)}" if end_ns < MAX_STAMP_NS else ""
    return " ".join(part for part in (begin, end) if part)


def _time(stamp_ns: int) -> str:
    return datetime.fromtimestamp(stamp_ns // NANOSECONDS, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")

"""What people have closed, preferred and avoided on a roadmap, at one time."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.annotation import Annotation, Annotations, Closure, Pair, Preference
from mapweave.hybridmap.area import Area, Floats, crosses, inside
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.wall_time import utc_words
from mapweave.mapserver.roadmap import Roadmap

BARRIER = 0.5
"""A closed edge is a barrier across its middle that reaches so far to either side, m: half a door. Robots
that mapped one corridor have an edge each for it, and all of these are to be closed."""
SHORT = 0.1
"""Nodes nearer than this to each other have no barrier between them, m: only their own edge is closed."""
OUT = 4.0
"""Within a closed area the ways of a robot that is to leave it cost this many times as much."""
Hop = frozenset[NodeId]


@dataclass(frozen=True, eq=False)
class _Extent:
    """Where an annotation holds in the merged map.

    Attributes:
        entry: the annotation.
        component: number of the component.
        polygon: (C, 2) corners of an area, or the two ends of a barrier, m.
        area: whether it is an area.
        edge: the two nodes of an edge; None of an area.
    """

    entry: Annotation
    component: int
    polygon: Floats
    area: bool
    edge: Pair | None

    def covers(self, begin: Floats, end: Floats) -> NDArray[np.bool_]:
        """(N,) whether it holds for ways along straight lines between (N, 2) points."""
        across = crosses(self.polygon, begin, end, closed=self.area)
        return across | inside(self.polygon, begin) if self.area else across

    def contains(self, component: int, pose: Pose2) -> bool:
        """Whether a pose is in the area."""
        return (
            self.area
            and component == self.component
            and bool(inside(self.polygon, np.array([[pose.x, pose.y]]))[0])
        )


class RouteRules:
    """Closures and preferences of one roadmap at one time.

    Attributes:
        closed: the closures of each closed pair of nodes.
        factors: by what the cost of a pair's edges is multiplied.
        preferences: of each pair that has a factor.
    """

    def __init__(self, roads: Roadmap, annotations: Annotations, stamp_ns: int) -> None:
        """Work out which edges are meant.

        Args:
            roads: of the merged map.
            annotations: the record.
            stamp_ns: the time, wall time since 1970.
        """
        self._roads = roads
        self._closures = [
            extent
            for entry, body in annotations.in_force(Closure)
            if body.holds(stamp_ns) and (extent := self._extent(entry, body.edge, body.area)) is not None
        ]
        preferred = [
            (extent, body.factor)
            for entry, body in annotations.in_force(Preference)
            if (extent := self._extent(entry, body.edge, body.area)) is not None
        ]
        self.closed: dict[Hop, list[Annotation]] = {}
        self.factors: dict[Hop, float] = {}
        self.preferences: dict[Hop, list[Annotation]] = {}
        for entry, pair in self._across(annotations, stamp_ns):
            if isinstance(entry.body, Preference):
                self.factors[pair] = self.factors.get(pair, 1.0) * entry.body.factor
                self.preferences.setdefault(pair, []).append(entry)
            else:
                self.closed.setdefault(pair, []).append(entry)
        for extent in self._closures:
            for hop in self._hops(extent):
                self.closed.setdefault(hop, []).append(extent.entry)
        for extent, factor in preferred:
            for hop in self._hops(extent):
                self.factors[hop] = self.factors.get(hop, 1.0) * factor
                self.preferences.setdefault(hop, []).append(extent.entry)

    def __bool__(self) -> bool:
        return bool(self.closed or self.factors or self._closures)

    def closure_at(self, node: NodeId) -> Annotation | None:
        """The closed area in which a node is; None if there is none."""
        component = self._roads.merged.component_of(node)
        if component is None:
            return None
        pose = self._roads.merged.pose(node)
        return next((one.entry for one in self._closures if one.contains(component, pose)), None)

    def around(self, node: NodeId, node_from_robot: Pose2) -> frozenset[Annotation]:
        """The closures of areas in which a robot is: it may leave them."""
        component = self._roads.merged.component_of(node)
        if component is None or not self._closures:
            return frozenset()
        pose = self._roads.merged.pose(node) @ node_from_robot
        return frozenset(one.entry for one in self._closures if one.contains(component, pose))

    def closed_for(self, within: Collection[Annotation] = ()) -> set[Hop]:
        """The pairs that are closed for a robot that is in some closed areas."""
        return {hop for hop, entries in self.closed.items() if not set(entries) <= set(within)}

    def factors_for(self, within: Collection[Annotation] = ()) -> Mapping[Hop, float]:
        """The factors for a robot that is in some closed areas."""
        if not within:
            return self.factors
        out = {hop: OUT for hop, entries in self.closed.items() if set(entries) <= set(within)}
        return {hop: self.factors.get(hop, 1.0) * out.get(hop, 1.0) for hop in self.factors.keys() | out}

    def first_closed(
        self, stops: Sequence[NodeId], within: Collection[Annotation] = ()
    ) -> tuple[int, Annotation] | None:
        """The first closed pair on a way over nodes: its number, and the closure; None without one."""
        for number, hop in enumerate(map(frozenset, pairwise(stops))):
            for entry in self.closed.get(hop, ()):
                if entry not in within:
                    return number, entry
        return None

    def bars(self, component: int, begin: Pose2, end: Pose2, within: Collection[Annotation]) -> bool:
        """Whether a closure lies between two poses."""
        a, b = np.array([[begin.x, begin.y]]), np.array([[end.x, end.y]])
        return any(
            one.component == component and one.entry not in within and one.covers(a, b)[0]
            for one in self._closures
        )

    def _across(self, annotations: Annotations, stamp_ns: int) -> Iterator[tuple[Annotation, Hop]]:
        """What holds for two nodes of different components: for a portal between them alone."""
        of = self._roads.merged.component_of
        closures = [entry for entry, body in annotations.in_force(Closure) if body.holds(stamp_ns)]
        for entry in (*closures, *(entry for entry, _ in annotations.in_force(Preference))):
            edge = entry.body.edge if isinstance(entry.body, Closure | Preference) else None
            if edge is not None and of(edge[0]) != of(edge[1]):
                yield entry, frozenset(edge)

    def _extent(self, entry: Annotation, edge: Pair | None, area: Area | None) -> _Extent | None:
        """Where something holds; None if its nodes are not in the merged map."""
        merged = self._roads.merged
        nodes = edge if edge is not None else (entry.body.anchor,)
        numbers = {merged.component_of(node) for node in nodes}
        number = numbers.pop()
        if numbers or number is None:
            return None
        if area is not None:
            return _Extent(entry, number, area.polygon(merged.pose(area.anchor)), True, None)
        a, b = (merged.pose(node) for node in nodes)
        along = np.array([b.x - a.x, b.y - a.y])
        length = float(np.linalg.norm(along))
        middle = np.array([a.x, a.y]) + along / 2.0
        aside = BARRIER * np.array([-along[1], along[0]]) / length if length > SHORT else np.zeros(2)
        barrier = np.array([middle - aside, middle + aside])
        return _Extent(entry, number, barrier, False, edge)

    def _hops(self, extent: _Extent) -> set[Hop]:
        """The pairs of nodes whose ways it is about."""
        # An edge crosses its own barrier: as a set it is among them once.
        hops = set() if extent.edge is None else {frozenset(extent.edge)}
        pairs, begin, end = self._roads.segments(extent.component)
        if pairs and not (hops and np.allclose(*extent.polygon)):
            hops |= {frozenset(pairs[int(k)]) for k in np.flatnonzero(extent.covers(begin, end))}
        return hops


def rule_words(entry: Annotation) -> str:
    """A closure or a preference, for example `closed by anna until 2026-03-01 14:00 UTC: "wet floor"`."""
    why = f': "{entry.because}"' if entry.because else ""
    who = f"by {entry.who or 'a person'}"
    if isinstance(entry.body, Preference):
        verb = "preferred" if entry.body.factor < 1.0 else "avoided"
        return f"{verb} {who} (cost times {entry.body.factor:g}){why}"
    assert isinstance(entry.body, Closure), "the other rule"
    until = "" if entry.body.end_ns is None else f" until {utc_words(entry.body.end_ns)}"
    return f"closed {who}{until}{why}"


def named_words(entries: Iterable[Annotation]) -> str:
    """Closures and preferences with their names, for example `door is closed by anna: "wet floor"`."""
    return " and ".join(dict.fromkeys(f"{entry.name} is {rule_words(entry)}" for entry in entries))

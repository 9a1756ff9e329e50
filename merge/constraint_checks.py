"""Checks a manual constraint before it is kept: what has no effect, or contradicts the map, is refused."""

from bisect import bisect
from collections.abc import Container
from dataclasses import replace
from typing import NamedTuple

import networkx as nx
import numpy as np

from mapweave.hybridmap.area import Area
from mapweave.hybridmap.constraint_subject import (
    Apart,
    Linked,
    RetiredArea,
    RetiredMap,
    RetiredNodes,
    RetiredWindow,
    nodes_in_words,
    period_in_words,
)
from mapweave.hybridmap.counted import counted
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import (
    ManualConstraint,
    ManualConstraints,
    decided,
    event_words,
    reason_of,
    verb_of,
)
from mapweave.hybridmap.pose import Pose2
from mapweave.merge.link_checks import checked_link
from mapweave.merge.outlier_rejection.loop_closures import CLAIMS
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.retired_nodes import retired_nodes, without_nodes
from mapweave.merge.settings import MergeSettings


class Checked(NamedTuple):
    """A manual constraint that may be kept.

    Attributes:
        constraint: with all that is to be kept of it.
        effects: what it does to the map, in words; may be empty. Of one that is taken back: what excludes the
            same still.
    """

    constraint: ManualConstraint
    effects: str = ""

    @property
    def words(self) -> str:
        """What was decided, and its effects, in one sentence."""
        if not self.effects:
            return event_words(self.constraint)
        if self.constraint.holds:
            return f"{event_words(self.constraint)}; {self.effects}"
        return f"{self.constraint.about}: taken back {decided(self.constraint)}, but {self.effects}"


def check_manual_constraint(
    merged: MergedMap,
    constraints: ManualConstraints,
    constraint: ManualConstraint,
    existing_maps: Container[MapId] = (),
    settings: MergeSettings | None = None,
) -> Checked:
    """Refuse a constraint that would change nothing, which is a mistake, or that contradicts the map.

    Args:
        merged: what it is made about.
        constraints: earlier constraints, merged already or not.
        constraint: the new one.
        existing_maps: that are there, in the merged map or not: any of them can be retired.
        settings: of the merge.

    Raises:
        InvalidValue: there is nothing to undo, or nothing to take back; or the evidence against it.
    """
    constraints = _with_retired_nodes(merged, constraints)
    standing = constraints.standing(constraint.about)
    about = constraint.about
    if not constraint.holds:
        if standing is None:
            raise InvalidValue(_nothing_to_take_back(constraint))
        return Checked(constraint, _still_excluded(merged, constraints, constraint))
    if isinstance(about, Linked):
        for end in (about.a, about.b):
            if merged.constraints.retires(end) is not None and constraints.retires(end) is None:
                raise InvalidValue(f"node {end} is in use again with the next merge: say it again then")
        return Checked(*checked_link(merged, constraints, constraint, settings or MergeSettings()))
    if standing is not None:
        already = "are apart" if isinstance(about, Apart) else f"{verb_of(about)} retired"
        raise InvalidValue(f"{about} {already} already: {reason_of(standing)}")
    match about:
        case Apart():
            return Checked(constraint, _checked_separation(merged, about))
        case RetiredMap(which):
            if which not in existing_maps:
                merged.check(which)
            return Checked(constraint)
        case RetiredNodes() | RetiredArea() | RetiredWindow():
            return Checked(constraint, _checked_retirement(merged, constraints, constraint))


def _with_retired_nodes(merged: MergedMap, constraints: ManualConstraints) -> ManualConstraints:
    """Constraints with the nodes that they retire, also of those that are not merged yet."""
    maps = {**merged.copies, **merged.maps}
    known = {
        node: constraint
        for node, constraint in merged.constraints.nodes.items()
        if constraints.standing(constraint.about) is not None
    }
    # What lies in an area that is merged already is in no component of the merged map.
    return constraints.with_nodes({**retired_nodes(maps, constraints, merged.graphs), **known})


def _still_excluded(merged: MergedMap, constraints: ManualConstraints, taken_back: ManualConstraint) -> str:
    """What other constraints exclude of what one no longer does, in words; empty if nothing."""
    about = taken_back.about
    rest = ManualConstraints([*constraints.made, taken_back], floors=constraints.floors)
    rest = _with_retired_nodes(merged, rest)
    nodes: list[NodeId] = []
    places = _Places(merged)
    match about:
        case Apart((NodeId() as a, NodeId() as b)):
            against = rest.against(a, b)
            return "" if against is None else f"they stay apart: {reason_of(against)}"
        case RetiredMap(which) if which in merged.maps:
            nodes = [*merged.maps[which].nodes]
        case RetiredNodes() | RetiredArea() | RetiredWindow():
            own = ManualConstraints([replace(taken_back, holds=True)])
            nodes = [*retired_nodes(merged.maps, own, merged.graphs)]
            out_of_use = merged.constraints.nodes
            nodes += [node for node in out_of_use if out_of_use[node].about.key == about.key]
            if isinstance(about, RetiredArea):
                nodes += [node for node in out_of_use if places.within(about.area, node)]
    areas = [
        (constraint, constraint.about.area)
        for constraint in rest.in_force
        if isinstance(constraint.about, RetiredArea)
    ]
    held: dict[ManualConstraint, set[NodeId]] = {}
    for node in nodes:
        over = (constraint for constraint, area in areas if places.within(area, node))
        other = rest.retires(node) or next(over, None)
        if other is not None:
            held.setdefault(other, set()).add(node)
    return "; ".join(
        f"{nodes_in_words(sorted(of))} {'stays' if len(of) == 1 else 'stay'} out of use: {reason_of(other)}"
        for other, of in held.items()
    )


class _Places:
    """Where nodes are, also retired ones: of those the merge does not say in which areas they lie."""

    def __init__(self, merged: MergedMap) -> None:
        self._merged = merged
        self._active: dict[MapId, list[NodeId]] = {}

    def within(self, area: Area, node: NodeId) -> bool:
        """Whether an area holds a node; of a retired one, where its robot's own map has it."""
        anchor, place = self._place(area.anchor), self._place(node)
        if anchor is None or place is None or anchor[0] != place[0]:
            return False
        pose = anchor[1].inverse() @ place[1]
        return bool(area.contains(np.array([[pose.x, pose.y]]))[0])

    def _place(self, node: NodeId) -> tuple[int | None, Pose2] | None:
        """Component and pose; of a retired node by the nodes before and after it."""
        merged = self._merged
        if merged.component_of(node) is not None:
            return merged.component_of(node), merged.pose(node)
        hybrid_map = merged.maps.get(node.map)
        if hybrid_map is None or node not in hybrid_map.nodes:
            return None
        if node.map not in self._active:
            poses = merged.poses
            self._active[node.map] = sorted(other for other in hybrid_map.nodes if other in poses)
        active = self._active[node.map]
        k = bisect(active, node)
        if not active:
            return None
        near = min(active[max(k - 1, 0) : k + 1], key=lambda other: abs(other.number - node.number))
        near_from_map = hybrid_map.nodes[near].map_from_robot.mean.inverse()
        near_from_node = near_from_map @ hybrid_map.nodes[node].map_from_robot.mean
        return merged.component_of(near), merged.pose(near) @ near_from_node


def _nothing_to_take_back(constraint: ManualConstraint) -> str:
    about = constraint.about
    match about:
        case Apart((first, second)):
            return f"no manual constraint keeps {first} and {second} apart"
        case Linked():
            return f"{about} are not linked by hand"
        case RetiredNodes():
            return f"no manual constraint retires just {about}: give all that were retired together"
    return f"{about} is not retired"


def _checked_separation(merged: MergedMap, about: Apart) -> str:
    first, second = about.ends
    for end in (first, second):
        merged.check(end)
    pairs = [link.pair for link in merged.links]
    false = {refusal.edge for refusal in merged.refused}
    pairs += [
        (edge.a, edge.b)
        for hybrid_map in merged.maps.values()
        for edge in hybrid_map.edges.values()
        if edge.kind in CLAIMS and edge.id not in false
    ]
    ends = {first, second}
    count = sum(ends in ({a, b}, {a.map, b.map}) for a, b in pairs)
    if count:
        return f"{counted(count, 'link')} {'is' if count == 1 else 'are'} undone"
    for edge in merged.maps[MapId(*first[:2])].edges.values():
        if {edge.a, edge.b} == ends and edge.kind not in CLAIMS:
            way = f"their robot's way (edge {edge.id}, {edge.kind})"
            raise InvalidValue(
                f"{first} and {second} are joined by {way}, and that measurement cannot be undone; a map "
                "that is wrong as a whole can be retired"
            )
    raise InvalidValue(f"no link joins {first} and {second}: there is nothing to undo")


def _checked_retirement(
    merged: MergedMap, constraints: ManualConstraints, constraint: ManualConstraint
) -> str:
    """What becomes of the maps; refuse what retires no node."""
    about = constraint.about
    ends: tuple[NodeId | MapId, ...] = ()
    match about:
        case RetiredNodes(nodes):
            ends = nodes
        case RetiredArea(area):
            ends = (area.anchor,)
        case RetiredWindow(which):
            ends = (which,)
    for end in ends:
        merged.check(end)
        earlier = constraints.retired.get(MapId(*end[:2]))
        if isinstance(about, RetiredArea) and isinstance(end, NodeId):
            earlier = earlier or constraints.nodes.get(end)
        if earlier is not None:
            raise InvalidValue(f"{end} is out of use: {reason_of(earlier)}")
    found = retired_nodes(merged.maps, ManualConstraints([constraint]), merged.graphs)
    fresh = found.keys() - constraints.nodes.keys()
    if not fresh:
        why = "all of its nodes are retired already" if found else "no node lies in it"
        if not found and isinstance(about, RetiredWindow):
            stamps = [node.stamp_ns for node in merged.maps[about.map].nodes.values()]
            why += f"; the nodes of {about.map} are {period_in_words(min(stamps), max(stamps))}"
        raise InvalidValue(f"{about}: {why}")
    effects = [
        f"{counted(len(fresh), 'node')} of {', '.join(map(str, sorted({node.map for node in fresh})))}"
    ]
    for which in sorted({node.map for node in fresh}):
        before = {node for node in constraints.nodes if node.map == which}
        now = before | {node for node in fresh if node.map == which}
        effects += _falls_apart(which, merged.maps[which], before, now)
    return "; ".join(effects)


def _falls_apart(which: MapId, whole: HybridMap, before: set[NodeId], now: set[NodeId]) -> list[str]:
    """What a robot's own map lacks without some nodes, in words."""
    held = [without_nodes(whole, nodes).components() for nodes in (before, now)]
    if not held[1]:
        return [f"map {which} has no node left"]
    if len(held[1]) > len(held[0]):
        sizes = ", ".join(str(len(part)) for part in held[1])
        return [f"map {which} falls into {len(held[1])} pieces of {sizes} nodes, unless others tie them"]
    parts = [_parts(whole, nodes) for nodes in (before, now)]
    if parts[1] > parts[0]:
        return [
            f"map {which} stays in one frame, and no way of its own leads from one of its {parts[1]} parts "
            "to another"
        ]
    return []


def _parts(whole: HybridMap, retired: set[NodeId]) -> int:
    """Parts of a map between which no edge leads, without some nodes, and without bridges across them."""
    left = whole.graph().subgraph(whole.nodes.keys() - retired)
    return nx.number_connected_components(left)  # type: ignore[no-any-return]

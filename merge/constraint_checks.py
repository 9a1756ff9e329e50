"""Checks a manual constraint before it is kept: what has no effect, or contradicts the map, is refused."""

from __future__ import annotations

from collections.abc import Container
from typing import NamedTuple

import networkx as nx

from mapweave.hybridmap.constraint_subject import (
    Apart,
    Linked,
    RetiredArea,
    RetiredMap,
    RetiredNodes,
    RetiredWindow,
    period_in_words,
)
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints, reason_of, verb_of
from mapweave.merge.link_checks import checked_link
from mapweave.merge.outlier_rejection.loop_closures import CLAIMS
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.retired_nodes import retired_nodes, without_nodes
from mapweave.merge.settings import MergeSettings


class Checked(NamedTuple):
    """A manual constraint that may be kept.

    Attributes:
        constraint: with all that is to be kept of it.
        effects: what it does to the map, in words; may be empty.
    """

    constraint: ManualConstraint
    effects: str = ""


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
    constraints = constraints.with_nodes(merged.constraints.nodes)
    standing = constraints.standing(constraint.about)
    about = constraint.about
    if not constraint.holds:
        if standing is None:
            raise InvalidValue(_nothing_to_take_back(constraint))
        return Checked(constraint)
    if isinstance(about, Linked):
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
        return "1 link is undone" if count == 1 else f"{count} links are undone"
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
    count = "1 node" if len(fresh) == 1 else f"{len(fresh)} nodes"
    effects = [f"{count} of {', '.join(map(str, sorted({node.map for node in fresh})))}"]
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

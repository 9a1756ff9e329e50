"""Checks a link that a person wants to make: against the images, the merged map and the robots' drives."""

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise

import networkx as nx

from mapweave.hybridmap.constraint_subject import Linked
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints, reason_of
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.merge.floors import floor_of
from mapweave.merge.manual_constraints import apply_constraints, link_by_hand
from mapweave.merge.mutual_exclusion.refutation import Refutation
from mapweave.merge.outlier_rejection.loop_closures import distance2_of
from mapweave.merge.outlier_rejection.segmentation import fragments_of
from mapweave.merge.pose_graph.component_solver import ComponentSolver
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.pose_graph.verification import MOST_SIGMA_HEADING, MOST_SIGMA_XY, examine, verify
from mapweave.merge.settings import ConsistencySettings, MergeSettings

GIVE_POSE = "give by hand the pose"
"""What a refusal asks for where the images say nothing; the shell adds by which options."""


def checked_link(
    merged: MergedMap, constraints: ManualConstraints, constraint: ManualConstraint, settings: MergeSettings
) -> tuple[ManualConstraint, str]:
    """A link by hand with its pose and its evidence.

    The images of the two nodes say the pose. Where they agree on none, a person may give it: it is as
    uncertain as the least certain link that images give. Either way it must fit the merged map.

    Args:
        merged: the map in which both nodes are.
        constraints: earlier constraints, with the nodes that they retire.
        constraint: the new one, with a pose or without.
        settings: of the merge.

    Returns:
        The constraint as it is to be kept, and what supports it, in words.

    Raises:
        InvalidValue: the evidence against it, and what to do.
    """
    asked = constraint.about
    assert isinstance(asked, Linked), "a link"
    # A map that was set apart as a copy is taken in by the link.
    merged = replace(
        merged,
        maps={**merged.copies, **merged.maps},
        set_apart={m: reason for m, reason in merged.set_apart.items() if m not in merged.copies},
    )
    for end in (asked.a, asked.b):
        merged.check(end)
    against = constraints.against(asked.a, asked.b)
    if against is not None:
        raise InvalidValue(f"{asked} cannot be linked: {reason_of(against)}; take that back first")
    standing = constraints.standing(asked)
    if standing is not None:
        raise InvalidValue(f"{asked} are {reason_of(standing)} already")
    known = next((link for link in merged.links if link.pair == (asked.a, asked.b)), None)
    if known is not None:
        raise InvalidValue(f"{asked} are linked already: {_landmarks(known)} of the images agree on one pose")
    _check_floors(merged, asked, constraints.floors)
    linked, words = _by_images(merged, asked, constraint.because, settings.consistency)
    _check_geometry(merged, linked, settings.consistency)
    _check_exclusion(merged, linked, settings)
    return replace(constraint, about=linked), words


def _by_images(merged: MergedMap, asked: Linked, because: str, s: ConsistencySettings) -> tuple[Linked, str]:
    """The link with the pose that the images give; with a person's only where they give none."""
    a, b = (merged.maps[node.map].nodes[node] for node in (asked.a, asked.b))
    verdict = verify(a, b)
    if isinstance(verdict, Link):
        pose, inliers = verdict.a_from_b, int(verdict.evidence["inliers"])
        if asked.pose is not None and distance2_of(_by_person(asked.pose), pose) >= s.gate:
            raise InvalidValue(
                f"{asked} cannot be linked so: {inliers} landmarks of the images agree on another pose, "
                f"{_words(pose.mean)}, {_off(pose.mean, asked.pose)} from yours; leave your pose out"
            )
        words = f"{_landmarks(verdict)} of the images agree on one pose"
        return Linked.of(asked.a, asked.b, pose, verdict.shared, verdict.evidence), words
    found = examine(a, b)
    evidence = verdict.reason
    if found.inliers:
        evidence = f"{found.matches} features match, {found.inliers} of them agree on a pose: {evidence}"
    if asked.pose is None:
        raise InvalidValue(
            f"the images of {asked} do not show one place: {evidence}. If you know that they do, "
            f"{GIVE_POSE} of {asked.b} seen from {asked.a}, and a reason"
        )
    if not because:
        raise InvalidValue(f"a pose by hand, without the images ({evidence}), needs a reason")
    return Linked.of(asked.a, asked.b, _by_person(asked.pose)), f"by hand alone; {evidence}"


def _check_floors(merged: MergedMap, asked: Linked, floors: Mapping[MapId, str]) -> None:
    """Refuse a link between two floors."""
    first, second = (floor_of(merged, floors, node) for node in (asked.a, asked.b))
    if first and second and first != second:
        raise InvalidValue(
            f"{asked} cannot be linked: {asked.a} is on floor {first}, {asked.b} on floor {second}. If a "
            "label is wrong, first take it back; a lift or a ramp between them is a portal, and no link"
        )


def _by_person(pose: Pose2) -> PoseGaussian:
    return PoseGaussian.from_sigmas(pose, MOST_SIGMA_XY, MOST_SIGMA_HEADING)


def _check_geometry(merged: MergedMap, linked: Linked, s: ConsistencySettings) -> None:
    """Refuse a link that the optimised poses contradict."""
    relative = merged.relative(linked.a, linked.b)
    if relative is None:
        return
    distance2 = distance2_of(linked.a_from_b, relative)
    if distance2 < s.gate:
        return
    assert linked.pose is not None
    raise InvalidValue(
        f"{linked} cannot be linked so: the link has {linked.b} at {_words(linked.pose)} from {linked.a}, "
        f"the merged map at {_words(relative.mean)}, {_off(linked.pose, relative.mean)} from there: "
        f"{math.sqrt(distance2):.1f} standard deviations, at most {math.sqrt(s.gate):.1f} pass. "
        f"{what_joins(merged, linked.a, linked.b)}"
    )


def what_joins(merged: MergedMap, a: NodeId, b: NodeId) -> str:
    """What joins two nodes of one component, and how to take it back if that is what is wrong."""
    links_by_hand = merged.constraints.links
    weights: dict[tuple[MapId, MapId], float] = {}
    counts: dict[tuple[MapId, MapId], list[tuple[NodeId, NodeId]]] = {}
    for link in merged.links:
        if not link.within:
            weight = math.inf if link.pair in links_by_hand else link.weight
            weights[link.maps] = weights.get(link.maps, 0.0) + weight
            counts.setdefault(link.maps, []).append(link.pair)
    step = _weakest(weights, a.map, b.map)
    if step is None:
        loops = [link for link in merged.links if link.within and link.a.map == a.map]
        more = f" and {len(loops)} loop closures" if loops else ""
        return (
            f"Map {a.map} says so by its robot's own way{more}: if that is wrong, first retire what "
            "is wrong of it, or undo a loop closure"
        )
    by_hand = [pair for pair in counts[step] if pair in links_by_hand]
    if by_hand:
        first, second = by_hand[0]
        return f"The link by hand of {first} and {second} joins them: first take it back"
    count = len(counts[step])
    links = "1 link joins" if count == 1 else f"{count} links join"
    return (
        f"On the way between the two {links} {step[0]} and {step[1]}, the weakest; if that is wrong, first "
        f"undo {'it' if count == 1 else 'them'}"
    )


def _weakest(
    weights: Mapping[tuple[MapId, MapId], float], first: MapId, second: MapId
) -> tuple[MapId, MapId] | None:
    """The weakest step on the best supported way from one map to another; None within one map."""
    graph: nx.Graph = nx.Graph()
    for (a, b), weight in sorted(weights.items()):
        graph.add_edge(a, b, weight=weight)
    if first == second or first not in graph or second not in graph or not nx.has_path(graph, first, second):
        return None
    way = nx.shortest_path(nx.maximum_spanning_tree(graph), first, second)
    steps = [(min(a, b), max(a, b)) for a, b in pairwise(way)]
    return min(steps, key=lambda step: (weights[step], step))


def _check_exclusion(merged: MergedMap, linked: Linked, settings: MergeSettings) -> None:
    """Refuse a link that joins two components whose robots then contradict each other."""
    graphs = [
        merged.graphs[k]
        for k in {merged.component_of(linked.a), merged.component_of(linked.b)}
        if k is not None
    ]
    if len(graphs) < 2:
        return
    inside = {which for graph in graphs for which in graph.maps}
    maps = apply_constraints({m: merged.maps[m] for m in sorted(inside)}, (), merged.constraints).maps
    fragments = [
        fragment
        for fragment in fragments_of(maps, settings.consistency)
        if any(fragment.name in graph.rows for graph in graphs)
    ]
    links = [link for link in merged.links if any(link.a in graph.rows for graph in graphs)]
    solver = ComponentSolver(fragments)
    solver.solve([*links, link_by_hand(linked)])
    refutation = Refutation(maps, fragments, settings.exclusion)
    for (first, second), collision in refutation.collisions([solver.graph_of(linked.a)]):
        if any(first in graph.rows and second not in graph.rows for graph in graphs):
            raise InvalidValue(f"{linked} cannot be linked: {collision.reason}")


def _landmarks(link: Link) -> str:
    return f"{int(link.evidence.get('inliers', 0.0))} landmarks"


def _words(pose: Pose2) -> str:
    return f"{pose.x:+.2f} m ahead, {pose.y:+.2f} m left, {math.degrees(pose.heading):+.1f} deg"


def _off(one: Pose2, other: Pose2) -> str:
    off = one.inverse() @ other
    return f"{off.distance(Pose2()):.2f} m and {abs(math.degrees(off.heading)):.1f} deg"

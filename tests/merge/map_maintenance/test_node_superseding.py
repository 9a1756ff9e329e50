"""Superseded nodes: only where a newer one covers them, and active again where it no longer does."""

import math
from copy import copy
from dataclasses import replace

import networkx as nx
import numpy as np
import pytest

from mapweave.hybridmap.change import Change, NodePut, NodeRetired
from mapweave.hybridmap.constraint_subject import Apart
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import Certainty
from mapweave.hybridmap.reachability import FARTHEST, WIDEST, least_in_view
from mapweave.hybridmap.reachability_cache import ReachabilityCache
from mapweave.hybridmap.superseding import DEPTHS, ENOUGH, FOUND
from mapweave.mapserver.active_nodes import ActiveNodes
from mapweave.mapserver.map_files import map_file_of, merged_of
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.relocalization.relocalizer import Relocalizer
from mapweave.mapserver.roadmap import Roadmap
from mapweave.mapserver.routes import Router
from mapweave.merge.explanation.node_explanation import explain_nodes
from mapweave.merge.map_maintenance import node_superseding as rules
from mapweave.merge.pose_graph.links import Link, RefusedLink
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.pose_graph.verification import verify
from mapweave.storage.map_file import pack_map_file, unpack_map_file
from synthetic.maps import changes_of, map_tours, numbered
from synthetic.world import room, take_map, take_view

OLD, NEW, OTHER = MapId("r0", 1), MapId("r0", 2), MapId("r1", 1)
NEW_ALONE = ManualConstraints(
    [ManualConstraint(Apart((other, NEW)), True, "anna", 1) for other in (OLD, OTHER)]
)
"""Nothing joins the newer drive with the others."""


class Drives:
    """One robot drives the same way twice, another one looks at the opposite wall."""

    def __init__(self, seed: int = 3) -> None:
        rng = np.random.default_rng(seed)
        self.world = room(0, 0, 8, 4, 1600, rng)
        self.truth: dict[NodeId, Pose2] = {}
        self.changes: dict[MapId, list[Change]] = {}
        for map_id, y, heading in ((OLD, 2.0, 0.3), (NEW, 2.15, 0.25), (OTHER, 2.1, 3.3)):
            tour = [Pose2(1.5 + 0.8 * k, y, heading) for k in range(5)]
            nodes, edges = take_map(self.world, map_id, tour, rng, sigma_xy=0.01, sigma_heading=0.01)
            self.truth |= {node.id: pose for node, pose in zip(nodes, tour, strict=True)}
            self.changes[map_id] = numbered(map_id, changes_of(nodes, edges))

    def merger(self, *maps: MapId) -> Merger:
        merger = Merger()
        for map_id in maps:
            for change in self.changes[map_id]:
                merger.on_change(change)
        return merger


@pytest.fixture(scope="module")
def drives() -> Drives:
    return Drives()


@pytest.fixture(scope="module")
def merger(drives: Drives) -> Merger:
    merger = drives.merger(OLD, OTHER)
    merger.merged()
    for change in drives.changes[NEW]:
        merger.on_change(change)
    return merger


def active(merged: MergedMap) -> set[NodeId]:
    return set(merged.poses) - set(merged.superseded)


def test_the_second_drive_supersedes_the_first(drives: Drives, merger: Merger):
    merged = merger.merged()
    assert len(merged.superseded) >= 3
    assert {node.map for node in merged.superseded} == {OLD}, "views the other way are not superseded"
    assert f"{len(merged.superseded)} superseded" in merged.summary()
    for node, fate in merged.superseded.items():
        assert fate.by in active(merged) and fate.by.map == NEW
        between = drives.truth[node].inverse() @ drives.truth[fate.by]
        assert math.hypot(between.x, between.y) < FARTHEST + 0.1
        assert abs(between.heading) < WIDEST + 0.1
        link = verify(merger.maps[OLD].nodes[node], merger.maps[NEW].nodes[fate.by])
        assert isinstance(link, Link) and rules.FOUND <= fate.found <= link.weight
        assert str(fate.by) in str(fate)


def test_nothing_that_could_be_reached_is_cut_off(merger: Merger):
    """The graph of the active nodes has the same pieces, by networkx."""
    merged = merger.merged()
    roads = Roadmap(merged, 0.5, ReachabilityCache())
    graph: nx.Graph = nx.Graph()
    graph.add_nodes_from(roads.poses)
    graph.add_edges_from(
        (e.a, e.b)
        for e in roads.union.edges.values()
        if e.id not in roads.closed and e.id.agent != "superseded"
    )
    alive = active(merged)
    before = {frozenset(piece & alive) for piece in nx.connected_components(graph)}
    after = {frozenset(piece) for piece in nx.connected_components(graph.subgraph(alive))}
    assert before - {frozenset()} == after


def test_routes_from_and_to_superseded_nodes_are_found(merger: Merger):
    merged = merger.merged()
    router, alive = Router(merged), active(merged)
    old = sorted(merged.superseded)
    far = max(alive, key=lambda n: merged.poses[n].merged_from_robot.mean.x)
    for start, goal in ((old[0], far), (far, old[0]), (old[0], old[-1])):
        legs = [leg.node.id for leg in router.route(start, goal).legs]
        assert legs[0] == start and legs[-1] == goal
        assert set(legs[1:-1]) <= alive, "on the way there are active nodes only"


def test_a_file_has_the_superseded_nodes_with_reasons(merger: Merger):
    merged = merger.merged()
    again = merged_of(unpack_map_file(pack_map_file(map_file_of(merged))))
    assert again.superseded == merged.superseded
    node, fate = next(iter(again.superseded.items()))
    explanation = explain_nodes(again, node, fate.by)
    assert any(f"{node} is superseded: {fate.by} replaces it" in claim for claim in explanation.claims)
    assert any("stay in view" in claim for claim in explanation.claims)


def test_questions_are_answered_by_active_nodes(drives: Drives, merger: Merger):
    merged = merger.merged()
    places = ActiveNodes(merger.places, merger.node, merged)
    relocalizer = Relocalizer(places, places.node, merged)
    for k, node in enumerate(sorted(merged.superseded)):
        view, _ = take_view(drives.world, drives.truth[node], np.random.default_rng(k))
        answer = relocalizer.answer(view)
        assert answer.certainty is Certainty.FOUND
        assert answer.candidates[0].node in active(merged)
        there = drives.truth[answer.candidates[0].node] @ answer.candidates[0].node_from_robot.mean
        assert there.distance(drives.truth[node]) < 0.25


def test_removing_a_successor_makes_its_nodes_active(drives: Drives):
    merger = drives.merger(OLD, NEW, OTHER)
    superseded = merger.merged().superseded
    assert superseded
    by = next(iter(superseded.values())).by
    merger.apply(NEW, NodeRetired(by))
    merged = merger.merged()
    assert by not in merged.poses
    assert all(fate.by in active(merged) for fate in merged.superseded.values())
    merger.constrain(NEW_ALONE)
    assert not merger.merged().superseded, "nothing joins them now"
    merger.constrain(ManualConstraints())
    assert merger.merged().superseded


def test_views_of_one_visit_complete_each_other(drives: Drives):
    assert not drives.merger(NEW).merged().superseded


def test_the_active_nodes_stay_few_over_many_drives(drives: Drives):
    """Each drive like the last, from the same places: the map holds one of them."""
    rng = np.random.default_rng(9)
    merger, counts = Merger(), []
    for epoch in range(1, 6):
        tour = [Pose2(1.5 + 0.8 * k + rng.normal(0, 0.1), 2.0 + rng.normal(0, 0.1), 0.3) for k in range(4)]
        map_id = MapId("r0", epoch)
        for change in numbered(map_id, map_tours(drives.world, {map_id: tour}, rng, 0.01, 0.01)[map_id]):
            merger.on_change(change)
        counts.append(len(active(merger.merged())))
    assert counts[0] == 4 and max(counts) <= 8, counts


def test_a_node_among_later_views_is_left_to_one_that_it_was_not_refused_with(drives: Drives, monkeypatch):
    """Else it would be active again after the next merge, and the ways to it be gone."""
    monkeypatch.setattr(rules, "superseded_by", lambda *_: None)
    rng, day = np.random.default_rng(11), 86_400 * 10**9
    tours = {
        OLD: [Pose2(2.5 + 0.8 * k, 2.0, 0.3) for k in range(2)],
        NEW: [Pose2(1.7 + 0.4 * k, 2.15, 0.25) for k in range(8)],
    }
    merger = Merger()
    for map_id, changes in map_tours(drives.world, tours, rng, 0.01, 0.01).items():
        for change in numbered(map_id, changes):
            body = change.body
            if map_id == NEW and isinstance(body, NodePut):
                body = NodePut(replace(body.node, stamp_ns=body.node.stamp_ns + 20 * day))
            merger.on_change(replace(change, body=body))
    merged = replace(merger.merged(), superseded={})
    before = rules.NodeSuperseder().renewed(merged)
    crowded = min(before.superseded)
    nearest = before.superseded[crowded].by
    assert crowded.map == OLD and nearest.map == NEW
    refused = replace(merged, refused=(*merged.refused, RefusedLink(crowded, nearest, "nothing in common")))
    superseder = rules.NodeSuperseder()
    after = superseder.renewed(refused).superseded
    assert crowded in after and after[crowded].by != nearest
    # As after the next merge: all of it was solved again.
    again = replace(refused, graphs=tuple(map(copy, refused.graphs)))
    assert superseder.renewed(again).superseded == after


def test_superseded_nodes_are_not_searched_until_active_again(drives: Drives):
    merger = drives.merger(OLD, NEW, OTHER)
    merged = merger.merged()
    assert merged.superseded
    assert {node for node in merged.poses if node in merger.places} == active(merged)
    # Refined, it is judged again, and superseded again.
    old = next(iter(merged.superseded))
    node = merger.node(old)
    assert node is not None
    before = {link.pair for link in merged.links}
    merger.apply(OLD, NodePut(node))
    merged = merger.merged()
    assert {node_id for node_id in merged.poses if node_id in merger.places} == active(merged)
    assert {link.pair for link in merged.links} == before, "what tied it ties it still"
    merger.constrain(NEW_ALONE)
    merged = merger.merged()
    assert not merged.superseded and all(node_id in merger.places for node_id in merged.poses)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_all_that_is_superseded_is_covered_and_nothing_more_could_be(seed: int, monkeypatch):
    """Where ways do not matter: each node has an active one that covers it, and none can be removed."""
    rng = np.random.default_rng(seed)
    world = room(0, 0, 6, 4, 1200, rng)
    # Nodes at one place reach each other: the whole room is one.
    monkeypatch.setattr(rules, "NEAR", 100.0)
    monkeypatch.setattr(rules, "DETOUR", 1000.0)
    merger = Merger()
    for epoch in range(1, 5):
        tour = [Pose2(*rng.uniform([1.5, 1.5], [3.5, 2.5]), rng.uniform(-0.6, 0.6)) for _ in range(6)]
        map_id = MapId("r0", epoch)
        for change in numbered(map_id, map_tours(world, {map_id: tour}, rng, 0.01, 0.01)[map_id]):
            merger.on_change(change)
        merged = merger.merged()
        alive, replaced = active(merged), dict[NodeId, list[NodeId]]()
        for node, fate in merged.superseded.items():
            assert covers(merged, node, fate.by)
            replaced.setdefault(fate.by, []).append(node)
        for item in alive:
            nodes = [item, *replaced.get(item, [])]
            spare = all(any(covers(merged, node, by) for by in alive - {item}) for node in nodes)
            assert not spare, f"{item} could be spared"
    assert len(alive) < 18


def covers(merged: MergedMap, first: NodeId, second: NodeId) -> bool:
    a, b = (merged.maps[node.map].nodes[node] for node in (first, second))
    between = merged.pose(first).inverse() @ merged.pose(second)
    link = verify(*sorted((a, b), key=lambda node: node.id))
    if first.map == second.map or not isinstance(link, Link) or abs(between.heading) > WIDEST:
        return False
    shared = link.shared if link.a == first else link.shared[:, ::-1]
    depths = b.landmarks.has_depth.sum() >= min(DEPTHS * a.landmarks.has_depth.sum(), ENOUGH)
    return bool(depths and least_in_view(shared, a, b, between) >= FOUND)


@pytest.mark.slow
def test_nodes_of_today_are_searched_even_if_superseded(drives: Drives):
    """Another robot's view of the same hour is evidence; an hour later it is past."""
    rng = np.random.default_rng(8)
    merger = drives.merger(OLD)
    tour = [Pose2(1.5 + 0.8 * k, 2.15, 0.25) for k in range(5)]
    nodes, edges = take_map(drives.world, MapId("r2", 1), tour, rng, sigma_xy=0.01, sigma_heading=0.01)
    for k, node in enumerate(nodes):
        nodes[k] = replace(node, stamp_ns=node.stamp_ns + 10**12)
    for change in numbered(MapId("r2", 1), changes_of(nodes, edges)):
        merger.on_change(change)
    merged = merger.merged()
    assert {node.map for node in merged.superseded} == {OLD}
    assert all(node in merger.places for node in merged.poses)
    far = replace(
        nodes[0], id=NodeId("r0", 1, 99), stamp_ns=4 * 10**12, landmarks=nodes[0].landmarks.take([])
    )
    merger.apply(OLD, NodePut(far))
    merged = merger.merged()
    assert merged.superseded and not any(node in merger.places for node in merged.superseded)

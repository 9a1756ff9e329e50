"""The merger: order of arrival, better knowledge, and answers that follow the maps."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mapweave.hybridmap.change import Change, ChangeBody, EdgePut, NodePut, NodeRetired
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import EdgeKind, Node
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import Certainty
from mapweave.hybridmap.route import RouteSettings
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.relocalization.calibration import HypothesisSupport, probabilities
from mapweave.mapserver.relocalization.place_hypotheses import fuse
from mapweave.mapserver.relocalization.relocalizer import RelocalizationSettings, Relocalizer
from mapweave.mapserver.routes import NEAR, Router
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.registration.recognition import examine_matches
from synthetic.maps import changes_of, merger_of
from synthetic.world import Sensing, World, room, take_map, take_view

A, B = MapId("a", 1), MapId("b", 1)
Log = list[tuple[MapId, ChangeBody]]


class Scene:
    """Two robots that share the middle one of three rooms."""

    def __init__(self) -> None:
        rng = np.random.default_rng(1)
        self.world: World = (
            room(0, 0, 5, 4, 500, rng) + room(5, 0, 5, 4, 700, rng) + room(10, 0, 5, 4, 500, rng)
        )
        self.truth: dict[NodeId, Pose2] = {}
        self.logs: dict[MapId, Log] = {}
        for map_id, rooms in ((A, (0, 5)), (B, (5, 10))):
            stops = [Pose2(x + 2.2 + 0.1 * k, 1.8 + 0.05 * k, 0.9 * k) for x in rooms for k in range(7)]
            nodes, edges = take_map(self.world, map_id, stops, rng)
            self.truth |= {node.id: stop for node, stop in zip(nodes, stops, strict=True)}
            self.logs[map_id] = [(map_id, change) for change in changes_of(nodes, edges)]

    def merger(self, log: Log) -> Merger:
        merger = Merger()
        for k, (map_id, body) in enumerate(log):
            merger.on_change(Change(map_id, k + 1, 0, body))
        return merger


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene()


@pytest.fixture(scope="module")
def merger(scene: Scene) -> Merger:
    return scene.merger(scene.logs[A] + scene.logs[B])


def same(first: MergedMap, second: MergedMap) -> bool:
    return (
        [link.pair for link in first.links] == [link.pair for link in second.links]
        and [(r.pair, r.reason) for r in first.refused] == [(r.pair, r.reason) for r in second.refused]
        and first.components == second.components
        and all(
            np.array_equal(p.merged_from_robot.mean.vector, second.poses[n].merged_from_robot.mean.vector)
            for n, p in first.poses.items()
        )
    )


def test_two_maps_become_one(scene: Scene, merger: Merger):
    merged = merger.merged()
    assert len(merged.components) == 1 and merged.joined(A, B)
    anchor = min(scene.truth)
    truth_from_merged = scene.truth[anchor] @ merged.poses[anchor].merged_from_robot.mean.inverse()
    for node, place in merged.poses.items():
        assert scene.truth[node].distance(truth_from_merged @ place.merged_from_robot.mean) < 0.4
    assert merger.merged().summary().startswith("28 nodes, 2 maps, 1 component, ")


def test_order_of_arrival_does_not_matter(scene: Scene, merger: Merger):
    both = [change for pair in zip(scene.logs[B], scene.logs[A], strict=True) for change in pair]
    other = scene.merger(both)
    assert same(merger.merged(), other.merged())


def test_each_pair_is_compared_once_and_nothing_is_done_twice(scene: Scene):
    merger = scene.merger(scene.logs[A])
    first = merger.merged()
    compared = merger.counters.verified
    assert merger.merged() is first
    merger.on_change(Change(A, 99, 0, scene.logs[A][-1][1]))
    assert merger.merged() is not first
    assert merger.counters.verified == compared and merger.counters.merges == 2


def test_a_node_that_is_known_better_is_compared_again(scene: Scene):
    merger = scene.merger(scene.logs[A] + scene.logs[B])
    before = merger.merged()
    compared = merger.counters.verified
    linked = before.links[0].b
    node = merger.node(linked)
    assert node is not None
    merger.on_change(Change(linked.map, 100, 0, NodePut(node)))
    assert same(before, merger.merged())
    assert merger.counters.verified > compared


def test_retired_nodes_take_their_links_along(scene: Scene):
    merger = scene.merger(scene.logs[A] + scene.logs[B][:3])
    assert any(not link.within for link in merger.merged().links)
    gone = [node for node in scene.truth if node.map == B]
    for k, node in enumerate(gone):
        merger.on_change(Change(B, 200 + k, 0, NodeRetired(node)))
    merged = merger.merged()
    assert set(merged.poses) == {node for node in scene.truth if node.map == A}
    assert all(link.within for link in merged.links)
    assert same(merged, scene.merger([*scene.logs[A], (B, NodeRetired(gone[0]))]).merged())


def test_a_merged_map_stays_as_it_was(scene: Scene):
    merger = scene.merger(scene.logs[A])
    merged = merger.merged()
    merger.on_change(Change(A, 300, 0, NodeRetired(min(scene.truth))))
    assert min(scene.truth) in merged.maps[A].nodes


def test_a_map_that_only_others_are_compared_with_is_not_copied(scene: Scene):
    """What is remembered of a map is remembered of its very copy: pieces, and links that were sorted."""
    merger = scene.merger(scene.logs[A])
    before = merger.merged()
    for k, (map_id, body) in enumerate(scene.logs[B]):
        merger.on_change(Change(map_id, k + 1, 0, body))
    after = merger.merged()
    assert len(after.components) == 1 and any(link.a.map == A != link.b.map for link in after.links)
    assert after.maps[A] is before.maps[A]
    merger.on_change(Change(B, 99, 0, NodeRetired(scene.logs[B][0][1].node.id)))  # type: ignore[union-attr]
    assert merger.merged().maps[B] is not after.maps[B]


def test_reading_a_store_gives_the_same_as_merging_live(scene: Scene, merger: Merger):
    other = Merger()
    for map_id, body in scene.logs[B] + scene.logs[A]:
        other.apply(map_id, body)
    assert other.counters.verified == 0
    assert same(merger.merged(), other.merged())


@pytest.mark.parametrize(("clock", "joined"), [("net", False), ("", True)])
def test_robots_that_would_walk_through_each_other_are_not_joined(clock: str, joined: bool):
    """Two robots do the same at the same time in two rooms that look the same: only the clock differs."""
    rng = np.random.default_rng(4)
    one = room(0, 0, 5, 4, 600, rng)
    merger = Merger()
    for map_id, world_from_room in ((A, Pose2()), (B, Pose2(10, 0, 0))):
        stops = [world_from_room @ Pose2(2.2 + 0.1 * k, 1.8 + 0.05 * k, 0.5 * k) for k in range(12)]
        nodes, edges = take_map(one.moved(world_from_room), map_id, stops, rng)
        for body in [*(NodePut(replace(n, clock=clock)) for n in nodes), *map(EdgePut, edges)]:
            merger.apply(map_id, body)
    merged = merger.merged()
    assert merged.joined(A, B) == joined
    assert any("same place at the same time" in r.reason for r in merged.refused) != joined


def relocalizer(merger: Merger) -> Relocalizer:
    return Relocalizer(merger.places, merger.node, merger.merged())


def test_lost_robots_are_found_with_honest_poses(scene: Scene, merger: Merger):
    rng, service = np.random.default_rng(5), relocalizer(merger)
    count, distances, errors = 0, [], []
    for node, stop in list(scene.truth.items())[::2]:
        here = stop @ Pose2(*rng.uniform([-0.3, -0.3, -0.15], [0.3, 0.3, 0.15]))
        view, _ = take_view(scene.world, here, rng)
        answer = service.answer(view)
        if answer.certainty is not Certainty.FOUND:
            continue
        count += 1
        best = answer.candidates[0]
        true = scene.truth[best.node].inverse() @ here
        distances.append(best.node_from_robot.mahalanobis2(true))
        errors.append(best.node_from_robot.mean.distance(true))
        assert 0.5 < best.probability <= 1.0 and best.component == 0 and answer.reason
        expected = merger.merged().poses[best.node].merged_from_robot.mean @ best.node_from_robot.mean
        assert best.merged_from_robot is not None
        assert best.merged_from_robot.mean.distance(expected) < 1e-9
        assert node.map in (A, B)
    assert count >= 11
    assert max(distances) < 20 and np.median(errors) < 0.06


def test_nodes_that_cannot_change_the_answer_are_not_examined(scene: Scene, merger: Merger, monkeypatch):
    """The answer is that of a relocalizer which examines all of them; most of the work is saved."""
    examined: list[NodeId] = []

    def counted(node: Node, *others: Any) -> Any:
        examined.append(node.id)
        return examine_matches(node, *others)

    monkeypatch.setattr("mapweave.mapserver.relocalization.view_registration.examine_matches", counted)
    # No single candidate is enough: then every similar node is examined.
    thorough = Relocalizer(merger.places, merger.node, merger.merged(), RelocalizationSettings(faint=0.0))
    quick, rng, counts = relocalizer(merger), np.random.default_rng(11), np.zeros(2, int)
    for stop in list(scene.truth.values())[::4]:
        view, _ = take_view(scene.world, stop @ Pose2(0.1, -0.1, 0.05), rng)
        examined.clear()
        one = quick.answer(view)
        few = len(examined)
        with monkeypatch.context() as patched:
            patched.setattr("mapweave.mapserver.relocalization.view_registration.ALONE", 1000)
            two = thorough.answer(view)
        if one.certainty is Certainty.FOUND:
            counts += few, len(examined) - few
            assert one.candidates[0].node.map in (A, B)
            own, theirs = one.candidates[0], two.candidates[0] if two.candidates else None
            if theirs is not None and own.merged_from_robot and theirs.merged_from_robot:
                assert own.merged_from_robot.mean.distance(theirs.merged_from_robot.mean) < 0.15
    assert counts[0] > 3 and counts[0] < 0.5 * counts[1]


def test_elsewhere_is_unknown_with_a_reason(scene: Scene, merger: Merger):
    rng, service = np.random.default_rng(6), relocalizer(merger)
    other = room(0, 0, 5, 4, 500, rng)
    for k in range(10):
        view, _ = take_view(other, Pose2(2.5, 2, 0.6 * k), rng)
        answer = service.answer(view)
        assert answer.certainty is Certainty.UNKNOWN and answer.reason and not answer.candidates
    nothing, _ = take_view(other, Pose2(2.5, 2, 0), rng, Sensing(most=3, clutter=0))
    assert "3 features" in service.answer(nothing).reason


def test_two_similar_rooms_are_ambiguous():
    rng = np.random.default_rng(7)
    one = room(0, 0, 5, 4, 500, rng)
    # Walls of points hide nothing: what lies far enough off is not seen from the room between.
    world = one + room(5, 0, 5, 4, 500, rng) + one.moved(Pose2(40, 0, 0))
    stops = [Pose2(x + 2.2, 2, 0.6 * k) for x in (0, 5, 40) for k in range(4)]
    nodes, edges = take_map(world, A, stops, rng)
    merger = merger_of({A: changes_of(nodes, edges)})
    service = relocalizer(merger)
    view, _ = take_view(world, stops[1] @ Pose2(0.1, 0.05, 0.05), rng)
    answer = service.answer(view)
    assert answer.certainty is Certainty.AMBIGUOUS
    assert {nodes[1].id, nodes[9].id} <= {candidate.node for candidate in answer.candidates}
    collected = [candidate.probability for candidate in answer.candidates]
    assert "may be" in answer.reason and max(collected) < 0.9 and sum(collected) < 1.0 + 1e-9
    # In the room between there is nothing to doubt.
    view, _ = take_view(world, stops[5] @ Pose2(0.1, 0.05, 0.05), rng)
    assert service.answer(view).certainty is Certainty.FOUND


@pytest.mark.slow
def test_maps_that_nothing_joins_are_not_silently_confused(scene: Scene):
    """Two robots mapped the same room, and no merged map says so yet."""
    rng = np.random.default_rng(8)
    merger = Merger()
    stop = Pose2(2.5, 2.0, 0.4)
    for map_id in (A, B):
        nodes, _ = take_map(scene.world, map_id, [stop], rng)
        merger.apply(map_id, NodePut(nodes[0]))
    service = Relocalizer(merger.places, merger.node, MergedMap.empty())
    view, _ = take_view(scene.world, stop, rng)
    answer = service.answer(view)
    assert answer.certainty is Certainty.AMBIGUOUS and "nothing joins" in answer.reason
    assert all(c.merged_from_robot is None and c.component == -1 for c in answer.candidates)


def test_fusing_never_claims_more_than_the_better_estimate_and_both_allow(scene: Scene, merger: Merger):
    rng = np.random.default_rng(9)
    view, _ = take_view(scene.world, min(scene.truth.items())[1], rng)
    first = relocalizer(merger).answer(view).candidates[0].node_from_robot
    again = fuse(first, first)
    assert np.allclose(again.covariance, first.covariance, rtol=1e-4)
    assert again.mean.distance(first.mean) < 1e-9


def test_probability_grows_with_support_and_falls_with_rivals():
    def probability(**changes: float) -> float:
        known = {"inliers": 20, "share": 0.7, "seen": 0.4, "matches": 1, "others": 0.0}
        return probabilities([HypothesisSupport(**{**known, **changes})])[0]  # type: ignore[arg-type]

    more = [probability(inliers=n) for n in (10, 20, 40, 80)]
    rivals = [probability(others=share) for share in (0.0, 0.5, 1.0, 2.0)]
    assert more == sorted(more) and rivals == sorted(rivals, reverse=True)
    assert probability(share=0.9) > probability(share=0.4) and probability(matches=3) >= probability()
    assert probability(inliers=60) > 0.95, "nothing speaks against it"
    twin = HypothesisSupport(60, 0.8, 0.5, 2, 1.0)
    assert probabilities([twin, twin]) == pytest.approx([0.5, 0.5], abs=0.1), "one of two that look the same"


def test_routes_lead_from_map_to_map_by_measured_edges(scene: Scene, merger: Merger):
    merged = merger.merged()
    router = Router(merged)
    start, goal = min(scene.truth), max(scene.truth)
    answer = router.route(start, goal)
    assert [answer.legs[0].node.id, answer.legs[-1].node.id] == [start, goal]
    assert answer.legs[0].kind is None
    edges = {frozenset((e.a, e.b)): e for e in merged.union().edges.values()}
    for before, leg in zip(answer.legs[:-1], answer.legs[1:], strict=True):
        edge = edges.get(frozenset((before.node.id, leg.node.id)))
        if edge is None:  # two nodes in one place that look in different directions
            assert leg.kind is EdgeKind.LOOP
            assert leg.previous_from_node.mean.distance(Pose2()) < NEAR
        else:
            assert leg.kind is edge.kind
        true = scene.truth[before.node.id].inverse() @ scene.truth[leg.node.id]
        assert leg.previous_from_node.mahalanobis2(true) < 30
    hop = (answer.legs[0].node.id, answer.legs[1].node.id)
    around = router.route(start, goal, [hop[::-1]])
    assert all(
        {a.node.id, b.node.id} != set(hop) for a, b in zip(around.legs[:-1], around.legs[1:], strict=True)
    )


def test_a_route_begins_near_the_robot(scene: Scene, merger: Merger):
    """A robot that knows itself by a node seen from afar does not first drive there."""
    router = Router(merger.merged())
    start, goal = min(scene.truth), max(scene.truth)
    far = max(scene.truth, key=lambda n: (n.map == start.map) * scene.truth[n].distance(scene.truth[start]))
    start_from_robot = scene.truth[start].inverse() @ scene.truth[far]
    legs = router.route(start, goal, start_from_robot=start_from_robot).legs
    first = scene.truth[legs[0].node.id]
    assert first.distance(scene.truth[far]) < min(1.0, first.distance(scene.truth[start]))
    # Its pose is given relative to the node of the robot.
    assert legs[0].previous_from_node.mean.distance(scene.truth[start].inverse() @ first) < 0.2


def test_long_undriven_links_are_avoided(scene: Scene, merger: Merger):
    merged = merger.merged()
    start, goal = min(scene.truth), max(scene.truth)
    bold = RouteSettings(per_undriven=0.0)
    undriven = {EdgeKind.LOOP, EdgeKind.MERGED}

    def longest(router: Router) -> float:
        legs = router.route(start, goal).legs
        return max(
            (leg.previous_from_node.mean.distance(Pose2()) for leg in legs if leg.kind in undriven),
            default=0.0,
        )

    assert longest(Router(merged)) <= longest(Router(merged, bold))


def test_missing_routes_have_a_reason(scene: Scene):
    merger = scene.merger(scene.logs[A])
    merger.apply(B, scene.logs[B][13][1])
    router = Router(merger.merged())
    alone = next(node for node in merger.merged().poses if node.map == B)
    assert "nothing joins" in router.route(min(scene.truth), alone).reason
    assert "not in the merged map" in router.route(NodeId("z", 1, 1), alone).reason
    assert router.route(alone, alone).legs[0].node.id == alone

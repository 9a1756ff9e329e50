"""Every number of an explanation, computed a second time in another way."""

import math
from dataclasses import replace

import numpy as np
import pytest

from mapweave.hybridmap.change import EdgePut, NodePut, NodeRetired
from mapweave.hybridmap.constraint_subject import Apart, Linked, RetiredMap
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.explanation import Standing
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints, reason_of
from mapweave.hybridmap.node import Edge, EdgeKind
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.mapserver.merging.merger import Merger
from mapweave.merge.explanation.component_changes import joined_maps, joinings, partings
from mapweave.merge.explanation.map_explanation import explain_fleet, explain_maps
from mapweave.merge.explanation.node_explanation import explain_nodes
from mapweave.merge.explanation.own_edges import reach_words
from mapweave.merge.outlier_rejection.link_probability import (
    LEAST_AREA,
    link_probabilities,
    prior_odds,
    standpoints,
)
from mapweave.merge.outlier_rejection.segmentation import fragments_of
from mapweave.merge.pose_graph.component import solve_graph
from mapweave.merge.pose_graph.factors import LEAST_SIGMAS, LOOP_FLOOR, RelativePose
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.settings import ConsistencySettings
from mapweave.registration.recognition import RecognitionSettings
from synthetic.maps import map_tours, merger_of
from synthetic.world import room

A, B, C = MapId("a", 1), MapId("b", 1), MapId("c", 1)


@pytest.fixture(scope="module")
def merged() -> MergedMap:
    """Two robots in two rooms, of which they share one; a third in a room of its own."""
    return fleet().merged()


def fleet() -> Merger:
    rng = np.random.default_rng(5)
    world = room(0, 0, 5, 4, 600, rng) + room(5, 0, 5, 4, 800, rng) + room(20, 0, 5, 4, 600, rng)
    return merger_of(map_tours(world, {A: tour(0, 5), B: tour(5), C: tour(20)}, rng))


def tour(*rooms: float) -> list[Pose2]:
    """A turn in each room, which begins at this x."""
    return [Pose2(x + 2.2 + 0.1 * k, 1.8 + 0.05 * k, 0.9 * k) for x in rooms for k in range(6)]


def between(merged: MergedMap) -> list[Link]:
    return [link for link in merged.links if not link.within]


def test_residuals_are_those_of_the_pinhole(merged: MergedMap):
    link = between(merged)[0]
    explanation = explain_nodes(merged, link.b, link.a)
    assert explanation.standing is Standing.LINKED and (explanation.a.id, explanation.b.id) == link.pair
    a, b, camera = explanation.a.landmarks, explanation.b.landmarks, explanation.a.camera
    x, y, heading = link.a_from_b.mean.vector
    turn = np.array([[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]])
    for (i, j), residual in zip(explanation.shared, explanation.residuals_px, strict=True):
        here, there, inverse = (a, b, False) if np.isfinite(a.depths[i]) else (b, a, True)
        k, other = (j, i) if inverse else (i, j)
        depth = float(here.depths[k])
        u, v = here.pixels[k]
        point = np.array([depth + camera.mount_forward, -(u - camera.cx) / camera.fx * depth])
        height = camera.mount_height - (v - camera.cy) / camera.fy * depth
        seen = turn @ point + [x, y] if inverse else turn.T @ (point - [x, y])
        ahead = seen[0] - camera.mount_forward
        predicted = [
            camera.cx - camera.fx * seen[1] / ahead,
            camera.cy - camera.fy * (height - camera.mount_height) / ahead,
        ]
        assert residual == pytest.approx(np.linalg.norm(predicted - there.pixels[other]), abs=1e-3)
    assert {tuple(pair) for pair in explanation.shared} <= {tuple(pair) for pair in explanation.matches}


def test_the_misfit_is_the_difference_to_the_merged_poses(merged: MergedMap):
    for link in between(merged)[:5]:
        misfit = explain_nodes(merged, *link.pair).misfit
        assert misfit is not None
        a, b = (merged.poses[node].merged_from_robot.mean for node in link.pair)
        off = (link.a_from_b.mean.inverse() @ a.inverse() @ b).vector
        assert np.allclose(misfit.off, off, atol=1e-12)
        own = link.a_from_b.covariance + np.diag(LEAST_SIGMAS**2)
        assert misfit.strain2 == pytest.approx(off @ np.linalg.inv(own) @ off, rel=1e-9)
        assert not misfit.alone


def without(merged: MergedMap, left_out: Link | None) -> PoseGaussian:
    """The relative pose of a link's nodes in a graph that is solved again without it."""
    assert left_out is not None
    measurements = [m for fragment in fragments_of(merged.maps) for m in fragment.measurements]
    measurements += [
        RelativePose(*link.pair, link.a_from_b, robust=True) for link in merged.links if link is not left_out
    ]
    graph = solve_graph(left_out.a, Pose2(), measurements)
    result = graph.relative([left_out.a], [left_out.b])
    return PoseGaussian(Pose2.from_vector(result.means[0]), result.covariances[0])


def test_leaving_a_link_out_is_as_good_as_solving_without_it(merged: MergedMap):
    links = between(merged)
    graph = merged.graphs[0]
    result = standpoints(links, graph, kept=True)
    area = max(np.prod(np.ptp(graph.means[:, :2], axis=0)), LEAST_AREA)
    for link, one in list(zip(links, result, strict=True))[::3]:
        rest = without(merged, link)
        off = (link.a_from_b.mean.inverse() @ rest.mean).vector
        spread = link.a_from_b.covariance + np.diag(LEAST_SIGMAS**2) + rest.covariance + LOOP_FLOOR
        density = math.exp(-0.5 * off @ np.linalg.inv(spread) @ off) / math.sqrt(
            np.linalg.det(2 * np.pi * spread)
        )
        # The graph is not quite linear, and without a link the others are weighed a little otherwise.
        assert one.log_factor == pytest.approx(math.log(density * area * 2 * np.pi), abs=0.1)


def test_what_is_left_of_a_residual_is_foretold_without_solving(merged: MergedMap):
    own = [m for fragment in fragments_of(merged.maps) for m in fragment.measurements]
    links = between(merged)
    rng = np.random.default_rng(5)
    for link in links[::3]:
        wrong = link.a_from_b.mean @ Pose2.from_vector(rng.normal(0.0, [0.2, 0.2, 0.1]))
        rest = own + [RelativePose(*x.pair, x.a_from_b, robust=True) for x in links if x is not link]
        asked = Link(*link.pair, PoseGaussian(wrong, link.a_from_b.covariance), link.shared, link.evidence)
        (foretold,) = standpoints([asked], solve_graph(link.a, Pose2(), rest), kept=False)
        floored = asked.a_from_b.covariance + LOOP_FLOOR
        solved = solve_graph(
            link.a, Pose2(), [*rest, RelativePose(*link.pair, PoseGaussian(wrong, floored), robust=True)]
        )
        off = (wrong.inverse() @ Pose2.from_vector(solved.relative([link.a], [link.b]).means[0])).vector
        floored += np.diag(LEAST_SIGMAS**2)
        # The graph is not quite linear.
        assert foretold.residual2 == pytest.approx(off @ np.linalg.solve(floored, off), rel=0.02, abs=0.05)


def test_a_link_that_alone_joins_has_the_odds_of_all_links(merged: MergedMap):
    link = between(merged)[0]
    graph = solve_graph(
        link.a,
        Pose2(),
        [m for f in fragments_of(merged.maps) for m in f.measurements]
        + [RelativePose(*link.pair, link.a_from_b, robust=True)],
    )
    (result,) = standpoints([link], graph, kept=True)
    assert result.alone and result.log_factor == 0.0


def test_false_links_are_improbable_and_true_ones_are_not(merged: MergedMap):
    rng = np.random.default_rng(1)
    true = link_probabilities(merged)
    assert len(true) == len(merged.links) and min(true.values()) > 0.9
    links = between(merged)
    shifted = [
        Link(x.a, x.b, PoseGaussian(x.a_from_b.mean @ Pose2(*rng.uniform(-2, 2, 2), rng.uniform(-3, 3)),
             x.a_from_b.covariance), x.shared, x.evidence)
        for x in links
    ]  # fmt: skip
    assert all(
        standpoint.log_factor < -10 for standpoint in standpoints(shifted, merged.graphs[0], kept=False)
    )
    assert prior_odds(merged) > 1


def test_other_links_close_loops_as_composed_poses(merged: MergedMap):
    link = between(merged)[1]
    explanation = explain_nodes(merged, *link.pair)
    s = ConsistencySettings()
    by_pair = {other.pair: other for other in merged.links}
    pieces = {node: fragment for fragment in fragments_of(merged.maps) for node in fragment.nodes}
    assert len(explanation.other_links) >= 3
    for other_link in explanation.other_links:
        if (other_link.a, other_link.b) not in by_pair:
            continue
        # The merge begins each loop at the smaller pair.
        one, other = sorted([link, by_pair[other_link.a, other_link.b]], key=lambda x: x.pair)
        back = pieces[one.b].graph.relative([one.b], [other.b])
        home = pieces[one.a].graph.relative([other.a], [one.a])
        there, here = (PoseGaussian(Pose2.from_vector(r.means[0]), r.covariances[0]) for r in (back, home))
        loop = one.a_from_b @ there @ other.a_from_b.inverse() @ here
        floor = np.diag([0.02, 0.02, 0.01]) ** 2
        distance2 = PoseGaussian(loop.mean, loop.covariance + floor).mahalanobis2(Pose2())
        assert other_link.distance2 == pytest.approx(distance2, rel=1e-6)
        assert other_link.agrees == (distance2 < s.gate) and other_link.kept


def test_refused_pairs_say_what_they_lack(merged: MergedMap):
    refused = next(r for r in merged.refused if r.link is None and r.edge is None)
    explanation = explain_nodes(merged, refused.a, refused.b)
    assert (explanation.standing, explanation.reason) == (Standing.REFUSED, refused.reason)
    assert explanation.probability is None and len(explanation.matches) > 0


def test_too_few_inliers_are_reported_with_their_pose(merged: MergedMap):
    link = between(merged)[0]
    strict = RecognitionSettings(least_inliers=12)
    # One of the two nodes has kept eleven landmarks, all of which agree.
    shared = link.shared[:11]
    a = merged.maps[link.a.map].nodes[link.a]
    few = HybridMap([NodePut(replace(a, landmarks=a.landmarks.take(shared[:, 0])))])
    both = replace(merged, maps={**merged.maps, link.a.map: few}, links=(), refused=())
    explanation = explain_nodes(both, *link.pair, strict)
    assert explanation.standing is Standing.UNCOMPARED and explanation.a_from_b is None
    assert "11 features match" in explanation.reason
    explanation = explain_nodes(both, *link.pair, RecognitionSettings(least_cells=25))
    assert explanation.reason.endswith("of 24 image cells") and explanation.a_from_b is not None
    assert len(explanation.shared) == explanation.evidence["inliers"] == len(explanation.residuals_px) >= 10
    assert {(int(shared[i, 0]), int(j)) for i, j in explanation.shared} <= set(map(tuple, shared.tolist()))
    assert explanation.a_from_b.mean.distance(link.a_from_b.mean) < 0.1
    assert explanation.misfit is not None
    assert explanation.other_links == () and explanation.probability is None


def test_pairs_that_were_not_compared_are_compared_now(merged: MergedMap):
    explanation = explain_nodes(merged, sorted(merged.maps[A].nodes)[0], sorted(merged.maps[C].nodes)[0])
    assert explanation.standing is Standing.UNCOMPARED and "compared now: " in explanation.reason


def test_a_robots_own_edge_is_explained_with_its_pose(merged: MergedMap):
    edge = min(merged.maps[A].edges.values(), key=lambda edge: edge.id)
    explanation = explain_nodes(merged, edge.b, edge.a)
    assert explanation.standing is Standing.OWN and explanation.reason.endswith(f" (edge {edge.id})")
    assert explanation.a_from_b is edge.a_from_b
    assert explanation.probability is None and not explanation.other_links
    assert explanation.misfit is not None and not explanation.claims
    relative = merged.relative(edge.a, edge.b)
    assert relative is not None
    off = (edge.a_from_b.mean.inverse() @ relative.mean).vector
    assert np.allclose(explanation.misfit.off, off, atol=1e-9)


def test_a_robots_own_loop_closure_is_explained_with_its_constraints():
    merger = fleet()
    first, *_, last = sorted(merger.merged().maps[A].nodes)
    true = merger.merged().relative(first, last)
    assert true is not None
    loop = Edge(NodeId("a", 1, 99), first, last, true, EdgeKind.LOOP)
    merger.apply(A, EdgePut(loop))
    explanation = explain_nodes(merger.merged(), first, last)
    assert explanation.standing is Standing.OWN and explanation.probability is not None
    constraint = ManualConstraint(Apart((first, last)), True, "anna", 0, "no")
    merger.constrain(ManualConstraints([constraint]))
    explanation = explain_nodes(merger.merged(), first, last)
    assert explanation.standing is Standing.UNDONE and explanation.reason == reason_of(constraint)
    assert any("(edge a.1.99); refused: undone by anna" in claim for claim in explanation.claims)
    wrong = replace(loop, a_from_b=PoseGaussian(true.mean @ Pose2(2.0, 1.0, 1.0), true.covariance))
    merger.constrain(ManualConstraints())
    merger.apply(A, EdgePut(wrong))
    explanation = explain_nodes(merger.merged(), first, last)
    assert explanation.standing is Standing.REFUSED and "contradicts" in explanation.reason
    assert explanation.misfit is not None and explanation.misfit.strain2 > 100.0


def test_landmarks_that_have_faded_hold_no_servo(merged: MergedMap):
    link = next(item for item in between(merged) if "can be driven" in reach_words(merged, item.edge()))
    count = len(merged.maps[link.a.map].nodes[link.a].landmarks)
    faded = replace(merged, faded={link.a: np.ones(count, np.bool_)})
    explanation = explain_nodes(faded, *link.pair)
    (words,) = [claim for claim in explanation.claims if claim.startswith("the link ")]
    assert "not driven: no landmark stays in view" in words
    assert words.endswith(f"({len(link.shared)} more have faded)")


def test_two_maps(merged: MergedMap):
    one = explain_maps(merged, B, A)
    assert one.joined and one.links == len(between(merged)) and "are one map" in one.reason
    assert one.landmarks == sum(int(link.evidence["inliers"]) for link in between(merged))
    weights = sorted(link.weight for link in between(merged))
    assert [near.inliers for near in one.nearest] == weights[:5]
    apart = explain_maps(merged, A, C)
    assert not apart.joined and "are not one map" in apart.reason
    assert apart.unverified == sum({r.a.map, r.b.map} == {A, C} for r in merged.refused)
    assert [e.joined for e in explain_fleet(merged, 10)] == [False, False, True]
    every = explain_fleet(merged, 10)
    assert every == tuple(explain_maps(merged, one.second, one.first) for one in every)


def test_manual_constraints_are_listed():
    merger = fleet()
    link = between(merger.merged())[0]
    constraint = ManualConstraint(Apart(link.pair), True, "anna", 0, "no")
    merger.constrain(ManualConstraints([constraint]))
    explanation = explain_nodes(merger.merged(), *link.pair)
    assert explanation.standing is Standing.UNDONE and explanation.constraints == (constraint,)
    assert explanation.probability is not None and explanation.probability > 0.9, (
        "a manual constraint changes no measurement"
    )
    merger.constrain(ManualConstraints([ManualConstraint(Apart((A, B)), True, "anna", 0, "no")]))
    apart = explain_maps(merger.merged(), A, B)
    assert not apart.joined and "undone" in apart.reason and len(apart.nearest) == 5


def test_a_merge_that_loses_its_support_is_reported():
    merger = fleet()
    alone = MergedMap.empty()
    before = merger.merged()
    parts = joined_maps(before)
    assert partings(parts, before.links, before) == () == joinings(parts, before)
    (joined,) = [joining for joining in joinings(joined_maps(alone), before) if "a.1 and b.1" in joining]
    assert joined == f"a.1 and b.1 are one map now, by {len(between(before))} links"
    assert joined in joinings([frozenset([B])], before)  # whichever of the two was heard of first
    merger.constrain(ManualConstraints([ManualConstraint(Apart((A, B)), True, "anna", 0, "no")]))
    for links in (before.links, None):
        (words,) = partings(parts, links, merger.merged())
        assert words.startswith("a.1 and b.1 are no longer one map: ") and "refused (undone" in words
    merger.constrain(ManualConstraints())
    for node in before.maps[B].nodes:
        merger.apply(B, NodeRetired(node))
    assert partings(parts, before.links, merger.merged()) == ()  # a map without nodes is part of nothing


def test_a_split_by_a_link_that_is_taken_back_names_the_person():
    merger = fleet()
    linked = Linked.of(NodeId("a", 1, 1), NodeId("c", 1, 1), PoseGaussian.from_sigmas(Pose2(9.0), 0.1, 0.1))
    by_hand = ManualConstraint(linked, True, "anna", 0, "through the yard")
    merger.constrain(ManualConstraints([by_hand]))
    before = merger.merged()
    assert before.joined(A, C)
    back = ManualConstraint(linked, False, "berta", 60 * 10**9, "another yard")
    merger.constrain(ManualConstraints([by_hand, back]))
    (words,) = partings(joined_maps(before), before.links, merger.merged())
    assert words == (
        "a.1+b.1 and c.1 are no longer one map: 1 link by hand taken back by berta on "
        '1970-01-01 00:01 UTC: "another yard"'
    )


def test_joint_merges_are_listed_map_by_map_and_each_link_once():
    """A server that starts again joins all maps with one merge; it listed some links twice."""
    rng = np.random.default_rng(5)
    world = room(0, 0, 5, 4, 900, rng)
    stops = [Pose2(2.2 + 0.1 * k, 1.8, 0.9 * k) for k in range(4)]
    merged = merger_of(map_tours(world, {MapId(name, 1): stops for name in "abcdef"}, rng)).merged()
    assert len(merged.components) == 1
    result = joinings((), merged)
    assert len(result) == 5 and result[0].startswith("a.1 and ") and result[1].startswith("a.1+")
    assert result[-1].startswith("5 maps with a.1 and ")
    count = sum(int(words.rsplit(" by ", 1)[1].split()[0]) for words in result)
    assert count == sum(not link.within for link in merged.links)


def test_the_number_of_many_separated_maps_is_given():
    one = MapId("a", 1)
    node = NodeId(*one, 1)
    sides = [[MapId(f"{side}{k}", 1) for k in range(count)] for side, count in (("x", 300), ("y", 2))]
    maps = {name: HybridMap() for side in sides for name in side}
    parts = tuple(frozenset(node._replace(agent=name.agent) for name in side) for side in sides)
    apart = MergedMap(maps, (), (), parts, {})
    (words,) = partings([frozenset(maps)], [], apart)
    assert words.startswith("300 maps with x0.1 and y0.1+y1.1 are no longer one map: ")


def test_a_split_by_a_retired_map_names_the_person():
    """Two robots in two rooms, and one that has been in both."""
    rng = np.random.default_rng(5)
    world = room(0, 0, 5, 4, 600, rng) + room(5, 0, 5, 4, 800, rng)
    merger = merger_of(map_tours(world, {A: tour(0), B: tour(0, 5), C: tour(5)}, rng))
    before = merger.merged()
    assert before.joined(A, C)
    constraint = ManualConstraint(RetiredMap(B), True, "anna", 0, "moved house")
    merger.constrain(ManualConstraints([constraint]))
    (words,) = partings(joined_maps(before), before.links, merger.merged())
    assert words.startswith("a.1 and c.1 are no longer one map: ")
    assert words.endswith(f" gone, since {reason_of(constraint)}") and "moved house" in words


@pytest.mark.parametrize(
    ("a", "b", "words"),
    [
        (NodeId("a", 1, 1), NodeId("a", 1, 1), "give two nodes"),
        (NodeId("z", 1, 1), NodeId("a", 1, 1), "there is no map z.1; known are: a.1, b.1, c.1"),
        (NodeId("a", 1, 99), NodeId("a", 1, 1), "of its 12 nodes the nearest are 17, 19, 21, 23"),
    ],
)
def test_missing_nodes_cannot_be_explained(merged: MergedMap, a: NodeId, b: NodeId, words: str):
    with pytest.raises(InvalidValue, match=words):
        explain_nodes(merged, a, b)
    with pytest.raises(InvalidValue, match="two maps"):
        explain_maps(merged, A, A)

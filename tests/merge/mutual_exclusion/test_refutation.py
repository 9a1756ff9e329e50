"""Merges that cannot be true are not made: twin rooms, with a clock and without, closed and joined."""

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind, Landmarks, Node
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from mapweave.merge.merging import MergeCache, decide, merge_maps
from mapweave.merge.mutual_exclusion.refutation import Refutation
from mapweave.merge.outlier_rejection.segmentation import fragments_of
from mapweave.merge.pose_graph.component_solver import ComponentSolver
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.settings import ExclusionSettings, MergeSettings

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, 0.3)
EDGE_SIGMAS = np.array([0.006, 0.005, 0.005])
LINK_SIGMAS = np.array([0.02, 0.02, 0.01])
EAST = Pose2(10.0, 0.0, 0.0)
"""Where the second of two rooms is that look alike."""

Fleet = dict[MapId, HybridMap]
Truth = dict[NodeId, Pose2]


def tour(places: Array) -> list[Pose2]:
    """Through (N, 2) places, always looking ahead."""
    steps = np.diff(places, axis=0, append=places[-1:] + np.array([[1.0, 0.0]]))
    return [Pose2(x, y, float(np.arctan2(v, u))) for (x, y), (u, v) in zip(places, steps, strict=True)]


def in_room(rng: np.random.Generator, n: int = 30) -> Array:
    """(N, 2) m, a walk in a room of 4 by 3 m in steps of half a metre that ends at the door at (2, 0)."""
    outcome = [np.array([2.0, 0.3])]
    while len(outcome) < n:
        angle = rng.uniform(-np.pi, np.pi)
        place = outcome[-1] + 0.5 * np.array([np.cos(angle), np.sin(angle)])
        if (place > [0.3, 0.3]).all() and (place < [3.7, 2.7]).all():
            outcome.append(place)
    return np.array(outcome[::-1])


def mapped(
    agent: str, stops: Sequence[Pose2], rng: np.random.Generator, clock: str = "net", start: float = 0.0
) -> tuple[HybridMap, Truth]:
    """A robot's map of a tour that takes it four seconds a stop, and the truth."""
    ids = [NodeId(agent, 1, 2 * k + 1) for k in range(len(stops))]
    pose = PoseGaussian(Pose2(), np.zeros((3, 3)))
    hybrid_map = HybridMap()
    for k, node_id in enumerate(ids):
        if k:
            noise = Pose2.from_vector(rng.normal(0, EDGE_SIGMAS))
            step = PoseGaussian(stops[k - 1].inverse() @ stops[k] @ noise, np.diag(EDGE_SIGMAS**2))
            pose = pose @ step
        stamp = round((start + 4.0 * k) * 1e9)
        hybrid_map.apply(NodePut(Node(node_id, stamp, pose, CAMERA, Landmarks.empty(), clock)))
        if k:
            edge_id = NodeId(agent, 1, 2 * k)
            hybrid_map.apply(EdgePut(Edge(edge_id, ids[k - 1], node_id, step, EdgeKind.MAPPED)))
    return hybrid_map, dict(zip(ids, stops, strict=True))


def links(
    first: Truth, second: Truth, pairs: Sequence[tuple[int, int]], rng: np.random.Generator,
    shift: Pose2 | None = None, inliers: int = 30,
) -> list[Link]:  # fmt: skip
    """Links between stops; `shift` is where the second robot's world is taken for the first one's."""
    a, b = list(first), list(second)
    collected = []
    for i, j in pairs:
        true = first[a[i]].inverse() @ (shift or Pose2()) @ second[b[j]]
        mean = true @ Pose2.from_vector(rng.normal(0, LINK_SIGMAS))
        evidence = {"inliers": float(inliers), "share": 0.8}
        collected.append(
            Link(a[i], b[j], PoseGaussian(mean, np.diag(LINK_SIGMAS**2)), evidence=evidence).canonical()
        )
    return collected


class Twins:
    """Robots a and b do much the same at the same time in rooms that look the same; then both come out."""

    def __init__(self, seed: int, clock: str = "net", late: float = 0.0) -> None:
        rng = np.random.default_rng(seed)
        inside = in_room(rng)
        beside = inside + rng.normal(0, 0.05, inside.shape)
        out = np.array([[2.0, -0.2], [2.0, -0.7], [2.0, -1.2]])
        # In the corridor a goes east and b goes west, one beside the other.
        a = np.concatenate([inside, out, [[2.5 + 0.5 * k, -1.2] for k in range(20)]])
        b = np.concatenate([beside, out, [[1.5 - 0.5 * k, -1.8] for k in range(20)]])
        b += EAST.vector[:2]
        self.rng = rng
        self.a, self.truth_a = mapped("a", tour(a), rng, clock)
        self.b, self.truth_b = mapped("b", tour(b), rng, clock, late)
        self.maps: Fleet = {MapId("a", 1): self.a, MapId("b", 1): self.b}
        self.false = links(
            self.truth_a, self.truth_b, [(3 * k, 3 * k) for k in range(10)], rng, EAST.inverse()
        )

    def corridor(self, n: int, inliers: int = 15) -> list[Link]:
        """True links, between places that both came by."""
        pairs = [(51 - k, 36 + k) for k in range(n)]
        return links(self.truth_a, self.truth_b, pairs, self.rng, inliers=inliers)


def pairs(result: Sequence[Link]) -> set[tuple[NodeId, NodeId]]:
    return {link.pair for link in result}


@pytest.mark.parametrize("seed", [1, 2])
def test_closed_twins_stay_two(seed: int):
    twins = Twins(seed)
    merged = merge_maps(twins.maps, twins.false)
    assert len(merged.components) == 2 and not merged.links
    assert pairs([r.link for r in merged.refused if r.link]) == pairs(twins.false)
    explanation = merged.explain(*twins.false[0].pair)
    assert "are not linked: a and b would have been at the same place at the same time: 0.0" in explanation
    assert "such moments" in explanation


@pytest.mark.parametrize(("clock", "late"), [("", 0.0), ("net", 500.0)])
def test_without_a_clock_or_at_other_times_there_is_no_evidence(clock: str, late: float):
    """A false set without contradiction is kept; with the true one as well, neither is."""
    twins = Twins(1, clock, late)
    merged = merge_maps(twins.maps, twins.false)
    assert pairs(merged.links) == pairs(twins.false)
    merged = merge_maps(twins.maps, twins.false + twins.corridor(4))
    assert not merged.links and len(merged.components) == 2
    assert "ambiguous" in merged.explain(*twins.false[0].pair)


def test_different_clocks_give_no_evidence():
    twins = Twins(1)
    for node in list(twins.b.nodes.values()):
        twins.b.apply(NodePut(replace(node, clock="own")))
    assert pairs(merge_maps(twins.maps, twins.false).links) == pairs(twins.false)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_corridor_between_twins_joins_them(seed: int):
    """The false links are many more, and fall; the true ones, contradicted before, are enough."""
    twins = Twins(seed)
    true = twins.corridor(4)
    merged = merge_maps(twins.maps, twins.false + true)
    assert pairs(merged.links) == pairs(true)
    assert len(merged.components) == 1
    assert error(merged, twins.truth_a | twins.truth_b) < 1.0
    assert all("same place at the same time" in merged.explain(*link.pair) for link in twins.false)


def test_of_two_equal_sets_the_possible_one_is_kept():
    twins = Twins(1)
    true = twins.corridor(10, inliers=30)
    assert pairs(merge_maps(twins.maps, twins.false + true).links) == pairs(true)
    blind = Twins(1, clock="")
    assert not merge_maps(blind.maps, blind.false + true).links


def error(merged: MergedMap, truth: Truth) -> float:
    """Largest error of positions of component 0, held at its anchor, m."""
    anchor = min(merged.components[0])
    back = truth[anchor] @ merged.poses[anchor].merged_from_robot.mean.inverse()
    return max(
        (back @ merged.poses[node].merged_from_robot.mean).distance(truth[node])
        for node in merged.components[0]
    )


def test_twins_that_a_third_map_joins_come_apart_at_the_weakest_links():
    """Robot c came later into the room of b, and is taken to have been in that of a as well."""
    twins = Twins(1)
    rng = np.random.default_rng(5)
    stops = [stop @ Pose2(0.05, 0.0, 0.0) for stop in list(twins.truth_b.values())[:30]]
    later, truth_c = mapped("c", stops, rng, start=1000.0)
    true = links(twins.truth_b, truth_c, [(3 * k, 3 * k) for k in range(10)], rng)
    false = links(twins.truth_a, truth_c, [(3 * k, 3 * k) for k in range(6)], rng, EAST.inverse(), inliers=20)
    merged = merge_maps(twins.maps | {MapId("c", 1): later}, false + true)
    assert pairs(merged.links) == pairs(true)
    assert len(merged.components) == 2
    reason = merged.explain(*false[0].pair)
    assert "a and b would have been at the same place" in reason and "weakest links" in reason


def test_a_link_by_hand_that_cannot_be_true_stays_and_is_reported():
    twins = Twins(1)
    s = MergeSettings()
    by_hand = twins.false[:1]
    merged, _ = decide(twins.maps, twins.false[1:], (), s, MergeCache(), certain=by_hand)
    assert pairs(by_hand) <= pairs(merged.links) and len(merged.components) == 1
    assert "a and b would have been at the same place" in merged.contradicted[by_hand[0].pair]
    # By way of a third robot's map, which came later: the true links to it are not to blame.
    rng = np.random.default_rng(5)
    stops = [stop @ Pose2(0.05, 0.0, 0.0) for stop in list(twins.truth_b.values())[:30]]
    later, truth_c = mapped("c", stops, rng, start=1000.0)
    true = links(twins.truth_b, truth_c, [(3 * k, 3 * k) for k in range(10)], rng)
    false = links(twins.truth_a, truth_c, [(6, 6)], rng, EAST.inverse())
    merged, _ = decide(twins.maps | {MapId("c", 1): later}, true, (), s, MergeCache(), certain=false)
    assert pairs(false) <= pairs(merged.links) and len(merged.components) == 2
    merged, _ = decide(
        twins.maps | {MapId("c", 1): later}, (), (), s, MergeCache(), certain=[*false, true[0]]
    )
    assert len(merged.components) == 1
    assert all("links by hand join the two" in merged.contradicted[p] for p in pairs(false))


def test_true_merges_of_robots_that_map_together_are_kept():
    """Two robots go through one room side by side, 0.35 m apart, with noise in edges and links."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        inside = in_room(rng)
        a, truth_a = mapped("a", tour(inside), rng)
        b, truth_b = mapped("b", tour(inside + np.array([0.35, 0.0])), rng)
        true = links(truth_a, truth_b, [(3 * k, 3 * k) for k in range(10)], rng)
        merged = merge_maps({MapId("a", 1): a, MapId("b", 1): b}, true)
        assert len(merged.components) == 1 and not any("same place" in r.reason for r in merged.refused)


def test_order_does_not_matter():
    twins = Twins(2)
    given = twins.false + twins.corridor(4)
    first = merge_maps(twins.maps, given)
    second = merge_maps(dict(reversed(twins.maps.items())), given[::-1])
    assert [link.pair for link in first.links] == [link.pair for link in second.links]
    assert [(r.pair, r.reason) for r in first.refused] == [(r.pair, r.reason) for r in second.refused]
    for node, place in first.poses.items():
        other = second.poses[node].merged_from_robot.mean
        assert np.array_equal(place.merged_from_robot.mean.vector, other.vector)


def test_looking_at_a_thousand_nodes_takes_no_time():
    rng = np.random.default_rng(1)
    maps: Fleet = {}
    truths = []
    for k, agent in enumerate("abcd"):
        places = in_room(rng, 250) + np.array([0.0, 4.0 * k])
        maps[MapId(agent, 1)], truth = mapped(agent, tour(places), rng)
        truths.append(truth)
    joining = [
        link for truth in truths[1:]
        for link in links(truths[0], truth, [(60 * k, 60 * k) for k in range(4)], rng)
    ]  # fmt: skip
    fragments = fragments_of(maps)
    solved = ComponentSolver(fragments).solve(joining)
    assert len(solved) == 1 and len(solved[0].nodes) == 1000
    took = []
    for _ in range(20):
        start = time.thread_time()
        refutation = Refutation(maps, fragments, ExclusionSettings())
        assert refutation.impossible(solved, joining) == ({}, {})
        took.append(time.thread_time() - start)
    assert min(took) < 0.02

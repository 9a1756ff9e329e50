"""Which edges the servo could drive: counted by brute force, and said in words."""

import math
from dataclasses import replace

import numpy as np
import pytest

from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.descriptor import quantise
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Edge, EdgeKind, Landmarks, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.reachability import (
    FARTHEST,
    LEAST,
    WIDEST,
    closed_edges,
    least_in_view,
    reachability_of,
)
from mapweave.hybridmap.reachability_cache import ReachabilityCache
from synthetic.world import CAMERA, random_vectors


def pair(
    a_from_b: Pose2, points: np.ndarray, rng: np.random.Generator, kind: EdgeKind = EdgeKind.MERGED
) -> tuple[Edge, Node, Node]:
    """Two nodes that both know all of the points (N, 3) m, in a, that both see."""
    in_b = a_from_b.inverse().apply(points)
    both = CAMERA.contains(CAMERA.project(points)) & CAMERA.contains(CAMERA.project(in_b))
    nodes = []
    for number, seen in enumerate((points[both], in_b[both]), start=1):
        depths = (seen[:, 0] - CAMERA.mount_forward).astype(np.float32)
        landmarks = Landmarks(
            CAMERA.project(seen).astype(np.float32),
            _codes(len(seen), rng),
            depths,
            np.full(len(seen), 0.02, np.float32),
        )
        pose = PoseGaussian.from_sigmas(Pose2(), 0.01, 0.01)
        nodes.append(Node(NodeId("r", number, 1), 0, pose, CAMERA, landmarks))
    k = np.arange(int(both.sum()), dtype=np.int64)
    between = PoseGaussian.from_sigmas(a_from_b, 0.01, 0.01)
    edge = Edge(NodeId("merge", 0, 1), nodes[0].id, nodes[1].id, between, kind, np.stack([k, k], axis=1))
    return edge, nodes[0], nodes[1]


def _codes(n: int, rng: np.random.Generator) -> np.ndarray:
    return quantise(random_vectors(n, rng))


def wall(n: int, rng: np.random.Generator, x: float = 3.0) -> np.ndarray:
    """(n, 3) m on a wall ahead."""
    return np.column_stack([rng.uniform(x, x + 1.0, n), rng.uniform(-2, 2, n), rng.uniform(0.0, 1.2, n)])


@pytest.mark.parametrize("seed", range(5))
def test_landmarks_in_view_are_those_that_both_cameras_see_at_every_stop(seed: int):
    """Against one landmark and one pose after the other."""
    rng = np.random.default_rng(seed)
    a_from_b = Pose2(rng.uniform(-1, 1), rng.uniform(-0.8, 0.8), rng.uniform(-0.7, 0.7))
    edge, a, b = pair(a_from_b, wall(80, rng), rng)
    points = a.points_in_robot
    fewest = math.inf
    for share in np.linspace(0.0, 1.0, 9)[1:-1]:
        at = Pose2(share * a_from_b.x, share * a_from_b.y, share * a_from_b.heading)
        seen = sum(bool(CAMERA.contains(CAMERA.project(at.inverse().apply(p[None])))[0]) for p in points)
        fewest = min(fewest, seen)
    count = least_in_view(edge.shared, a, b, a_from_b)
    assert count == min(fewest, len(edge.shared))
    assert least_in_view(edge.shared[:, ::-1], b, a, a_from_b.inverse()) == pytest.approx(count, abs=2)


def test_few_landmarks_a_long_way_or_a_wide_turn_only_tie_poses():
    rng = np.random.default_rng(1)
    near = Pose2(0.4, 0.1, 0.1)
    edge, a, b = pair(near, wall(60, rng), rng)
    good = reachability_of(edge, a, b)
    assert good.drivable and good.in_view >= LEAST and "can be driven" in good.reason
    few, a, b = pair(near, wall(60, rng)[:4], rng)
    assert not reachability_of(few, a, b).drivable
    assert (
        "stay" in reachability_of(few, a, b).reason
        and "ties poses, not driven" in reachability_of(few, a, b).reason
    )
    far, a, b = pair(Pose2(FARTHEST + 0.2), wall(60, rng, x=6.0), rng)
    assert not reachability_of(far, a, b).drivable and f"{FARTHEST:g} m" in reachability_of(far, a, b).reason
    turned, a, b = pair(Pose2(0.0, 0.0, WIDEST + 0.05), wall(400, rng), rng)
    assert not reachability_of(turned, a, b).drivable and "degrees" in reachability_of(turned, a, b).reason


def test_driven_edges_are_always_reachable():
    rng = np.random.default_rng(2)
    for kind in (EdgeKind.MAPPED, EdgeKind.TURNED, EdgeKind.DRIVEN):
        edge, a, b = pair(Pose2(3.0, 0.0, 2.0), wall(3, rng), rng, kind)
        assert reachability_of(edge, a, b).drivable


def test_landmarks_without_depth_count_by_being_at_both_ends():
    rng = np.random.default_rng(3)
    edge, a, b = pair(Pose2(0.5, 0.0, 0.05), wall(40, rng), rng)

    def bare(node: Node) -> Node:
        unknown = np.full(len(node.landmarks), np.nan, np.float32)
        bearings = Landmarks(node.landmarks.pixels, node.landmarks.codes, unknown, unknown)
        return Node(node.id, 0, node.map_from_robot, CAMERA, bearings)

    assert least_in_view(edge.shared, bare(a), bare(b), edge.a_from_b.mean) == len(edge.shared)


def test_what_is_a_little_too_far_is_not_said_to_be_as_far_as_the_servo_manages():
    """Before: 45 degrees are more than the 45 that the servo manages."""
    rng = np.random.default_rng(2)
    said = reachability_of(
        *pair(Pose2(FARTHEST + 0.001, 0.0, math.radians(45.04)), wall(60, rng, x=6.0), rng)
    ).reason
    assert "45.1 degrees are more than the 45 that" in said
    assert f"{FARTHEST + 0.1:.1f} m are more than the {FARTHEST:g} m that" in said


def test_closed_edges_of_a_map():
    rng = np.random.default_rng(4)
    edge, a, b = pair(Pose2(0.4), wall(60, rng), rng)
    second, c, d = pair(Pose2(2.8), wall(60, rng, x=6.0), rng)
    c, d = (Node(NodeId("q", k, 1), 0, n.map_from_robot, CAMERA, n.landmarks) for k, n in ((1, c), (2, d)))
    closed = Edge(NodeId("merge", 0, 2), c.id, d.id, second.a_from_b, EdgeKind.LOOP, second.shared)
    first = HybridMap([NodePut(a), NodePut(b), NodePut(c), NodePut(d), EdgePut(edge), EdgePut(closed)])
    assert closed_edges(first) == {closed.id}


def test_landmarks_missing_in_a_rewritten_node_are_not_in_view():
    rng = np.random.default_rng(2)
    edge, a, b = pair(Pose2(0.4, 0.1, 0.1), wall(60, rng), rng)
    whole, kept = reachability_of(edge, a, b), 9
    fewer = replace(b, landmarks=b.landmarks.take(np.arange(kept)))
    known = ReachabilityCache().reach(edge, a, fewer, (None, None))
    assert known.in_view <= kept < whole.in_view
    trimmed = replace(edge, shared=edge.shared[edge.shared[:, 1] < kept])
    assert known == reachability_of(edge, a, fewer) == reachability_of(trimmed, a, fewer)
    gone = np.arange(kept) < 4
    assert ReachabilityCache().reach(edge, a, fewer, (None, gone)).in_view <= 5
    assert not reachability_of(edge, a, replace(b, landmarks=Landmarks.empty())).drivable

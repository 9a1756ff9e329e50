"""The score against a numerical optimiser, and the rules of the false link."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize

from hybridmap.node import Edge, EdgeKind, NodeId
from hybridmap.pose import Pose2, PoseGaussian
from mapweave.scoring import FALSE_LINK, FALSE_LINK_TURN, align, is_false, posture_error, score_map

poses = st.builds(Pose2, st.floats(-9, 9), st.floats(-9, 9), st.floats(-math.pi, math.pi))


def node(number: int, agent: str = "r0") -> NodeId:
    return NodeId(agent, 1, number)


def link(a: NodeId, b: NodeId, a_from_b: Pose2) -> Edge:
    return Edge(node(99), a, b, PoseGaussian.from_sigmas(a_from_b, 0.1, 0.1), EdgeKind.MERGED)


def left(pose: Pose2, estimated: np.ndarray, true: np.ndarray) -> float:
    """Sum of squares after a rigid motion."""
    return float(((pose.apply(estimated) - true) ** 2).sum())


@pytest.mark.parametrize("seed", range(8))
def test_no_optimiser_aligns_better(seed):
    rng = np.random.default_rng(seed)
    estimated = rng.normal(0, 3, (int(rng.integers(2, 20)), 2))
    moved = Pose2(*rng.uniform(-9, 9, 2), rng.uniform(-3, 3))
    true = moved.apply(estimated) + rng.normal(0, 0.5, estimated.shape)
    found = align(estimated, true)
    best = min(
        minimize(lambda v: left(Pose2(*v), estimated, true), [*true.mean(axis=0), heading], tol=1e-10).fun
        for heading in (-2.0, 0.0, 2.0)
    )
    assert left(found, estimated, true) <= best + 1e-6


@given(poses, st.lists(st.tuples(st.floats(-9, 9), st.floats(-9, 9)), min_size=2, max_size=9))
def test_a_motion_is_found_again(motion, points):
    estimated = np.array(points)
    found = align(estimated, motion.apply(estimated))
    assert np.allclose(found.apply(estimated), motion.apply(estimated), atol=1e-6)


def test_one_point_is_only_shifted_and_none_not_at_all():
    found = align(np.array([[1.0, 2.0]]), np.array([[4.0, 6.0]]))
    assert (found.x, found.y, found.heading) == (3.0, 4.0, 0.0)
    assert align(np.zeros((0, 2)), np.zeros((0, 2))) == Pose2()


def a_tour() -> dict[NodeId, Pose2]:
    return {
        node(k, agent): Pose2(k, i + 0.5 * k * k, 0.3 * k) for i, agent in enumerate("ab") for k in range(5)
    }


@given(poses)
def test_a_perfect_map_has_no_error_wherever_its_frame_is(frame):
    truth = a_tour()
    score = score_map({n: (0, frame.inverse() @ p) for n, p in truth.items()}, [], truth)
    assert score.components == 1
    assert score.ate == pytest.approx(0.0, abs=1e-6)
    distance, angle = posture_error(score.world_from_merged, frame)
    assert distance < 1e-6
    assert angle < 1e-6


def test_each_component_is_aligned_by_itself_and_the_largest_one_is_named():
    truth = a_tour()
    frames = {"a": Pose2(5, 5, 1), "b": Pose2(-3, 1, -2)}
    postures = {n: (0 if n.agent == "a" else 1, frames[n.agent].inverse() @ p) for n, p in truth.items()}
    postures.pop(node(4, "a"))
    score = score_map(postures, [], truth)
    assert score.components == 2
    assert score.ate == pytest.approx(0.0, abs=1e-6)
    assert posture_error(score.world_from_merged, frames["b"])[0] < 1e-6
    # The same said to be one map is wrong.
    assert score_map({n: (0, p) for n, (_, p) in postures.items()}, [], truth).ate > 1.0


def test_the_error_is_that_of_the_nodes():
    """Two nodes 2 m apart that are said to be 3 m apart: each is 0.5 m off at best."""
    truth = {node(1): Pose2(), node(2): Pose2(2.0, 0.0, 1.0)}
    score = score_map({node(1): (0, Pose2()), node(2): (0, Pose2(3.0, 0.0, -1.0))}, [], truth)
    assert score.ate == pytest.approx(0.5)


def test_nodes_without_truth_are_left_out():
    truth = {node(1): Pose2(), node(2): Pose2(1)}
    postures = {node(1): (0, Pose2()), node(2): (0, Pose2(1)), node(3): (0, Pose2(77)), node(4): (1, Pose2())}
    score = score_map(postures, [link(node(1), node(4, "b"), Pose2())], truth)
    assert (score.components, score.links) == (1, 0)
    assert score.ate == pytest.approx(0.0, abs=1e-9)
    assert math.isnan(score_map({}, [], truth).ate)


def test_only_links_between_maps_are_counted():
    truth = a_tour()
    a, b = node(1, "a"), node(1, "b")
    true = truth[a].inverse() @ truth[b]
    links = [
        link(a, b, true),
        link(a, b, true @ Pose2(FALSE_LINK + 0.01)),
        link(b, a, (true @ Pose2(0, 0, FALSE_LINK_TURN + 0.01)).inverse()),
        link(a, node(2, "a"), Pose2(50)),
    ]
    score = score_map({n: (0, p) for n, p in truth.items()}, links, truth)
    assert (score.links, score.false_links) == (3, 2)


@given(poses, poses, st.floats(0, 1), st.floats(-math.pi, math.pi), st.floats(-0.5, 0.5))
def test_a_link_is_false_beyond_half_a_metre_or_fifteen_degrees(a, b, distance, direction, turn):
    truth = {node(1): a, node(2, "b"): b}
    true = a.inverse() @ b
    told = Pose2(
        true.x + distance * math.cos(direction), true.y + distance * math.sin(direction), true.heading + turn
    )
    if abs(distance - 0.5) < 1e-6 or abs(abs(turn) - math.radians(15)) < 1e-6:
        return
    assert is_false(link(node(1), node(2, "b"), told), truth) == (
        distance > 0.5 or abs(turn) > math.radians(15)
    )


def test_angles_are_compared_around_the_circle():
    assert posture_error(Pose2(0, 0, math.pi - 0.01), Pose2(3, 4, -math.pi + 0.01)) == pytest.approx(
        (5, 0.02)
    )

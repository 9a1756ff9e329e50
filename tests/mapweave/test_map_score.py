"""The score against a numerical optimiser, and the rules of the false link."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize

from mapweave import Edge, EdgeKind, NodeId, Pose2, PoseGaussian
from mapweave.evaluation.map_score import (
    FALSE_LINK,
    FALSE_LINK_TURN,
    align,
    crossed,
    is_false,
    link_recall,
    pose_error,
    same_place,
    score_map,
)  # fmt: skip
from mapweave.sim.floorplan import Rectangle, distances_to

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
    alignment = align(estimated, true)
    best = min(
        minimize(lambda v: left(Pose2(*v), estimated, true), [*true.mean(axis=0), heading], tol=1e-10).fun
        for heading in (-2.0, 0.0, 2.0)
    )
    assert left(alignment, estimated, true) <= best + 1e-6


@given(poses, st.lists(st.tuples(st.floats(-9, 9), st.floats(-9, 9)), min_size=2, max_size=9))
def test_a_motion_is_found_again(motion, points):
    estimated = np.array(points)
    alignment = align(estimated, motion.apply(estimated))
    assert np.allclose(alignment.apply(estimated), motion.apply(estimated), atol=1e-6)


def test_one_point_is_shifted_and_none_is_unchanged():
    alignment = align(np.array([[1.0, 2.0]]), np.array([[4.0, 6.0]]))
    assert (alignment.x, alignment.y, alignment.heading) == (3.0, 4.0, 0.0)
    assert align(np.zeros((0, 2)), np.zeros((0, 2))) == Pose2()


def a_tour() -> dict[NodeId, Pose2]:
    return {
        node(k, agent): Pose2(k, i + 0.5 * k * k, 0.3 * k) for i, agent in enumerate("ab") for k in range(5)
    }


@given(poses)
def test_a_perfect_map_has_no_error_in_any_frame(frame):
    truth = a_tour()
    score = score_map({n: (0, frame.inverse() @ p) for n, p in truth.items()}, [], truth)
    assert score.components == 1
    assert score.ate == pytest.approx(0.0, abs=1e-6)
    distance, angle = pose_error(score.world_from_component[0], frame)
    assert distance < 1e-6
    assert angle < 1e-6


def test_each_component_is_aligned_by_itself():
    truth = a_tour()
    frames = {"a": Pose2(5, 5, 1), "b": Pose2(-3, 1, -2)}
    poses = {n: (0 if n.agent == "a" else 1, frames[n.agent].inverse() @ p) for n, p in truth.items()}
    poses.pop(node(4, "a"))
    score = score_map(poses, [], truth)
    assert score.components == 2
    assert score.ate == pytest.approx(0.0, abs=1e-6)
    for component, agent in enumerate("ab"):
        distance, angle = pose_error(score.world_from_component[component], frames[agent])
        assert max(distance, angle) < 1e-6
    # The same said to be one map is wrong.
    assert score_map({n: (0, p) for n, (_, p) in poses.items()}, [], truth).ate > 1.0


def test_the_error_is_that_of_the_nodes():
    """Two nodes 2 m apart that are said to be 3 m apart: each is 0.5 m off at best."""
    truth = {node(1): Pose2(), node(2): Pose2(2.0, 0.0, 1.0)}
    score = score_map({node(1): (0, Pose2()), node(2): (0, Pose2(3.0, 0.0, -1.0))}, [], truth)
    assert score.ate == pytest.approx(0.5)


def test_nodes_without_truth_are_left_out():
    truth = {node(1): Pose2(), node(2): Pose2(1)}
    poses = {node(1): (0, Pose2()), node(2): (0, Pose2(1)), node(3): (0, Pose2(77)), node(4): (1, Pose2())}
    score = score_map(poses, [link(node(1), node(4, "b"), Pose2())], truth)
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
    result = Pose2(
        true.x + distance * math.cos(direction), true.y + distance * math.sin(direction), true.heading + turn
    )
    if abs(distance - 0.5) < 1e-6 or abs(abs(turn) - math.radians(15)) < 1e-6:
        return
    assert is_false(link(node(1), node(2, "b"), result), truth) == (
        distance > 0.5 or abs(turn) > math.radians(15)
    )


def test_angles_are_compared_around_the_circle():
    assert pose_error(Pose2(0, 0, math.pi - 0.01), Pose2(3, 4, -math.pi + 0.01)) == pytest.approx((5, 0.02))


boxes = st.builds(
    Rectangle,
    st.floats(-2, 2),
    st.floats(-2, 2),
    st.floats(0.05, 3),
    st.floats(0.05, 3),
    st.floats(-3.2, 3.2),
)
points = st.tuples(st.floats(-4, 4), st.floats(-4, 4))


@given(boxes, points, points)
def test_a_line_meets_a_box_if_one_of_its_points_lies_in_it(box, start, end):
    start, end = np.array(start), np.array(end)
    along = start + np.linspace(0, 1, 400)[:, None] * (end - start)
    nearest = distances_to([box], along).min()
    met = bool(crossed(start[None], end[None], [box])[0])
    if nearest == 0.0:
        assert met
    # Between two of the points that were looked at, the line comes nearer by at most half a step.
    elif nearest > np.hypot(*(end - start)) / 400:
        assert not met


def test_lines_along_and_next_to_a_wall():
    wall = Rectangle.spanning(0, 0, 4, 0.2)
    starts = np.array([[-1, 0.1], [-1, 0.3], [1, 0.1], [2, -1], [5, -1], [2.0, 0.1]])
    ends = np.array([[5, 0.1], [5, 0.3], [2, 0.1], [2, 1], [5, 1], [2.0, 0.1]])
    assert crossed(starts, ends, [wall]).tolist() == [True, False, True, True, False, True]
    assert not crossed(starts, ends, []).any()
    assert crossed(starts[:0], ends[:0], [wall]).shape == (0,)


def test_the_same_place_is_near_with_a_similar_heading_and_no_wall_between():
    here = np.array([[0.0, 0.0, math.radians(170)]])
    there = np.array(
        [
            [0.9, 0, math.radians(-165)], [1.1, 0, math.radians(170)], [0, 0.9, math.radians(-155)],
            [0, -0.9, 2.9],
        ]
    )  # fmt: skip
    wall = Rectangle.spanning(-1, -0.5, 1, -0.4)
    assert same_place(here, there, []).tolist() == [[True, False, False, True]]
    assert same_place(here, there, [wall]).tolist() == [[True, False, False, False]]


def recall_by_hand(links, truth, walls):
    """The definition, pair by pair."""

    def same(a, b):
        distance, angle = pose_error(truth[a], truth[b])
        line = np.linspace(0, 1, 500)[:, None]
        a, b = truth[a].vector[:2], truth[b].vector[:2]
        return (
            distance <= 1 and angle <= math.radians(30) and distances_to(walls, a + line * (b - a)).min() > 0
        )

    chances, taken = 0, 0
    for here in truth:
        for other in {n.map for n in truth} - {here.map}:
            if not any(same(here, n) for n in truth if n.map == other):
                continue
            chances += 1
            place = [n for n in truth if n.map == here.map and same(here, n)]
            ties = [
                (a, b) for e in links if not is_false(e, truth) for a, b in ((e.a, e.b), (e.b, e.a))
                if a in place and b.map == other
            ]  # fmt: skip
            taken += bool(ties)
    return taken / chances if chances else None


@pytest.mark.parametrize("seed", range(6))
def test_recall_agrees_with_its_definition(seed):
    rng = np.random.default_rng(seed)
    truth = {
        node(k, agent): Pose2(*rng.uniform(0, 5, 2), rng.uniform(-0.9, 0.9))
        for agent in "abc"
        for k in range(14)
    }
    walls = [Rectangle.spanning(2.4, 0, 2.5, 4), Rectangle(1, 2, 2, 0.1, 0.5)]
    links = []
    for _ in range(25):
        a, b = (list(truth)[k] for k in rng.choice(len(truth), 2, replace=False))
        off = Pose2(*rng.choice([0.0, 0.0, 1.0], 2), 0.0)
        if a.map != b.map:
            links.append(link(a, b, truth[a].inverse() @ truth[b] @ off))
    recall = link_recall(links, truth, walls)
    assert recall == pytest.approx(recall_by_hand(links, truth, walls))
    assert 0 < recall < 1


def test_recall_counts_places_not_pairs_of_images():
    # Maps a and b share a place with three images each, and nothing else.
    truth = {node(k, agent): Pose2(0.1 * k, 0, 0) for agent in "ab" for k in range(3)}
    truth |= {node(9, "a"): Pose2(9, 9), node(9, "b"): Pose2(-9, 9), node(1, "c"): Pose2(0, 30)}
    a, b = node(0, "a"), node(2, "b")
    true = truth[a].inverse() @ truth[b]
    assert link_recall([], truth, []) == 0.0
    assert link_recall([link(a, b, true)], truth, []) == 1.0
    assert link_recall([link(a, b, true @ Pose2(0.6))], truth, []) == 0.0, "a false link does not help"
    far = link(node(9, "a"), b, truth[node(9, "a")].inverse() @ truth[b])
    assert link_recall([far], truth, []) == 0.5, "a true link from elsewhere helps only b's place"


def test_maps_that_share_no_place_have_no_recall():
    truth = {node(1, "a"): Pose2(), node(1, "b"): Pose2(0.8)}
    assert link_recall([], truth, [Rectangle.spanning(0.3, -5, 0.4, 5)]) is None
    assert link_recall([], {node(k, "a"): Pose2() for k in range(3)}, []) is None
    assert link_recall([], {}, []) is None

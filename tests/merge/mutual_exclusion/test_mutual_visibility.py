"""Robots that should have seen each other: found where they did not, never where it is true."""

import time
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import scipy.sparse

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Landmarks, Node
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from mapweave.hybridmap.ranges import Ranges
from mapweave.hybridmap.trajectory_segment import TrajectorySegment
from mapweave.merge.mutual_exclusion import mutual_visibility as rules
from mapweave.merge.mutual_exclusion.exclusion import collision_of
from mapweave.merge.mutual_exclusion.mutual_visibility import errors_in_common, none_wrong, odds_against
from mapweave.merge.mutual_exclusion.quadrature import quadrature_points
from mapweave.merge.mutual_exclusion.trajectories import trajectories_of
from mapweave.merge.mutual_exclusion.visibility_intervals import VisibilityInterval
from mapweave.merge.pose_graph.component import solve_graph
from mapweave.merge.pose_graph.factors import RelativePose
from mapweave.merge.pose_graph.solved_graph import PoseGraph

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, 0.3)
RADIUS = 0.16
APART = 2 * RADIUS


def looks(
    offsets: Array, lengths: Array, spread: float = 0.03, bearings: Array | None = None
) -> VisibilityInterval:
    """Looks from the origin: (M, 2) m where the other would be, (M, K) m how far K rays went."""
    m, k = lengths.shape
    angles = np.arange(k) * 2 * np.pi / k if bearings is None else bearings
    rows = np.arange(m)
    return VisibilityInterval(
        moments=rows, observers=rows, headings=np.zeros(m), levers=np.zeros((m, 2)), others=rows + m,
        other_levers=np.zeros((m, 2)), offsets=offsets,
        spreads=np.tile(spread**2 * np.eye(2), (m, 1, 1)), radii=np.full(m, RADIUS),
        looks=np.repeat(rows, k),
        directions=np.tile(np.stack([np.cos(angles), np.sin(angles)], axis=1), (m, 1)),
        lengths=lengths.ravel(),
    )  # fmt: skip


def odds(seen: VisibilityInterval) -> Array:
    out: Array = odds_against(seen, none_wrong(seen), APART)[0]
    return out


def marched(angle: float, place: Array, radius: float, reach: float = 6.0) -> float:
    """How far a ray goes until it is within a disc, by small steps."""
    t = np.arange(0.0, reach, 0.001)
    inside = np.hypot(t * np.cos(angle) - place[0], t * np.sin(angle) - place[1]) < radius
    return float(t[np.argmax(inside)]) if inside.any() else np.inf


@pytest.mark.slow
def test_odds_against_rays_marched_step_by_step():
    rng = np.random.default_rng(1)
    for _ in range(15):
        angle = rng.uniform(-np.pi, np.pi)
        place = rng.uniform(0.3, 2.5) * np.array([np.cos(angle), np.sin(angle)])
        lengths = np.where(rng.random(16) < 0.3, np.hypot(*place) - 0.1, rng.uniform(0.2, 3.2, 16))
        seen = looks(place[None], lengths[None], 0.05)
        numerator = denominator = 0.0
        for draw in place + quadrature_points(seen.spreads)[0]:
            if np.hypot(*draw) < APART:
                continue
            went_on = ended = False
            for bearing, length in zip(np.arange(16) * np.pi / 8, lengths, strict=True):
                last = marched(bearing, draw, rules.CORE * RADIUS)
                margin = rules.MARGIN + rules.MARGIN_SHARE * last
                if np.isfinite(last) and length >= marched(bearing, draw, RADIUS) - margin:
                    went_on |= length > last + margin
                    ended |= length <= last + margin
            weight, odd = (rules.MISSED, (1 - rules.SCENERY) / rules.MISSED) if went_on else (1.0, 1.0)
            if ended and not went_on:
                weight, odd = ((1 - rules.MISSED) / rules.SCENERY, rules.SCENERY / (1 - rules.MISSED))
            numerator, denominator = numerator + weight * odd, denominator + weight
        # A draw on an edge may fall on either side of it.
        assert np.isclose(odds(seen)[0], numerator / denominator if denominator else 1.0, rtol=0.15)


@pytest.mark.parametrize(
    ("length", "expected"), [(3.16, 8.0), (1.3, 8.0), (0.84, 0.22), (0.6, 1.0)],
    ids=["nothing", "a wall behind", "the robot", "something before"],
)  # fmt: skip
def test_the_evidence_of_one_ray(length: float, expected: float):
    lengths = np.full((1, 16), 0.5)
    lengths[0, 0] = length
    assert np.isclose(odds(looks(np.array([[1.0, 0.0]]), lengths, 0.005))[0], expected, rtol=0.02)


def test_a_robot_between_two_rays_is_seen_by_none():
    angle = np.pi / 16
    place = 2.0 * np.array([[np.cos(angle), np.sin(angle)]])
    assert odds(looks(place, np.full((1, 16), 3.16), 0.01))[0] == 1.0


@pytest.mark.parametrize("missed", [0.0, 0.05, 0.1])
@pytest.mark.parametrize("spread", [0.01, 0.1])
@pytest.mark.parametrize("clutter", [0.7, 3.0])
def test_a_true_merge_has_mean_odds_of_at_most_one(missed: float, spread: float, clutter: float):
    """Robots at random, in random scenery: rays end at the first thing, and miss the robot now and then."""
    rng = np.random.default_rng(5)
    n, k = 6000, 16
    bearings = np.arange(k) * 2 * np.pi / k
    angles, ways = rng.uniform(-np.pi, np.pi, n), rng.uniform(0.5, 3.0, n)
    offsets = ways[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    true = offsets + rng.normal(0.0, spread, (n, 2))
    true[np.hypot(*true.T) < APART] *= 10.0
    along = true @ np.stack([np.cos(bearings), np.sin(bearings)])
    across2 = (true**2).sum(axis=1)[:, None] - along**2
    hit = np.where((across2 < RADIUS**2) & (along > 0), along - np.sqrt(np.abs(RADIUS**2 - across2)), np.inf)
    hit[rng.random(n) < missed] = np.inf
    lengths = np.minimum(np.minimum(hit, rng.exponential(clutter, (n, k)) + 0.2), 3.16)
    result = odds(looks(offsets, lengths * (1 + 0.01 * rng.standard_normal((n, k))), spread))
    assert result.mean() < 1.0 + 3.0 * result.std() / np.sqrt(n)
    assert result.min() < 0.3 and (missed == 0.0 or result.max() > 3.0)


def chain(share: float = 1.0, n: int = 8) -> PoseGraph:
    """Two walks, joined by one link at their beginnings: errors there are common to all."""
    a, b = ([NodeId(agent, 1, k) for k in range(n)] for agent in "ab")
    step = PoseGaussian(Pose2(0.5, 0.0, 0.3), share * np.diag([0.005, 0.005, 0.005]) ** 2)
    across = PoseGaussian(Pose2(0.3, 1.0, 2.0), share * np.diag([0.05, 0.03, 0.04]) ** 2)
    way = [RelativePose(x[k], x[k + 1], step) for x in (a, b) for k in range(n - 1)]
    return solve_graph(a[0], Pose2(), [*way, RelativePose(a[0], b[0], across)])


@pytest.mark.slow
@pytest.mark.parametrize("on_the_way", [1.0, 0.0])
def test_common_errors_agree_with_monte_carlo(on_the_way: float):
    """Both look at each other; what each would see is computed from poses that are drawn."""
    rng = np.random.default_rng(2)
    graph = chain()
    observers, others = np.arange(16), (np.arange(16) + 8) % 16
    beside = on_the_way * rng.uniform(-1, 1, (16, 2))
    posed = [Pose2.from_vector(mean) for mean in graph.means]
    levers = np.array([pose.rotation @ way for pose, way in zip(posed, beside, strict=True)])
    offsets = (graph.means[:, :2] + levers)[others] - (graph.means[:, :2] + levers)[observers]
    seen = replace(
        looks(offsets, np.full((16, 4), 3.0)), observers=observers, others=others,
        levers=levers[observers], other_levers=levers[others],
    )  # fmt: skip
    errors = errors_in_common(graph, seen, floor_xy=0.0)
    joint = graph.covariance(graph.nodes).reshape(48, 48)
    moved = np.zeros((4000, 16, 2))
    for draw, delta in enumerate(rng.multivariate_normal(np.zeros(48), joint, 4000).reshape(-1, 16, 3)):
        poses = [Pose2.from_vector(m) @ Pose2.from_vector(d) for m, d in zip(graph.means, delta, strict=True)]
        for k in range(16):
            there = poses[k].inverse().apply(poses[others[k]].apply(beside[others[k]])) - beside[k]
            moved[draw, k] = Pose2(0, 0, graph.means[k, 2]).rotation @ there
    moved -= moved.mean(axis=0)
    # The 26 ways of a shell are even: their mean square is a third of that of each component.
    assert np.array_equal(errors.shifts[0], np.zeros((16, 2))) and len(errors.shifts) == 1 + 3 * 26
    full = errors.shifts[-26:] / rules.SIGMAS[-1]
    # All modes together are about as wide as the covariance.
    wide = np.einsum("s,smi,smj->mij", errors.weights, errors.shifts, errors.shifts)
    assert errors.weights.sum() == pytest.approx(1.0)
    assert np.trace(wide, axis1=1, axis2=2) == pytest.approx(
        np.trace(np.einsum("smi,smj->mij", full, full) * 3 / 26, axis1=1, axis2=2), rel=0.1
    )
    for k in range(16):
        drawn_covariance = moved[:, k].T @ moved[:, k] / len(moved)
        covariance = errors.rest[k] + full[:, k].T @ full[:, k] * 3 / 26
        assert np.allclose(covariance, drawn_covariance, atol=0.1 * np.trace(drawn_covariance))
        assert np.linalg.eigvalsh(errors.rest[k]).min() > -1e-9
        assert np.trace(errors.rest[k]) < 0.2 * np.trace(covariance)
    # And they move all looks together as the draws do.
    for k in range(1, 16):
        assert np.allclose(
            full[:, 0].T @ full[:, k] * 3 / 26, moved[:, 0].T @ moved[:, k] / len(moved), atol=4e-4
        )


def test_errors_between_maps_have_opposite_signs():
    """The floor: if the second is further east for the first, the first is further west for the second."""
    graph = chain(1e-6)
    observers, others = np.array([0, 8]), np.array([8, 0])
    offsets = graph.means[others, :2] - graph.means[observers, :2]
    seen = replace(looks(offsets, np.full((2, 4), 3.0)), observers=observers, others=others)
    errors = errors_in_common(graph, seen, floor_xy=0.1)
    assert np.allclose(errors.shifts[:, 0], -errors.shifts[:, 1], atol=0.01)
    furthest = np.hypot(*errors.shifts[:, 0].T).max()
    assert 0.25 < furthest < 0.31


@pytest.mark.parametrize(("segment", "most"), [(0, 0.05), (4, 0.25)], ids=["nodes", "segments"])
def test_looking_at_a_thousand_nodes_takes_no_time(segment: int, most: float):
    """Four robots, each in a room of its own with thin walls: all are in reach, none is in sight."""
    rng = np.random.default_rng(1)
    bearings, pose = np.arange(16) * np.pi / 8, PoseGaussian(Pose2(), np.zeros((3, 3)))
    ids, means, trajectories = [], [], []
    for room, agent in enumerate("abcd"):
        corner = np.array([3.0 * (room % 2), 3.0 * (room // 2)])
        steps = np.cumsum(rng.uniform(-0.3, 0.3, (250, 2)), axis=0)
        places = 0.2 + np.abs(np.mod(steps, 5.0) - 2.5)
        headings = rng.uniform(-np.pi, np.pi, 250)
        angles = headings[:, None] + bearings
        rays = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        to_wall = np.where(rays > 0, 2.9 - places[:, None], -places[:, None]) / rays
        lengths = np.minimum(to_wall.min(axis=-1), 3.16)
        nodes = [
            Node(NodeId(agent, 1, k), round(1e9 * (4 * k + rng.uniform(0, 2))), pose, CAMERA,
                 Landmarks.empty(), "net", RADIUS, Ranges(bearings, lengths[k], 3.16),
                 TrajectorySegment(
                     0.3 + 0.3 * np.arange(segment), np.zeros((segment, 3)),
                     np.tile(lengths[k], (segment, 1))))
            for k in range(250)
        ]  # fmt: skip
        ids += [node.id for node in nodes]
        means.append(np.column_stack([places + corner, headings]))
        trajectories += trajectories_of(nodes)
    information = scipy.sparse.csc_matrix(scipy.sparse.diags(np.full(3000, 1e4)))
    graph = PoseGraph(ids[0], tuple(ids), np.concatenate(means), information)
    took = []
    for _ in range(5):
        start = time.process_time()
        assert [collision_of(graph, first, second) for first, second in combinations(trajectories, 2)] == [
            None
        ] * 6
        took.append(time.process_time() - start)
    # 21 and 80 ms where this was written.
    assert min(took) < most

"""The score of a trial against evo's own programs, plain numpy, and the rules of its docstrings."""

import copy
import hashlib
import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from evo.core import metrics, sync
from evo.core.trajectory import PoseTrajectory3D
from evo.main_ape import ape
from evo.main_rpe import rpe

from mapweave import EdgeKind, NodeId, Pose2
from mapweave.evaluation.map_score import align, pose_error
from mapweave.hybridmap.errors import InvalidValue
from mapweave.scenarios.recording import Lost, RecordedLocalization, TrialTrajectory
from mapweave.scenarios.score import fleet_hash, pose_at, score
from mapweave.scenarios.trajectories import score_trajectory

TICK_NS = 100_000_000


def for_evo(trajectory: TrialTrajectory) -> PoseTrajectory3D:
    """By positions and quaternions, as a TUM file has them."""
    half, zero = trajectory.poses[:, 2] / 2, np.zeros(len(trajectory.poses))
    return PoseTrajectory3D(
        np.column_stack([trajectory.poses[:, :2], zero]),
        np.column_stack([np.cos(half), zero, zero, np.sin(half)]),
        timestamps=trajectory.stamps_ns / 1e9,
    )


def wandering(seed: int, noise: float = 0.02) -> tuple[TrialTrajectory, TrialTrajectory]:
    """A trajectory of 50 s and a robot's estimate of a part of it, in its own frame."""
    rng = np.random.default_rng(seed)
    steps = np.column_stack([np.full(500, 0.03), np.zeros(500), rng.normal(0, 0.05, 500)])
    pose, poses = Pose2(*rng.uniform(-3, 3, 3)), []
    for step in steps:
        pose = pose @ Pose2.from_vector(step)
        poses.append(pose.vector)
    truth = TrialTrajectory(np.arange(500, dtype=np.int64) * TICK_NS, np.array(poses))
    frame = Pose2(*rng.uniform(-9, 9, 2), rng.uniform(-3, 3))
    known = np.sort(rng.choice(np.arange(20, 480), 300, replace=False))
    estimated = [
        (frame @ Pose2.from_vector(v) @ Pose2(*rng.normal(0, noise, 3))).vector for v in truth.poses[known]
    ]
    return truth, TrialTrajectory(truth.stamps_ns[known], np.array(estimated))


@pytest.mark.parametrize("seed", range(5))
def test_trajectories_score_as_evo_scores_them(seed):
    truth, estimate = wandering(seed)
    outcome = score_trajectory(truth, estimate)
    pair = sync.associate_trajectories(for_evo(truth), for_evo(estimate))
    absolute = ape(*copy.deepcopy(pair), metrics.PoseRelation.translation_part, align=True)
    assert outcome.ate_m == pytest.approx(absolute.stats["rmse"], rel=1e-6)
    for value, relation in (
        (outcome.rpe_m, metrics.PoseRelation.translation_part),
        (outcome.rpe_deg, metrics.PoseRelation.rotation_angle_deg),
    ):
        relative = rpe(
            *copy.deepcopy(pair),
            relation,
            delta=1.0,
            delta_unit=metrics.Unit.meters,
            pairs_from_reference=True,
        )
        assert value == pytest.approx(relative.stats["rmse"], rel=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_relative_errors_are_those_of_pairs_a_metre_apart(seed):
    """Without evo: the way is cut into pieces of a metre of truth, each end seen from its start."""
    truth, estimate = wandering(seed)
    true = truth.poses[np.searchsorted(truth.stamps_ns, estimate.stamps_ns)]
    ends, driven = [0], 0.0
    for k in range(1, len(true)):
        driven += math.dist(true[k, :2], true[k - 1, :2])
        if driven >= 1.0:
            ends.append(k)
            driven = 0.0
    errors = []
    for a, b in itertools.pairwise(ends):
        estimated, real = (
            Pose2.from_vector(poses[a]).inverse() @ Pose2.from_vector(poses[b])
            for poses in (estimate.poses, true)
        )
        error = real.inverse() @ estimated
        errors.append([math.hypot(error.x, error.y), math.degrees(abs(error.heading))])
    outcome = score_trajectory(truth, estimate)
    assert [outcome.rpe_m, outcome.rpe_deg] == pytest.approx(
        np.sqrt(np.square(errors).mean(axis=0)), rel=1e-5
    )


def test_errors_over_time_make_up_the_ate():
    truth, estimate = wandering(1)
    outcome = score_trajectory(truth, estimate)
    assert np.array_equal(outcome.stamps_ns, estimate.stamps_ns)
    assert math.sqrt(np.square(outcome.errors).mean()) == pytest.approx(outcome.ate_m)
    true = truth.poses[np.searchsorted(truth.stamps_ns, estimate.stamps_ns), :2]
    moved = align(estimate.poses[:, :2], true).apply(estimate.poses[:, :2])
    assert np.allclose(np.hypot(*(moved - true).T), outcome.errors)


@pytest.mark.parametrize("ticks", [1, 2, 100])
def test_straight_and_short_ways_have_a_score_where_evo_alone_has_none(ticks):
    x = np.linspace(0, 0.5, ticks)
    truth = TrialTrajectory(
        np.arange(ticks, dtype=np.int64) * TICK_NS, np.column_stack([x, x, np.full(ticks, math.pi / 4)])
    )
    estimate = TrialTrajectory(
        truth.stamps_ns, np.array([(Pose2(3, 4, 2) @ Pose2.from_vector(v)).vector for v in truth.poses])
    )
    outcome = score_trajectory(truth, estimate)
    assert outcome.ate_m == pytest.approx(0.0, abs=1e-9)
    assert outcome.rpe_m is None
    assert outcome.rpe_deg is None


def test_times_outside_the_truth():
    truth, estimate = wandering(0)
    with pytest.raises(InvalidValue, match="knows no time"):
        score_trajectory(truth, TrialTrajectory(estimate.stamps_ns + 10**12, estimate.poses))


def test_a_good_trial_has_the_figures_that_it_was_made_of(eventful):
    figures = score(eventful.recording())
    assert (figures.components, figures.maps, figures.nodes) == (2, 3, 57)
    assert (figures.edges, figures.loops, figures.links) == (55, 1, 3)
    assert (figures.false_edges, figures.false_loops, figures.false_links) == (0, 0, 0)
    assert figures.link_precision == 1.0
    assert 0.2 < figures.link_recall < 1.0
    assert 0.005 < figures.merged_ate_m < 0.02
    # Noise of 1 cm in x and in y.
    assert figures.trajectory_ate_m == pytest.approx(0.01 * math.sqrt(2), rel=0.1)
    assert figures.trajectory_ate_m == max(r.trajectory_ate_m for r in figures.robots.values())
    assert figures.rpe_m == max(r.rpe_m for r in figures.robots.values())
    assert figures.collisions == 0 + 1 + 2
    assert figures.bytes_per_node == pytest.approx(6000 / 57)
    assert figures.map_bytes_per_robot_minute == 2000
    assert figures.wire_bytes_per_robot_minute == 10000
    assert figures.real_time_factor == 4.0
    assert figures.recovery_s is None
    assert {name: (r.maps, r.nodes) for name, r in figures.robots.items()} == {
        f"r{k}": (1, 19) for k in range(3)
    }


def test_the_merged_map_scores_as_evo_scores_it(staged):
    """One component, its nodes as a trajectory by their numbers."""
    for node, (_, merged, stamp) in list(staged.nodes.items()):
        if node.agent == "r2":
            del staged.nodes[node]
        else:
            staged.nodes[node] = 0, merged, stamp
    staged.edges = []
    figures = score(staged.recording())
    true = np.array([staged.true_pose(n).vector for n in staged.nodes])
    outcome = np.array([p.vector for _, p, _ in staged.nodes.values()])
    stamps = np.arange(len(true)) * TICK_NS
    result = ape(
        for_evo(TrialTrajectory(stamps, true)), for_evo(TrialTrajectory(stamps, outcome)),
        metrics.PoseRelation.translation_part, align=True,
    )  # fmt: skip
    assert figures.merged_ate_m == pytest.approx(result.stats["rmse"], rel=1e-6)
    assert figures.link_precision is None, "no links"


def test_false_elements_are_counted_where_they_belong(staged):
    off = Pose2(0.6, 0, 0)
    for a, b, kind in (
        (("r0", 3), ("r1", 3), EdgeKind.MERGED),
        (("r0", 3), ("r0", 18), EdgeKind.LOOP),
        (("r0", 4), ("r0", 6), EdgeKind.DRIVEN),
    ):
        a, b = NodeId(a[0], 1, a[1]), NodeId(b[0], 1, b[1])
        staged.add_edge(a, b, staged.relative(a, b) @ off, kind)
    figures = score(staged.recording())
    assert (figures.links, figures.false_links, figures.link_precision) == (4, 1, 0.75)
    assert (figures.edges, figures.false_edges, figures.loops, figures.false_loops) == (57, 2, 2, 1)


def test_a_lost_robot_that_was_found_and_arrived(eventful):
    figures = score(eventful.recording())
    assert figures.found is True
    assert figures.found_error_m == pytest.approx(0.05)
    assert figures.found_error_deg == pytest.approx(2.0)
    assert figures.found_s == pytest.approx(3.0)
    assert figures.reached is True
    assert figures.goal_error_m == pytest.approx(math.hypot(0.01, 0.02))
    assert figures.goal_error_deg == pytest.approx(1.0)
    assert figures.goal_s == pytest.approx(16.0)


@pytest.mark.parametrize(("dx", "turn_deg", "good"), [
    (0.24, 0, True), (0.26, 0, False), (0, 4.9, True), (0, -5.1, False), (0, 180, False),
])  # fmt: skip
def test_found_means_a_quarter_of_a_metre_and_five_degrees(eventful, dx, turn_deg, good):
    (lost,) = eventful.lost
    known = lost.fix.node
    answer = (
        eventful.true_pose(known).inverse() @ eventful.pose("r1", 450) @ Pose2(dx, 0, math.radians(turn_deg))
    )
    lost.fix = replace(lost.fix, node_from_robot=answer)
    figures = score(eventful.recording())
    assert figures.found is good
    assert figures.found_error_m == pytest.approx(dx, abs=1e-9)
    assert figures.found_error_deg == pytest.approx(abs(turn_deg))


@pytest.mark.parametrize(
    ("dx", "turn_deg", "good"), [(0.049, 0, True), (0.051, 0, False), (0, 2.9, True), (0, 3.1, False)]
)
def test_reached_means_five_centimetres_and_three_degrees(eventful, dx, turn_deg, good):
    (lost,) = eventful.lost
    place = eventful.true_pose(lost.goal) @ Pose2(dx, 0, math.radians(turn_deg))
    eventful.truth["r1"].poses[580:] = place.vector
    figures = score(eventful.recording())
    assert figures.reached is good
    lost.arrived_ns = None
    given_up = score(eventful.recording())
    assert given_up.reached is False, "it stands there, and does not know it"
    assert given_up.goal_error_m == pytest.approx(dx, abs=1e-9)
    assert given_up.goal_s is None


def test_a_robot_without_answers(eventful):
    (lost,) = eventful.lost
    eventful.lost.append(copy.copy(lost))
    eventful.lost[1].fix = None
    figures = score(eventful.recording())
    assert figures.found is False
    assert figures.found_error_m is None, "one good answer hides no missing one"
    assert figures.found_s is None
    assert figures.reached is True


def test_an_answer_in_terms_of_an_unknown_place_does_not_count(eventful):
    eventful.lost[0].fix = RecordedLocalization(450 * TICK_NS, NodeId("r2", 1, 999), Pose2())
    figures = score(eventful.recording())
    assert figures.found is False
    assert figures.found_error_m is None
    assert figures.found_s == pytest.approx(3.0)


def test_a_photographs_truth_is_where_it_was_taken(eventful):
    """A node of a map that no robot has made: the goal is where a person was."""
    last = eventful.truth["r0"].poses[-1]
    stood = Pose2.from_vector(last) @ Pose2(0.3, 0.4)
    photo = eventful.add_node("r0", 5, Pose2(), epoch=7)
    recording = eventful.recording()
    lost = Lost("r0", "room 0", 0, stood, goal=photo, arrived_ns=int(eventful.truth["r0"].stamps_ns[-1]))
    figures = score(replace(recording, lost=(lost,), photographed={photo: stood}))
    assert figures.goal_error_m == pytest.approx(0.5, abs=1e-9)
    assert not figures.reached


def test_no_lost_robot_and_no_goal(eventful):
    eventful.lost[0].goal = eventful.lost[0].arrived_ns = None
    figures = score(eventful.recording())
    assert figures.found is True
    assert figures.reached is None
    assert figures.goal_error_m is None
    eventful.lost.clear()
    assert score(eventful.recording()).found is None


def test_an_empty_trial_is_scored_without_dividing_by_nothing(staged):
    staged.nodes.clear()
    staged.edges.clear()
    figures = score(replace(staged.recording(sim_s=0.0, wall_s=0.0), recoveries_s=(3.0, 8.0, 1.0)))
    assert (figures.components, figures.maps, figures.nodes, figures.links) == (0, 0, 0, 0)
    for name in (
        "merged_ate_m", "bytes_per_node", "map_bytes_per_robot_minute", "real_time_factor", "link_recall",
    ):  # fmt: skip
        assert getattr(figures, name) is None
    assert figures.recovery_s == 8.0
    assert "nan" not in str(figures.as_dict()).lower()


def test_a_robot_with_several_maps_counts_by_its_worst(staged):
    recording = staged.recording()
    truth, estimate = recording.robots["r0"].truth, next(iter(recording.robots["r0"].estimates.values()))
    bad = TrialTrajectory(
        estimate.stamps_ns, estimate.poses + np.random.default_rng(0).normal(0, 0.3, estimate.poses.shape)
    )
    record = replace(
        recording.robots["r0"],
        estimates={1: estimate, 2: bad, 3: TrialTrajectory(bad.stamps_ns[:0], bad.poses[:0])},
    )
    figures = score(replace(recording, robots={**recording.robots, "r0": record}))
    assert figures.trajectory_ate_m == score_trajectory(truth, bad).ate_m
    assert (
        figures.robots["r0"].trajectory_ate_m
        == figures.trajectory_ate_m
        > 10 * figures.robots["r1"].trajectory_ate_m
    )


def test_the_fleet_s_hash_is_that_of_its_robots_in_order():
    expected = hashlib.sha256(b"r0 aa\nr1 bb\n").hexdigest()
    assert fleet_hash({"r0": "aa", "r1": "bb"}) == fleet_hash({"r1": "bb", "r0": "aa"}) == expected
    assert fleet_hash({"r0": "bb", "r1": "aa"}) != expected


def test_the_truth_is_taken_at_the_tick(staged):
    truth = staged.truth["r0"]
    for tick in (0, 1, 333, 599):
        assert pose_error(pose_at(truth, tick * TICK_NS), staged.pose("r0", tick)) == (0.0, 0.0)
    assert pose_at(truth, 100 * TICK_NS + 40_000_000) == staged.pose("r0", 100)
    assert pose_at(truth, 100 * TICK_NS - 40_000_000) == staged.pose("r0", 100)
    for stamp in (-TICK_NS, 600 * TICK_NS):
        with pytest.raises(InvalidValue, match="not simulated"):
            pose_at(truth, stamp)
    with pytest.raises(InvalidValue, match="not simulated"):
        pose_at(TrialTrajectory(truth.stamps_ns[:0], truth.poses[:0]), 0)


def test_a_node_of_a_stranger_is_refused(staged):
    recording = staged.recording()
    robots = {name: record for name, record in recording.robots.items() if name != "r2"}
    with pytest.raises(InvalidValue, match=r"r2\.1\.1 was made by no robot"):
        score(replace(recording, robots=robots))

"""The servo in closed loop on a true unicycle: parks, never blind, no Zeno, touches nothing."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from mapweave.agent.observation import RobotDescription
from mapweave.agent.servo.supervisor import DEAD_ZONE, Servo
from mapweave.agent.servo.visibility import Visibility
from mapweave.hybridmap.pose import Array, Pose2

Draw = tuple[Callable[..., Array], Callable[..., Pose2]]
WALL_OF_POINTS = np.array([[3.0, y, 0.3] for y in np.linspace(-1.2, 1.2, 13)])
NOTHING = np.zeros((0, 2))


@pytest.mark.slow
def test_parks_from_random_starts_in_view_and_without_endless_switching(
    robot: RobotDescription, simulate: Callable[..., Any], draw: Draw
):
    draw_points, draw_start = draw
    parked, trials, servo = 0, 25, Servo(robot)
    laws: set[int | None] = set()
    for k in range(trials):
        rng = np.random.default_rng([11, k])
        points = draw_points(rng)
        run = simulate(servo, draw_start(rng, points), points, rng)
        parked += run.parked
        assert run.least_visible >= 4, k
        assert run.switches <= 15, k
        laws |= {step.law for step in run.steps}
    assert parked >= 24  # measured: all of 1000
    assert len(laws - {None}) >= 2  # the paper's laws do drive


def test_six_landmarks_close_together_still_do(robot: RobotDescription, simulate: Callable[..., Any]):
    rng = np.random.default_rng(3)
    points = rng.uniform([2.0, -0.4, 0.1], [3.0, 0.4, 0.5], (6, 3))
    run = simulate(Servo(robot), Pose2(-0.9, 0.5, -0.2), points, rng)
    assert run.parked
    assert run.least_visible >= 4


def test_is_deterministic(robot: RobotDescription, simulate: Callable[..., Any]):
    runs = [
        simulate(Servo(robot), Pose2(-1.0, 0.7, -0.3), WALL_OF_POINTS, np.random.default_rng(4))
        for _ in range(2)
    ]
    assert [s.command for s in runs[0].steps] == [s.command for s in runs[1].steps]


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_wall_behind_is_not_touched(robot: RobotDescription, simulate: Callable[..., Any], side: float):
    # Beside the goal and level with it: without the wall the way leads well back.
    wall = np.column_stack([np.full(61, -0.6), np.linspace(-1.5, 1.5, 61)])
    start = Pose2(-0.1, 0.35 * side, 0.0)
    rng = np.random.default_rng(5)
    run = simulate(Servo(robot), start, WALL_OF_POINTS, rng, obstacles=wall)
    assert run.least_distance >= robot.radius
    assert run.least_visible >= 4
    assert run.parked


def test_a_post_in_the_way_is_not_touched(robot: RobotDescription, simulate: Callable[..., Any]):
    points = np.array([[x, y, 0.3] for x in (3.0, 4.0) for y in np.linspace(-2.0, 2.0, 9)])
    angles = np.linspace(0, 2 * math.pi, 24)
    post = np.column_stack([-0.9 + 0.08 * np.cos(angles), 0.02 + 0.08 * np.sin(angles)])
    rng = np.random.default_rng(6)
    run = simulate(Servo(robot), Pose2(-1.9, 0.0, 0.0), points, rng, obstacles=post)
    assert run.least_distance >= robot.radius
    assert run.least_visible >= 4
    assert run.parked


def test_a_walled_in_robot_reports_that_it_is_stuck(robot: RobotDescription, simulate: Callable[..., Any]):
    angles = np.linspace(0, 2 * math.pi, 80)
    ring = np.column_stack([-1.6 + 0.35 * np.cos(angles), 0.35 * np.sin(angles)])
    rng = np.random.default_rng(7)
    run = simulate(Servo(robot), Pose2(-1.6, 0.0, 0.0), WALL_OF_POINTS, rng, obstacles=ring, ticks=60)
    assert run.state == "stuck"
    assert "no way" in run.steps[-1].reason
    assert run.least_distance >= robot.radius


def test_starts_parked(robot: RobotDescription, simulate: Callable[..., Any]):
    run = simulate(Servo(robot), Pose2(0.001, 0.0, 0.0), WALL_OF_POINTS, np.random.default_rng(8), sigma=0.0)
    assert run.parked
    assert len(run.steps) == 3
    assert all(s.command.forward == 0.0 for s in run.steps)


@pytest.mark.parametrize("aside", [-0.007, 0.0055])
def test_it_comes_nearer_to_the_goal_at_which_it_has_arrived(
    robot: RobotDescription, integrate: Callable[..., list[Pose2]], aside: float
):
    """It has arrived by an estimate that was off, hears where it is, and drives the rest."""
    servo, tracked, pose = Servo(robot), np.ones(len(WALL_OF_POINTS), dtype=bool), Pose2(0.0, aside, 0.0)
    servo.start(Pose2(), WALL_OF_POINTS)
    while servo.command(Pose2(), WALL_OF_POINTS, tracked, NOTHING).state != "arrived":
        pass
    assert servo.command(pose, WALL_OF_POINTS, tracked, NOTHING).state == "arrived", "within its tolerance"
    assert servo.come_nearer(pose)
    for _ in range(150):
        step = servo.command(pose, WALL_OF_POINTS, tracked, NOTHING)
        if step.state == "arrived":
            break
        pose = integrate(pose, step.command, robot.tick, 5)[-1]
    assert step.state == "arrived"
    assert pose.distance(Pose2()) <= DEAD_ZONE


def test_it_stays_where_it_has_arrived_without_a_way_nearer(robot: RobotDescription):
    servo, tracked = Servo(robot), np.ones(len(WALL_OF_POINTS), dtype=bool)
    angles = np.linspace(0, 2 * math.pi, 63)
    ring = robot.radius * np.column_stack([np.cos(angles), np.sin(angles)])
    for pose, obstacles in ((Pose2(0.003, 0.001, 0.0), NOTHING), (Pose2(0.0, 0.007, 0.0), ring)):
        servo.start(Pose2(), WALL_OF_POINTS)
        for _ in range(4):
            servo.command(Pose2(), WALL_OF_POINTS, tracked, obstacles)
        assert not servo.come_nearer(pose)
        assert servo.command(pose, WALL_OF_POINTS, tracked, obstacles).state == "arrived"


def test_landmarks_that_are_not_tracked_are_not_counted_on(robot: RobotDescription):
    visibility, pose = Visibility(robot.camera), Pose2(-1.0, 0.0, 0.0)
    tracked = np.zeros(len(WALL_OF_POINTS), dtype=bool)
    tracked[:5] = True
    counts = []
    for _ in range(15):
        visibility.update(pose, WALL_OF_POINTS, tracked)
        counts.append(int((visibility.field.rooms(pose.vector) >= 0.0).sum()))
    assert counts[0] >= 12
    assert counts[-1] == 5


def test_without_enough_landmarks_in_view_it_turns_back_or_backs_off(robot: RobotDescription):
    servo = Servo(robot)
    aside = Pose2(-1.0, 0.0, 0.8)
    servo.start(aside, WALL_OF_POINTS)
    step = servo.command(aside, WALL_OF_POINTS, np.zeros(13, dtype=bool), NOTHING)
    assert step.state == "turning"
    assert step.command.turn < 0
    near = np.array([[0.6, y, 0.25] for y in (-0.6, -0.45, 0.45, 0.6)])
    servo.start(Pose2(-0.1, 0.0, 0.0), near)
    step = servo.command(Pose2(-0.1, 0.0, 0.0), near, np.zeros(4, dtype=bool), NOTHING)
    assert step.state == "retreating"
    assert step.command.forward < 0
    behind = np.array([[-0.21, y] for y in np.linspace(-0.1, 0.1, 9)])
    step = servo.command(Pose2(-0.1, 0.0, 0.0), near, np.zeros(4, dtype=bool), behind)
    assert step.state == "stuck"
    assert step.command.forward == 0.0


def test_landmarks_without_depth_are_ignored(robot: RobotDescription):
    points = np.concatenate([WALL_OF_POINTS, np.full((4, 3), np.nan)])
    servo = Servo(robot)
    assert servo.start(Pose2(-1.0, 0.2, 0.0), points)
    step = servo.command(Pose2(-1.0, 0.2, 0.0), points, np.ones(17, dtype=bool), NOTHING)
    assert step.state in ("driving", "turning")
    assert not servo.start(Pose2(-1.0, 0.2, 0.0), np.full((9, 3), np.nan))

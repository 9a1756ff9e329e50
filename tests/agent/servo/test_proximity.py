"""The guard in random worlds: for any command, the footprint touches nothing that rangers can see."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from mapweave.agent.observation import Command, RobotDescription
from mapweave.agent.servo.proximity import guard, ranger_points
from mapweave.hybridmap.pose import Array, Pose2
from tests.quick import first_quick

Integrate = Callable[[Pose2, Command, float, int], list[Pose2]]


def read_rangers(robot: RobotDescription, pose: Pose2, posts: Array) -> Array:
    """(K,) m from the robot's edge to posts (M, 3) x, y, radius, along each ray, by exact intersection."""
    readings = np.full(len(robot.ranger_bearings), robot.ranger_reach)
    for k, bearing in enumerate(robot.ranger_bearings):
        direction = np.array([math.cos(pose.heading + bearing), math.sin(pose.heading + bearing)])
        offset = posts[:, :2] - [pose.x, pose.y]
        along = offset @ direction
        miss2 = (offset**2).sum(axis=1) - along**2
        hit = (miss2 < posts[:, 2] ** 2) & (along > 0)
        if hit.any():
            reach = along[hit] - np.sqrt(posts[hit, 2] ** 2 - miss2[hit])
            readings[k] = min(readings[k], max(float(reach.min()) - robot.radius, 0.0))
    return readings


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@example(seed=0, speed=2e-311, turn=0.5)  # the arc of a speed of almost nothing
@given(seed=st.integers(0, 100_000), speed=st.floats(-0.3, 0.3), turn=st.floats(-0.8, 0.8))
def test_no_collision_in_a_random_world(
    seed: int, speed: float, turn: float, robot: RobotDescription, integrate: Integrate
):
    rng = np.random.default_rng(seed)
    posts = np.column_stack([rng.uniform(-2, 2, (12, 2)), rng.uniform(0.15, 0.4, 12)])
    posts = posts[np.hypot(posts[:, 0], posts[:, 1]) > posts[:, 2] + robot.radius + 0.04]
    pose = Pose2(0.0, 0.0, rng.uniform(-3, 3))
    wanted = Command(speed, turn)
    for _ in range(40):
        if rng.random() < 0.15:
            wanted = Command(rng.uniform(-0.3, 0.3), rng.uniform(-0.8, 0.8))
        safe, reason = guard(wanted, read_rangers(robot, pose, posts), robot)
        assert (reason == "") == (safe == wanted)
        assert abs(safe.forward) <= abs(wanted.forward)
        for at in integrate(pose, safe, robot.tick, 4):
            pose = at
            gap = np.hypot(posts[:, 0] - at.x, posts[:, 1] - at.y) - posts[:, 2] - robot.radius
            assert len(gap) == 0 or gap.min() > 0.0


@pytest.mark.parametrize("aside", first_quick([0.05, 0.25, 0.0, 0.12], 2))
@pytest.mark.parametrize("speeds", first_quick([[0.3, 0.1], [0.26, 0.26], [0.3, 0.3]], 1))
def test_two_that_drive_at_each_other_do_not_touch(
    robot: RobotDescription, aside: float, speeds: tuple[float, float]
):
    """Each sees the other one and not that it comes; wheels follow a command with a lag of 0.12 s."""
    closest, steps = math.inf, 20
    for start in np.linspace(0.8, 0.9, 7):
        here, there, driven = Pose2(), Pose2(float(start), aside, math.pi), [*speeds]
        for _ in range(60):
            wanted = [
                guard(
                    Command(speed, 0.0), read_rangers(robot, mine, _post(other, robot)), robot
                ).command.forward
                for speed, mine, other in zip(speeds, (here, there), (there, here), strict=True)
            ]
            for _ in range(steps):
                share = 1.0 - math.exp(-robot.tick / steps / 0.12)
                driven = [v + share * (to - v) for v, to in zip(driven, wanted, strict=True)]
                here = here @ Pose2(driven[0] * robot.tick / steps)
                there = there @ Pose2(driven[1] * robot.tick / steps)
                closest = min(closest, here.distance(there) - 2.0 * robot.radius)
    assert closest > 0.01


def _post(other: Pose2, robot: RobotDescription) -> Array:
    return np.array([[other.x, other.y, robot.radius]])


def test_the_guard_stops_both_ways_and_lets_the_robot_leave(robot: RobotDescription):
    wall_ahead = np.where(np.abs(robot.ranger_bearings) < 0.5, 0.02, robot.ranger_reach)
    stopped = guard(Command(0.2, 0.1), wall_ahead, robot)
    assert stopped.command == Command(0.0, 0.1)
    assert "ahead" in stopped.reason
    assert guard(Command(-0.2, 0.1), wall_ahead, robot).command == Command(-0.2, 0.1)
    assert guard(Command(0.0, 0.8), wall_ahead, robot).reason == ""
    wall_behind = np.where(np.abs(robot.ranger_bearings) > 2.6, 0.02, robot.ranger_reach)
    assert "behind" in guard(Command(-0.2, 0.0), wall_behind, robot).reason


def test_slowing_keeps_the_curvature(robot: RobotDescription):
    some_way_ahead = np.where(np.abs(robot.ranger_bearings) < 0.5, 0.07, robot.ranger_reach)
    safe, reason = guard(Command(0.3, 0.06), some_way_ahead, robot)
    assert "slowed" in reason
    assert 0.0 < safe.forward < 0.3
    assert safe.turn / safe.forward == pytest.approx(0.2)


def test_free_rangers_and_no_rangers_let_everything_pass(robot: RobotDescription):
    free = np.full(len(robot.ranger_bearings), robot.ranger_reach)
    assert guard(Command(0.3, 0.3), free, robot) == (Command(0.3, 0.3), "")
    assert guard(Command(0.3, 0.3), np.zeros(0), robot) == (Command(0.3, 0.3), "")


def test_hits_are_points_at_the_right_place(robot: RobotDescription):
    readings = np.full(len(robot.ranger_bearings), robot.ranger_reach)
    readings[list(robot.ranger_bearings).index(0.0)] = 0.3
    assert ranger_points(readings, robot) == pytest.approx(np.array([[robot.radius + 0.3, 0.0]]))

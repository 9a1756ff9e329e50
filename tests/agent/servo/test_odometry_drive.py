"""The drive without a view."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mapweave.agent.observation import Command, RobotDescription
from mapweave.agent.servo.odometry_drive import OdometryDrive
from mapweave.agent.servo.servo_step import ServoStep
from mapweave.hybridmap.pose import Pose2, wrap_angle

Integrate = Callable[[Pose2, Command, float, int], list[Pose2]]
NOTHING = np.zeros((0, 2))


def run(
    robot: RobotDescription, start: Pose2, integrate: Integrate, ticks: int = 400
) -> tuple[Pose2, list[ServoStep]]:
    drive, pose, steps = OdometryDrive(robot), start, []
    drive.start(pose)
    for _ in range(ticks):
        steps.append(drive.command(pose, NOTHING))
        if steps[-1].state == "arrived":
            break
        pose = integrate(pose, steps[-1].command, robot.tick, 3)[-1]
    return pose, steps


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(-math.pi, math.pi))
def test_gets_anywhere(robot: RobotDescription, integrate: Integrate, x: float, y: float, heading: float):
    pose, steps = run(robot, Pose2(x, y, heading), integrate)
    assert steps[-1].state == "arrived"
    assert math.hypot(pose.x, pose.y) <= 0.04
    assert abs(wrap_angle(pose.heading)) <= 0.021
    assert all(abs(s.command.forward) <= 0.3 and abs(s.command.turn) <= 0.8 for s in steps)


def test_a_turn_on_the_spot_does_not_drive(robot: RobotDescription, integrate: Integrate):
    _, steps = run(robot, Pose2(0.005, 0.0, 2.0), integrate)
    assert all(s.command.forward == 0.0 for s in steps)


def test_a_goal_close_behind_is_driven_to_backward(robot: RobotDescription, integrate: Integrate):
    _, steps = run(robot, Pose2(1.0, 0.1, 0.0), integrate)
    assert min(s.command.forward for s in steps) < -0.1
    assert max(s.command.forward for s in steps) <= 0.0


def test_an_obstacle_stops_it_then_it_is_stuck(robot: RobotDescription):
    drive = OdometryDrive(robot)
    pose = Pose2(-1.0, 0.0, 0.0)
    drive.start(pose)
    assert drive.command(pose, np.array([[0.3, 0.3]])).command.forward > 0.1  # beside the way
    assert drive.command(pose, np.array([[-0.2, 0.0]])).command.forward > 0.1  # behind it
    steps = [drive.command(pose, np.array([[0.3, 0.05]])) for _ in range(25)]
    assert all(s.command == Command() for s in steps)
    assert steps[0].state == "driving"
    assert steps[-1].state == "stuck"
    assert drive.command(pose, NOTHING).command.forward == pytest.approx(0.24)


def test_what_is_in_the_way_does_not_keep_it_from_the_goal_s_heading(
    robot: RobotDescription, integrate: Integrate
):
    drive, pose, obstacle = OdometryDrive(robot), Pose2(0.0, 0.09, 2.0), np.array([[0.0, -0.12]])
    drive.start(pose)
    for _ in range(120):
        step = drive.command(pose, pose.inverse().apply(obstacle))
        assert step.command.forward == 0.0
        pose = integrate(pose, step.command, robot.tick, 3)[-1]
    assert step.state == "stuck"
    assert abs(wrap_angle(pose.heading)) < 0.03
    for _ in range(150):
        step = drive.command(pose, NOTHING)
        pose = integrate(pose, step.command, robot.tick, 3)[-1]
    assert step.state == "arrived", "the obstacle has left"

"""Plans of two legs end at the goal and keep the constraints, judged by projection."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from mapweave.agent.observation import RobotDescription
from mapweave.agent.servo.field_of_view import FieldOfView
from mapweave.agent.servo.plan import ServoPlan, Surroundings
from mapweave.agent.servo.planner import find_plan, two_leg_plan
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array, Pose2

Seen = Callable[[Camera, Pose2, Array], NDArray[np.bool_]]
Draw = tuple[Callable[..., Array], Callable[..., Pose2]]


def check(plan: ServoPlan, start: Pose2, points: Array, camera: Camera, seen: Seen, walls: Array) -> None:
    """Everything that a plan promises, leg by leg."""
    x, y, heading = start.x, start.y, start.heading
    for leg in plan.legs:
        for turned in np.linspace(heading, leg.heading, 20):
            assert seen(camera, Pose2(x, y, float(turned)), points).sum() >= 4
        dx, dy = leg.x - x, leg.y - y
        assert math.hypot(dx, dy) == pytest.approx(leg.length)
        assert dx == pytest.approx(leg.direction * leg.length * math.cos(leg.heading), abs=1e-6)
        assert dy == pytest.approx(leg.direction * leg.length * math.sin(leg.heading), abs=1e-6)
        for s in np.linspace(0.0, 1.0, 30):
            at = Pose2(x + s * dx, y + s * dy, leg.heading)
            assert seen(camera, at, points).sum() >= 4
            if len(walls):
                assert np.hypot(walls[:, 0] - at.x, walls[:, 1] - at.y).min() >= 0.19
        x, y, heading = leg.x, leg.y, leg.heading
    assert (x, y) == pytest.approx((0.0, 0.0), abs=1e-9)
    for turned in np.linspace(heading, 2 * math.pi * round(heading / (2 * math.pi)), 20):
        assert seen(camera, Pose2(0.0, 0.0, float(turned)), points).sum() >= 4


def test_plans_lead_to_the_goal_in_view(robot: RobotDescription, seen: Seen, draw: Draw):
    draw_points, draw_start = draw
    rng = np.random.default_rng(5)
    count = 0
    for _ in range(15):
        points = draw_points(rng)
        start = draw_start(rng, points)
        around = Surroundings(FieldOfView(points, robot.camera), np.zeros((0, 2)), 0.2)
        plan = two_leg_plan(around, start, 0.02)
        if plan is not None:
            count += 1
            assert plan.start == start
            assert plan.length >= math.hypot(start.x, start.y) - 1e-9
            check(plan, start, points, robot.camera, seen, around.obstacles)
    assert count >= 12


def test_there_is_no_plan_out_of_a_ring(robot: RobotDescription):
    points = np.array([[3.0, y, 0.3] for y in np.linspace(-1.0, 1.0, 9)])
    angles = np.linspace(0.0, 2 * math.pi, 60)
    ring = np.column_stack([-1.6 + 0.4 * np.cos(angles), 0.4 * np.sin(angles)])
    around = Surroundings(FieldOfView(points, robot.camera), ring, 0.2)
    assert find_plan(around, Pose2(-1.6, 0.0, 0.0)) is None


def test_there_is_no_plan_to_a_goal_that_sees_nothing(robot: RobotDescription):
    points = np.array([[-3.0, y, 0.3] for y in np.linspace(-1.0, 1.0, 9)])
    around = Surroundings(FieldOfView(points, robot.camera), np.zeros((0, 2)), 0.2)
    assert find_plan(around, Pose2(-0.5, 0.0, math.pi)) is None


def test_one_straight_leg_is_enough_ahead_of_the_goal(robot: RobotDescription):
    points = np.array([[3.0, y, 0.3] for y in np.linspace(-1.0, 1.0, 9)])
    around = Surroundings(FieldOfView(points, robot.camera), np.zeros((0, 2)), 0.2)
    plan = two_leg_plan(around, Pose2(0.5, 0.0, 0.0), 0.05)
    assert plan is not None
    assert [leg.direction for leg in plan.legs] == [-1.0]
    assert plan.length == pytest.approx(0.5)

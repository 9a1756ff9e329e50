"""Plans of two legs and of the lattice end at the goal and keep the constraints, judged by projection."""

import math
import tracemalloc
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mapweave.agent.observation import RobotDescription
from mapweave.agent.servo.field_of_view import FieldOfView
from mapweave.agent.servo.lattice_planner import FARTHEST, lattice_plan
from mapweave.agent.servo.plan import ServoPlan, Surroundings
from mapweave.agent.servo.planner import thorough_plan, two_leg_plan
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


@pytest.mark.parametrize("planner", [two_leg_plan, lattice_plan])
def test_plans_lead_to_the_goal_in_view(planner: Any, robot: RobotDescription, seen: Seen, draw: Draw):
    draw_points, draw_start = draw
    rng = np.random.default_rng(5)
    count = 0
    for _ in range(15):
        points = draw_points(rng)
        start = draw_start(rng, points)
        around = Surroundings(FieldOfView(points, robot.camera), np.zeros((0, 2)), 0.2)
        plan = planner(around, start, 0.02)
        if plan is not None:
            count += 1
            assert plan.start == start
            assert plan.length >= math.hypot(start.x, start.y) - 1e-9
            check(plan, start, points, robot.camera, seen, around.obstacles)
    assert count >= 12


@pytest.mark.parametrize("half", [0.3, 0.45, 0.6])
@pytest.mark.parametrize("start", [Pose2(-1.9, 0.0, 0.0), Pose2(-1.65, -0.02, 0.65)])
def test_a_wall_in_the_way_is_driven_around(robot: RobotDescription, seen: Seen, half: float, start: Pose2):
    # The lattice's moves are longer than its cells: once they jumped through the end of the wall.
    points = np.array([[x, y, 0.3] for x in (3.0, 4.0) for y in np.linspace(-2.0, 2.0, 9)])
    wall = np.column_stack([np.full(25, -0.9), np.linspace(-half, half, 25)])
    around = Surroundings(FieldOfView(points, robot.camera), wall, 0.2)
    assert two_leg_plan(Surroundings(around.field, np.zeros((0, 2)), 0.2), start, 0.02) is not None
    plan = lattice_plan(around, start, 0.02)
    assert plan is not None
    assert plan.length > math.hypot(start.x + 0.9, half) + math.hypot(0.9, half)
    check(plan, start, points, robot.camera, seen, wall)
    either = thorough_plan(around, start)
    assert either is not None
    check(either, either.start, points, robot.camera, seen, wall)


def test_there_is_no_plan_out_of_a_ring(robot: RobotDescription):
    points = np.array([[3.0, y, 0.3] for y in np.linspace(-1.0, 1.0, 9)])
    angles = np.linspace(0.0, 2 * math.pi, 60)
    ring = np.column_stack([-1.6 + 0.4 * np.cos(angles), 0.4 * np.sin(angles)])
    around = Surroundings(FieldOfView(points, robot.camera), ring, 0.2)
    assert thorough_plan(around, Pose2(-1.6, 0.0, 0.0)) is None


def test_there_is_no_plan_to_a_goal_that_sees_nothing(robot: RobotDescription):
    points = np.array([[-3.0, y, 0.3] for y in np.linspace(-1.0, 1.0, 9)])
    around = Surroundings(FieldOfView(points, robot.camera), np.zeros((0, 2)), 0.2)
    assert thorough_plan(around, Pose2(-0.5, 0.0, math.pi)) is None


def test_one_straight_leg_is_enough_ahead_of_the_goal(robot: RobotDescription):
    points = np.array([[3.0, y, 0.3] for y in np.linspace(-1.0, 1.0, 9)])
    around = Surroundings(FieldOfView(points, robot.camera), np.zeros((0, 2)), 0.2)
    plan = two_leg_plan(around, Pose2(0.5, 0.0, 0.0), 0.05)
    assert plan is not None
    assert [leg.direction for leg in plan.legs] == [-1.0]
    assert plan.length == pytest.approx(0.5)


@pytest.mark.slow
def test_the_lattice_is_bounded(robot: RobotDescription):
    """Ten metres once took 13 s and 1.4 GB, and there was no end to it."""
    rng = np.random.default_rng(1)
    points = np.array([[4.0, y, 0.3] for y in np.linspace(-2.0, 2.0, 24)])
    walls = np.column_stack([rng.uniform(-5.0, 3.0, 400), rng.uniform(1.0, 5.0, 400)])
    around = Surroundings(FieldOfView(points, robot.camera), walls, 0.2)
    for far in (Pose2(-1e6, 0.0, 0.0), Pose2(0.0, -FARTHEST - 0.1, 0.0)):
        assert lattice_plan(around, far, 0.02) is None
    tracemalloc.start()
    lattice_plan(around, Pose2(-FARTHEST + 0.1, 0.0, 0.0), 0.02, 0.06, 1.5)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200e6

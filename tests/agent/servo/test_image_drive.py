"""The exploration drive on a true unicycle with true bearings."""

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

from mapweave.agent.observation import Command, RobotDescription
from mapweave.agent.servo.image_drive import ImageDrive
from mapweave.hybridmap.pose import Array, Pose2

Integrate = Callable[[Pose2, Command, float, int], list[Pose2]]
FREE = 0.8


def explore(
    robot: RobotDescription,
    integrate: Integrate,
    points: Array,
    distance: float,
    rangers: Callable[[Pose2], Array],
) -> tuple[list[Pose2], list[Command], int, str]:
    """Drive until done; returns path, commands, the fewest features in view, and the reason."""
    drive, pose, travelled = ImageDrive(robot), Pose2(), 0.0
    drive.start(distance)
    path, commands, fewest, reason = [pose], [], len(points), ""
    for _ in range(300):
        local = pose.inverse().apply(points)
        bearings = np.arctan2(local[:, 1], local[:, 0])
        bearings = bearings[np.abs(bearings) <= robot.camera.semi_aperture]
        fewest = min(fewest, len(bearings))
        command, done, reason = drive.command(travelled, pose.heading, bearings, rangers(pose))
        if done:
            assert command == Command()
            return path, commands, fewest, reason
        commands.append(command)
        pose = integrate(pose, command, robot.tick, 3)[-1]
        travelled += command.forward * robot.tick
        path.append(pose)
    raise AssertionError("the drive did not end")


def free(robot: RobotDescription) -> Callable[[Pose2], Array]:
    return lambda _: np.full(len(robot.ranger_bearings), FREE)


@pytest.mark.parametrize("distance", [0.6, -0.5])
def test_drives_forth_and_back_almost_straight(
    robot: RobotDescription, integrate: Integrate, distance: float
):
    points = np.random.default_rng(1).uniform([2.0, -0.7], [4.0, 0.7], (20, 2))
    path, commands, fewest, reason = explore(robot, integrate, points, distance, free(robot))
    furthest = max(path, key=lambda p: abs(p.x))
    assert furthest.x == pytest.approx(distance, abs=0.03)
    assert math.hypot(path[-1].x, path[-1].y) < 0.05
    assert abs(path[-1].heading) < 0.1
    assert max(abs(p.y) for p in path) < 0.05
    assert fewest >= 18
    assert reason == "complete"
    speeds = [c.forward for c in commands]
    assert max(abs(b - a) for a, b in pairwise(speeds)) < 0.25  # ramps, and the turn round


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_turns_toward_features_on_one_side(robot: RobotDescription, integrate: Integrate, side: float):
    rng = np.random.default_rng(2)
    points = np.column_stack([rng.uniform(1.5, 2.5, 20), side * rng.uniform(0.3, 1.0, 20)])
    straight_fewest = _fewest_when_straight(robot, points, 0.6)
    path, _, fewest, _ = explore(robot, integrate, points, 0.6, free(robot))
    assert max(path, key=lambda p: p.x).heading * side > 0.02
    assert fewest >= straight_fewest
    assert fewest >= 6


def _fewest_when_straight(robot: RobotDescription, points: Array, distance: float) -> int:
    counts = []
    for x in np.linspace(0.0, distance, 20):
        bearings = np.arctan2(points[:, 1], points[:, 0] - x)
        counts.append(int((np.abs(bearings) <= robot.camera.semi_aperture).sum()))
    return min(counts)


def test_turns_round_before_the_features_are_lost(robot: RobotDescription, integrate: Integrate):
    points = np.array([[1.0, y] for y in (-0.45, -0.4, -0.35, -0.3, 0.3, 0.35, 0.4, 0.45)])
    path, _, fewest, reason = explore(robot, integrate, points, 0.8, free(robot))
    assert max(p.x for p in path) < 0.4
    assert fewest >= 5
    assert "features" in reason


@pytest.mark.parametrize("distance", [0.8, -0.8])
def test_turns_round_before_an_obstacle(robot: RobotDescription, integrate: Integrate, distance: float):
    points = np.random.default_rng(3).uniform([3.0, -0.7], [4.0, 0.7], (20, 2))
    wall = math.copysign(0.6, distance)

    def rangers(pose: Pose2) -> Array:
        directions = np.cos(pose.heading + np.asarray(robot.ranger_bearings))
        with np.errstate(divide="ignore"):
            reach = np.where(directions * wall > 1e-6, (wall - pose.x) / directions, np.inf)
        return np.clip(reach - robot.radius, 0.0, FREE)

    path, _, _, reason = explore(robot, integrate, points, distance, rangers)
    gap = min(abs(wall - p.x) for p in path) - robot.radius
    assert 0.08 < gap < 0.2
    assert math.hypot(path[-1].x, path[-1].y) < 0.08
    assert "obstacle" in reason


@pytest.mark.parametrize(("distance", "bearing"), [(0.8, 0.6), (0.8, -0.6), (-0.8, 2.5), (-0.8, -2.5)])
def test_gives_way_to_an_obstacle_on_one_side(robot: RobotDescription, distance: float, bearing: float):
    drive = ImageDrive(robot)
    drive.start(distance)
    rangers = np.full(len(robot.ranger_bearings), FREE)
    rangers[int(np.abs(np.asarray(robot.ranger_bearings) - bearing).argmin())] = 0.25
    command, _, _ = drive.command(0.3 * distance, 0.0, np.zeros(10), rangers)
    # Where the robot goes next, seen from the robot now: away from the side of the obstacle.
    aside = command.forward * command.turn
    assert aside * math.sin(bearing) < 0

"""The wheels' scale by proximity sensors, in a room whose readings are worked out ray by ray."""

import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from mapweave.agent.calibration.ranger_scale import FEWEST, RangerScale
from mapweave.agent.observation import Odometry, RobotDescription
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Pose2

BODY = RobotDescription(
    Camera(320, 240, 277.0, 277.0, 159.5, 119.5, mount_height=0.3),
    ranger_bearings=tuple(k * math.tau / 8 for k in range(8)),
    ranger_reach=3.0,
)
CORNERS = np.array([[-2.5, -2.0], [2.5, -1.2], [2.8, 1.6], [0.4, 2.4], [-2.6, 1.9]])
"""Of a room without a right angle."""
BOX = np.array([[-0.4, 0.3], [0.1, 0.2], [0.2, 0.8], [-0.3, 0.7]])


def readings(pose: Pose2, person: np.ndarray | None = None) -> np.ndarray:
    """Where each ray first meets a side of room, box or person, less the robot's radius."""
    shapes = [CORNERS, BOX, *([] if person is None else [BOX * 0.6 + person])]
    a, b = (np.concatenate([np.roll(shape, -k, axis=0) for shape in shapes]) for k in (0, 1))
    angles = pose.heading + np.array(BODY.ranger_bearings)[:, None]
    cos, sin, (dx, dy) = np.cos(angles), np.sin(angles), (b - a).T
    x, y = (a - [pose.x, pose.y]).T
    # here + t direction = a + share (b - a), by Cramer's rule
    with np.errstate(divide="ignore", invalid="ignore"):
        across = sin * dx - cos * dy
        along, share = (y * dx - x * dy) / across, (cos * y - sin * x) / across
        hits = np.where((along > 0.0) & (share >= 0.0) & (share <= 1.0), along, np.inf).min(axis=1)
    return np.minimum(hits - BODY.radius, BODY.ranger_reach)


def driving(
    seed: int, scale: float, ticks: int, person: Callable[[int], np.ndarray] | None = None
) -> Iterator[tuple[Odometry, np.ndarray]]:
    """Legs from place to place: turn, drive with a wobble; what the wheels count, and the readings."""
    random = np.random.default_rng(seed)
    pose, goal = Pose2(-1.2, -0.8, 0.0), np.array([1.5, -0.5])
    for tick in range(ticks):
        aside = math.atan2(goal[1] - pose.y, goal[0] - pose.x) - pose.heading
        aside = math.remainder(aside, math.tau)
        if math.hypot(goal[0] - pose.x, goal[1] - pose.y) < 0.1:
            goal = random.uniform([-1.8, -1.0], [1.8, 1.2])
        way = 0.025 if abs(aside) < 0.05 else 0.0
        turn = float(np.clip(aside, -0.1, 0.1)) + (0.004 * random.normal() if way else 0.0)
        pose = pose @ Odometry(way, turn).motion()
        seen = readings(pose, None if person is None else person(tick))
        noisy = np.where(seen < BODY.ranger_reach, seen * (1.0 + 0.01 * random.normal(size=8)), seen)
        counted = way / scale * (1.0 + 0.05 * random.normal())
        yield Odometry(counted, turn), noisy


@pytest.mark.parametrize(("seed", "scale"), [(0, 1.0), (1, 1.05), (2, 0.95)])
def test_the_scale_is_found_within_its_sigma(seed: int, scale: float):
    rangers = RangerScale(BODY)
    for wheels, proximity in driving(seed, scale, 800):
        rangers.step(wheels, proximity)
    found = rangers.scale()
    assert found is not None and found.stretches >= FEWEST
    assert found.sigma < 0.02
    assert abs(found.log - math.log(scale)) < 2.5 * found.sigma


def test_a_person_who_walks_about_does_not_change_it():
    """Towards the robot and away from it, faster than it drives."""

    def walking(tick: int) -> np.ndarray:
        return np.array([1.3 * math.sin(0.05 * tick), -0.9 + 0.5 * math.cos(0.031 * tick)])

    rangers = RangerScale(BODY)
    for wheels, proximity in driving(3, 1.0, 1000, walking):
        rangers.step(wheels, proximity)
    found = rangers.scale()
    assert found is None or abs(found.log) < 2.5 * found.sigma


def test_a_scanner_counts_as_one_sensor_each_way():
    """One drive toward a wall is one stretch, however many beams see it: its wheels slip once."""
    bearings = tuple(math.radians(k) for k in range(-180, 180))
    rangers = RangerScale(RobotDescription(BODY.camera, ranger_bearings=bearings, ranger_reach=8.0))
    for _ in range(3):
        for tick in range(40):
            rangers.step(Odometry(0.025, 0.0), np.full(360, 2.0 - 0.025 * tick))
        rangers.step(Odometry(0.0, 1.0), np.full(360, 8.0))
    assert rangers.scale() is None


def test_without_a_sensor_along_the_way_or_a_drive_nothing_is_said():
    blind = RangerScale(RobotDescription(BODY.camera, ranger_bearings=(0.5, -0.5), ranger_reach=3.0))
    none = RangerScale(RobotDescription(BODY.camera))
    stands, far = RangerScale(BODY), RangerScale(BODY)
    for tick in range(400):
        blind.step(Odometry(0.02, 0.0), np.full(2, 2.0 - 0.02 * (tick % 50)))
        none.step(Odometry(0.02, 0.0), np.zeros(0))
        stands.step(Odometry(0.0, 0.01), np.full(8, 1.0))
        far.step(Odometry(0.02, 0.0), np.full(8, BODY.ranger_reach))
        far.step(Odometry(0.02, 0.0), np.full(3, 1.0))
    assert blind.scale() is none.scale() is stands.scale() is far.scale() is None

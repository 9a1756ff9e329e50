"""Drives between boxes and standing robots, on an exact unicycle with exact rays, the guard in between."""

import math
import tracemalloc

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt, label

from mapweave import Camera, Observation, Odometry, Pose2, RobotDescription
from mapweave.agent.navigation.local_planner import LocalPlanner
from mapweave.agent.servo.dynamic_window import DynamicWindow
from mapweave.agent.servo.proximity import guard
from tests.quick import first_quick

BEARINGS = tuple(k * math.tau / 16 for k in range(16))
ROBOT = RobotDescription(
    Camera(320, 240, 277.0, 277.0, 159.5, 119.5, 0.3), ranger_bearings=BEARINGS, ranger_reach=3.0
)
HALL = [[-4, -4, 4, -3.9], [-4, 3.9, 4, 4], [-4, -4, -3.9, 4], [3.9, -4, 4, 4]]
STEP = 0.04
GRID = np.stack(np.meshgrid(*[np.arange(-4, 4, STEP)] * 2, indexing="ij"), axis=-1)


class Scene:
    """Boxes (x0, y0, x1, y1) and standing robots (x, y), m, in a hall."""

    def __init__(self, boxes: list[list[float]], robots: list[list[float]]) -> None:
        self.boxes = np.array(HALL + boxes)
        self.robots = np.array(robots).reshape(-1, 2)

    def room(self, points: np.ndarray) -> np.ndarray:
        """(...,) m between a footprint at a point and the nearest thing."""
        outside = np.maximum(
            self.boxes[:, :2] - points[..., None, :], points[..., None, :] - self.boxes[:, 2:]
        )
        gaps = np.hypot(*np.moveaxis(np.maximum(outside, 0.0), -1, 0)).min(axis=-1)
        for robot in self.robots:
            gaps = np.minimum(gaps, np.hypot(*np.moveaxis(points - robot, -1, 0)) - ROBOT.radius)
        return gaps - ROBOT.radius

    def ranges(self, pose: Pose2, rng: np.random.Generator) -> np.ndarray:
        """(K,) m from the edge, with noise of 1 %."""
        angles = pose.heading + np.array(BEARINGS)
        way = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        way = np.where(np.abs(way) < 1e-12, 1e-12, way)
        here = np.array([pose.x, pose.y])
        a, b = ((corner - here) / way[:, None] for corner in (self.boxes[:, :2], self.boxes[:, 2:]))
        enter, leave = np.minimum(a, b).max(axis=2), np.maximum(a, b).min(axis=2)
        reached = np.where((enter <= leave) & (enter > 0), enter, np.inf).min(axis=1)
        for robot in self.robots:
            along = way @ (robot - here)
            half = ROBOT.radius**2 - (((robot - here) ** 2).sum() - along**2)
            hit = (half > 0) & (along > 0)
            reached = np.minimum(reached, np.where(hit, along - np.sqrt(np.maximum(half, 0)), np.inf))
        noisy = (reached - ROBOT.radius) * (1 + 0.01 * rng.standard_normal(len(reached)))
        return np.clip(noisy, 0.0, ROBOT.ranger_reach)


def drive(scene: Scene, pose: Pose2, target: np.ndarray, rng: np.random.Generator, seconds: float = 50.0):
    """Whether the robot gets there, and the least room that it had, m."""
    detour, odometry, least = LocalPlanner(ROBOT), Odometry(0.0, 0.0), math.inf
    for tick in range(int(seconds / ROBOT.tick)):
        observation = Observation(tick * 10**8, odometry, None, scene.ranges(pose, rng))
        detour.see(observation)
        robot_from_target = pose.inverse().apply(target)
        if math.hypot(*robot_from_target) < 0.15:
            return True, least
        wanted = detour.toward(Pose2(*robot_from_target, 0.0))
        command = guard(wanted, observation.proximity, ROBOT).command
        true = Odometry(command.forward * ROBOT.tick, command.turn * ROBOT.tick)
        pose = pose @ true.motion()
        slip = 1 + 0.02 * rng.standard_normal(2)
        odometry = Odometry(true.forward * slip[0], true.turn * slip[1])
        least = min(least, float(scene.room(np.array([pose.x, pose.y]))))
    return False, least


def drawn_scene(rng: np.random.Generator) -> Scene:
    """A corridor with robots in it, a door, or boxes strewn about."""
    match rng.integers(3):
        case 0:
            half = rng.uniform(0.95, 1.1)
            walls = [[-4, half, 4, half + 0.1], [-4, -half - 0.1, 4, -half]]
            return Scene(walls, rng.uniform([-1.5, 0.16 - half], [1.5, half - 0.16], (2, 2)).tolist())
        case 1:
            middle, gap = rng.uniform(-0.5, 0.5), rng.uniform(0.45, 0.55)
            walls = [[-0.06, middle + gap, 0.06, 4], [-0.06, -4, 0.06, middle - gap]]
            return Scene(walls, rng.uniform(-1.5, 1.5, (1, 2)).tolist())
        case _:
            low, size = rng.uniform(-1.5, 1.2, (4, 2)), rng.uniform(0.1, 0.6, (4, 2))
            return Scene(np.concatenate([low, low + size], axis=1).tolist(), [])


def drawn_drive(rng: np.random.Generator) -> tuple[Scene, Pose2, np.ndarray]:
    """A drive for which there is a way, by flooding a fine grid; half of them start beside something."""
    while True:
        scene = drawn_scene(rng)
        room = scene.room(GRID)
        regions, _ = label(room > 0.09)
        beside = rng.random() < 0.5
        fit = (room > 0.09) & (room < (0.13 if beside else 9.0)) & (np.abs(GRID) < 2).all(axis=-1)
        starts = np.argwhere(fit)
        if not len(starts):
            continue
        start = starts[rng.integers(len(starts))]
        there = (regions == regions[tuple(start)]) & (room > 0.12)
        away = np.hypot(*np.moveaxis(GRID - GRID[tuple(start)], -1, 0))
        goals = np.argwhere(there & (away > 0.7) & (away < 2.5))
        if len(goals):
            pose = Pose2(*GRID[tuple(start)], rng.uniform(-math.pi, math.pi))
            return scene, pose, GRID[tuple(goals[rng.integers(len(goals))])]


@pytest.mark.parametrize("seed", first_quick(range(12), 3))
def test_it_arrives_if_there_is_a_way(seed):
    rng = np.random.default_rng([seed, 77])
    arrived, room = drive(*drawn_drive(rng), rng)
    assert arrived
    assert room > 0.03, "the guard's margin, less what the rangers err"


@pytest.mark.parametrize("bearing", first_quick((np.arange(16) * 7 % 16 * math.pi / 8 - math.pi).tolist(), 3))
def test_a_robot_beside_another_one_gets_away(bearing):
    """It once stood before another robot for minutes: it backed off, and came on again the same way."""
    rng = np.random.default_rng(3)
    other = 2 * ROBOT.radius + 0.06
    scene = Scene([[-4, 0.9, 4, 1.0], [-4, -1.1, 4, -1.0]], [[other, 0.0]])
    arrived, room = drive(scene, Pose2(0.0, 0.0, bearing), np.array([1.2, 0.1]), rng, 25.0)
    assert arrived
    assert room > 0.03


@pytest.mark.slow
def test_as_near_as_it_can_get_to_what_is_walled_in():
    rng = np.random.default_rng(5)
    scene = Scene(
        [[0.8, -0.5, 0.9, 0.5], [1.5, -0.5, 1.6, 0.5], [0.8, 0.5, 1.6, 0.6], [0.8, -0.6, 1.6, -0.5]], []
    )
    arrived, room = drive(scene, Pose2(), np.array([1.2, 0.0]), rng, 20.0)
    assert not arrived
    assert room > 0.03


def test_steering_faces_the_direction_of_motion():
    """Nothing ahead: straight on. A wall ahead: it turns, though that leads nowhere yet."""
    arcs = DynamicWindow(ROBOT)
    free = arcs.toward(np.array([1.0, 0.0]), np.zeros((0, 2)), 0.26, 0.6)
    assert free.forward == pytest.approx(0.26)
    assert abs(free.turn) < 1e-9
    behind = arcs.toward(np.array([-1.0, 0.2]), np.zeros((0, 2)), 0.26, 0.6)
    assert abs(behind.turn) == pytest.approx(0.6)
    wall = np.stack([np.full(41, 0.24), np.linspace(-1, 1, 41)], axis=1)
    held = arcs.toward(np.array([1.0, 0.0]), wall, 0.26, 0.6)
    assert held.forward <= 0.0


def test_clearance_agrees_with_a_distance_transform():
    """The test's own geometry, against another."""
    scene = drawn_scene(np.random.default_rng(8))
    solid = scene.room(GRID) <= -ROBOT.radius + 1e-9
    other = STEP * distance_transform_edt(~solid) - ROBOT.radius
    assert np.abs(other - scene.room(GRID))[~solid].max() < 1.5 * STEP


def test_a_target_beyond_the_grid_costs_no_more_than_at_its_border():
    """A leg of a million metres once made a line of forty million points: 15 s and 2.8 GB."""
    scene, rng = Scene([[1.0, -0.6, 1.2, 0.6]], []), np.random.default_rng(0)
    for wanted in (Pose2(3.2, 0.0, 0.0), Pose2(1e6, 0.0, 0.0), Pose2(1e6, -1e6, 0.0)):
        detour = LocalPlanner(ROBOT)
        detour.see(Observation(0, Odometry(0.0, 0.0), None, scene.ranges(Pose2(), rng)))
        tracemalloc.start()
        command = detour.toward(wanted)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 20e6
        assert math.copysign(1.0, command.forward) > 0 or command.turn, "it goes there all the same"
        assert detour.around == (wanted.y == 0.0), "the box stands straight ahead, not aside"


def test_a_far_target_is_steered_to_along_the_line_to_it():
    detour = LocalPlanner(ROBOT)
    detour.see(Observation(0, Odometry(0.0, 0.0), None, np.full(16, ROBOT.ranger_reach)))
    near, far = (detour.toward(Pose2(3.0 * scale, 1.0 * scale, 0.0)) for scale in (1.0, 1e5))
    assert near.forward == far.forward
    assert near.turn == pytest.approx(far.turn, abs=0.03)

"""A small world for the servo: a unicycle integrated finely, landmarks, and brute-force visibility."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
from numpy.typing import NDArray

from mapweave import Camera, Command, RobotDescription
from mapweave.agent.servo.servo_step import ServoStep
from mapweave.agent.servo.supervisor import Servo
from mapweave.hybridmap.pose import Array, Pose2

FOCAL = 160.0 / math.tan(math.radians(30.0))
CAMERA = Camera(320, 240, FOCAL, FOCAL, 160.0, 120.0, mount_height=0.25)
RANGERS = tuple(np.linspace(-math.pi, math.pi, 16, endpoint=False).tolist())
ROBOT = RobotDescription(CAMERA, ranger_bearings=RANGERS, ranger_reach=0.8)


def seen_by_projection(camera: Camera, pose: Pose2, points: Array) -> NDArray[np.bool_]:
    """(N,) which landmarks fall into the image, by the camera's own projection."""
    pixels = camera.project(pose.inverse().apply(points))
    ahead = (pose.inverse().apply(points)[:, 0] - camera.mount_forward) > 0.1
    with np.errstate(invalid="ignore"):
        inside = (pixels >= 0.0).all(axis=1) & (pixels <= [camera.width, camera.height]).all(axis=1)
    return ahead & inside


def unicycle(pose: Pose2, command: Command, seconds: float, steps: int) -> list[Pose2]:
    """Poses under a constant command: Runge-Kutta of x' = v cos, y' = v sin, heading' = w."""
    state, path = pose.vector, []
    v, w, dt = command.forward, command.turn, seconds / steps

    def rate(s: Array) -> Array:
        return np.array([v * math.cos(s[2]), v * math.sin(s[2]), w])

    for _ in range(steps):
        k1 = rate(state)
        k2 = rate(state + 0.5 * dt * k1)
        k3 = rate(state + 0.5 * dt * k2)
        k4 = rate(state + dt * k3)
        state = state + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        path.append(Pose2.from_vector(state))
    return path


@dataclass
class Drive:
    """What happened in one closed-loop run."""

    pose: Pose2
    steps: list[ServoStep] = field(default_factory=list)
    path: list[Pose2] = field(default_factory=list)
    least_visible: int = 99
    least_distance: float = math.inf
    switches: int = 0

    @property
    def state(self) -> str:
        return self.steps[-1].state

    @property
    def parked(self) -> bool:
        return (
            self.state == "arrived"
            and math.hypot(self.pose.x, self.pose.y) <= 0.01
            and abs(math.remainder(self.pose.heading, 2 * math.pi)) <= math.radians(1.0)
        )


def draw_points(rng: np.random.Generator, count: int = 12) -> Array:
    """(count, 3) m landmarks 1.5-5 m ahead of the goal, in its view."""
    depth = rng.uniform(1.5, 5.0, count)
    bearing = rng.uniform(-0.5, 0.5, count)
    return np.column_stack([depth, depth * np.tan(bearing), 0.25 + rng.uniform(-0.2, 0.2, count)])


def draw_start(rng: np.random.Generator, points: Array) -> Pose2:
    """A start behind the goal that sees six landmarks."""
    while True:
        r, a = rng.uniform(0.3, 2.5), rng.uniform(0.0, 2.0 * math.pi)
        start = Pose2(r * math.cos(a), r * math.sin(a), rng.uniform(-math.pi / 4, math.pi / 4))
        if start.x <= 0.1 and seen_by_projection(CAMERA, start, points).sum() >= 6:
            return start


def drive(
    servo: Servo,
    start: Pose2,
    points: Array,
    rng: np.random.Generator,
    obstacles: Array | None = None,
    sigma: float = 0.002,
    ticks: int = 600,
    blind_to: tuple[int, ...] = (),
) -> Drive:
    """Run the servo on a true unicycle with noisy poses; obstacle points are seen within 0.7 m."""
    walls = np.zeros((0, 2)) if obstacles is None else obstacles
    servo.start(start, points)
    run = Drive(start)
    for _ in range(ticks):
        noise = rng.normal(0.0, sigma, 3)
        estimate = Pose2.from_vector(run.pose.vector + noise)
        visible = seen_by_projection(CAMERA, run.pose, points)
        visible[list(blind_to)] = False
        local = run.pose.inverse().apply(walls)
        local = local[np.hypot(local[:, 0], local[:, 1]) < ROBOT.radius + 0.7]
        step = servo.command(estimate, points, visible, local)
        run.steps.append(step)
        if step.state == "arrived":
            break
        assert abs(step.command.forward) <= ROBOT.max_forward + 1e-9
        assert abs(step.command.turn) <= ROBOT.max_turn + 1e-9
        for pose in unicycle(run.pose, step.command, ROBOT.tick, 5):
            run.path.append(pose)
            run.least_visible = min(run.least_visible, int(seen_by_projection(CAMERA, pose, points).sum()))
            if len(walls):
                gap = np.hypot(walls[:, 0] - pose.x, walls[:, 1] - pose.y).min()
                run.least_distance = min(run.least_distance, float(gap))
        run.pose = run.path[-1]
    run.switches = servo.switches
    return run


@pytest.fixture
def robot() -> RobotDescription:
    """The robot of these tests."""
    return ROBOT


@pytest.fixture
def seen() -> Callable[[Camera, Pose2, Array], NDArray[np.bool_]]:
    """Brute-force visibility."""
    return seen_by_projection


@pytest.fixture
def simulate() -> Callable[..., Drive]:
    """Closed-loop runs."""
    return drive


@pytest.fixture
def integrate() -> Callable[[Pose2, Command, float, int], list[Pose2]]:
    """The unicycle."""
    return unicycle


@pytest.fixture
def draw() -> tuple[Callable[..., Array], Callable[..., Pose2]]:
    """Draw landmarks, draw a start."""
    return draw_points, draw_start

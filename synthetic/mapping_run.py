"""Random mapping runs with truth: a robot, landmarks, wheels that slip and pixels that tremble."""

import math
from dataclasses import dataclass

import numpy as np

from mapweave.agent.observation import Odometry
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array, Pose2

CAMERA = Camera(320, 240, 277.0, 277.0, 160.0, 120.0, mount_height=0.3)
AXLE = 0.24
TICK = 0.1
SHAPES = ("line", "arc", "weave", "stops")

_NOISE, _SLIP, _SLIP_SHARE = 0.02, 0.1, 0.02
WHEEL_NOISE = math.sqrt((1 - _SLIP_SHARE) * _NOISE**2 + _SLIP_SHARE * _SLIP**2)
"""Standard deviation of a wheel's way as a share of it: 2 %, and 10 % in the two steps of 100 that slip."""


@dataclass(frozen=True, eq=False)
class MappingRun:
    """One run.

    Attributes:
        camera: of the robot.
        points: (N, 3) m, landmarks in the first robot frame.
        poses: T + 1 true poses in the first robot frame.
        odometry: T steps as the wheels measure them.
        pixels: (T + 1, N, 2) px; NaN where a landmark is out of the image.
        pixel_sigma: px.
    """

    camera: Camera
    points: Array
    poses: list[Pose2]
    odometry: list[Odometry]
    pixels: Array
    pixel_sigma: float


def speeds(shape: str, steps: int) -> tuple[Array, Array]:
    """Forward speed m/s and turn rate rad/s of each tick, (T,) each; all shapes keep a common view."""
    t = TICK * np.arange(steps)
    oscillation = np.sin(2 * np.pi * t / 16.7)
    if shape == "line":
        # The paper's Figures 7 and 8: straight back and forth, with a correction now and then.
        return 0.15 * np.sign(oscillation + 1e-9), 0.03 * np.sin(2 * np.pi * t / 5)
    if shape == "arc":
        return 0.2 * oscillation, 0.12 * np.sin(2 * np.pi * t / 8)
    if shape == "weave":
        return 0.15 * np.sign(oscillation + 1e-9), 0.3 * np.cos(2 * np.pi * t / 4)
    still = (t % 4.0) < 1.0
    return np.where(still, 0.0, 0.2 * oscillation), np.where(still, 0.0, 0.06 * np.sin(2 * np.pi * t / 6))


def draw_run(
    rng: np.random.Generator,
    shape: str = "line",
    steps: int = 500,
    landmarks: int = 30,
    pixel_sigma: float | None = None,
    camera: Camera = CAMERA,
) -> MappingRun:
    """Draw a run: landmarks 1.5-5 m ahead, pixel noise 0.5-1 px, wheels of WHEEL_NOISE."""
    sigma = float(rng.uniform(0.5, 1.0)) if pixel_sigma is None else pixel_sigma
    first = np.column_stack(
        [rng.uniform(20, camera.width - 20, landmarks), rng.uniform(20, camera.height - 20, landmarks)]
    )
    points = camera.back_project(first, rng.uniform(1.5, 5.0, landmarks))
    forward, turn = speeds(shape, steps)
    ways = TICK * np.column_stack([forward + 0.5 * AXLE * turn, forward - 0.5 * AXLE * turn])
    share = np.where(rng.random(ways.shape) < _SLIP_SHARE, _SLIP, _NOISE)
    true = ways * (1.0 + share * rng.normal(size=ways.shape))
    poses = [Pose2()]
    for right, left in true:
        poses.append(poses[-1] @ Odometry(0.5 * (right + left), (right - left) / AXLE).motion())
    exact = np.stack([camera.project(pose.inverse().apply(points)) for pose in poses])
    pixels = exact + sigma * rng.normal(size=exact.shape)
    pixels[~camera.contains(exact)] = np.nan
    odometry = [Odometry(TICK * float(u1), TICK * float(u2)) for u1, u2 in zip(forward, turn, strict=True)]
    return MappingRun(camera, points, poses, odometry, pixels, sigma)

"""A place with landmarks, an exact unicycle that looks at them, and pixel noise."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.homing.guesses import Guesses
from agent.homing.trail import TrailSettings
from agent.observation import Odometry, RobotDescription
from hybridmap.camera import Camera
from hybridmap.pose import Array, Pose2, PoseGaussian
from hybridmap.recognising.bearings import BearingSettings, relate_all

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, mount_height=0.25, mount_forward=0.06)
PLACE = Camera(400, 300, 350.0, 345.0, 199.5, 149.5, mount_height=0.28, mount_forward=0.1)
PLAIN = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, mount_height=0.25)
ROBOT = RobotDescription(CAMERA)


@dataclass
class Scene:
    """Landmarks (N, 3) m in the place's robot frame, and where the true robot is in it."""

    points: Array
    pose: Pose2
    rng: np.random.Generator
    sigma_px: float = 0.5
    robot: RobotDescription = ROBOT
    place: Camera = PLACE
    at_place: Array = field(init=False)

    def __post_init__(self) -> None:
        noise = self.rng.normal(0.0, self.sigma_px, (len(self.points), 2)) if self.sigma_px else 0.0
        self.at_place = self.place.project(self.points) + noise

    @property
    def settings(self) -> TrailSettings:
        sigma = max(self.sigma_px, 0.01)
        return TrailSettings(pixel_sigma=sigma, node_sigma=sigma)

    def look(self) -> tuple[NDArray[np.int64], Array]:
        """Landmarks in view, and where."""
        pixels = self.robot.camera.project(self.pose.inverse().apply(self.points))
        ids = np.flatnonzero(self.robot.camera.contains(pixels))
        noise = self.rng.normal(0.0, self.sigma_px, (len(ids), 2)) if self.sigma_px else 0.0
        return ids, pixels[ids] + noise

    def drive(self, forward: float, turn: float) -> Odometry:
        """Move the true robot by m and rad; returns what the wheels say."""
        self.pose = self.pose @ Odometry(forward, turn).motion()
        if not self.sigma_px:
            return Odometry(forward, turn)
        noise = self.rng.normal(0.0, [0.02 * abs(forward) + 1e-5, 0.02 * abs(turn) + 1e-5])
        return Odometry(forward + noise[0], turn + noise[1])

    def guesses(self, prior: PoseGaussian | None = None) -> Guesses:
        """Guesses after the first image, by default without any idea where the robot is."""
        ids, pixels = self.look()
        how = BearingSettings(pixel_sigma=max(self.sigma_px, 0.1), least_inliers=4)
        camera = self.robot.camera
        fixes = relate_all(self.at_place[ids], self.place, pixels, camera, np.random.default_rng(0), how)
        anywhere = PoseGaussian.from_sigmas(Pose2(), 2.0, 1.0)
        guesses = Guesses(self.robot, self.place, self.at_place, fixes, prior or anywhere, self.settings)
        guesses.see(ids, pixels)
        return guesses


def make_scene(
    seed: int,
    count: int = 20,
    sigma_px: float = 0.5,
    depth: tuple[float, float] = (1.5, 5.0),
    plain: bool = False,
) -> Scene:
    """Landmarks in the place's view, and a robot behind it that sees at least six.

    A plain scene has one camera above the axle for both: then nothing but the wheels tells any length.
    """
    robot, place = (RobotDescription(PLAIN), PLAIN) if plain else (ROBOT, PLACE)
    rng = np.random.default_rng(seed)
    depths, slopes = rng.uniform(*depth, count), rng.uniform(-0.5, 0.5, count)
    rise = rng.uniform(-0.35, 0.35, count)
    points = np.column_stack(
        [depths + place.mount_forward, slopes * depths, place.mount_height + rise * depths]
    )
    while True:
        distance, direction = rng.uniform(0.4, 1.5), rng.uniform(2.0, 2.0 * math.pi - 2.0)
        start = Pose2(distance * math.cos(direction), distance * math.sin(direction), rng.uniform(-0.5, 0.5))
        scene = Scene(points, start, rng, sigma_px, robot, place)
        if len(scene.look()[0]) >= 6:
            return scene


@pytest.fixture
def scene_of() -> Callable[..., Scene]:
    """Draw a scene."""
    return make_scene

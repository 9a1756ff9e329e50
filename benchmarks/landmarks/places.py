"""Places in simulated buildings: pictures from poses around them, and where everything in them is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from benchmarks.images.surface_points import Surfaces
from mapweave.agent.observation import RobotDescription
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.sim.camera import CAMERAS
from mapweave.sim.imager import Imager
from mapweave.sim.scene import Scene
from mapweave.sim.texture import Image
from mapweave.sim.world import PanelSet
from mapweave.sim.worlds.catalog import make_world
from mapweave.vision.lens import Lens

WORLDS = ("office", "arena", "warehouse", "corridor")
LENSES = ("webcam", "wide", "phone", "cheap")
CLEARANCE = 0.3
NEAR, TURNED = 0.5, math.radians(20.0)
"""Other poses are up to so far from the place, m forth or aside and rad."""
LEAST_DEPTH = 0.8
"""m; a robot closer than this before a wall sees next to nothing."""


@dataclass(frozen=True, eq=False)
class SimulatedPlace:
    """A pose in a building, and one camera.

    Attributes:
        camera: intrinsics and mount.
        pose: `world_from_robot`.
    """

    camera: Camera
    pose: Pose2
    _surfaces: Surfaces
    _lens: Lens
    _imager: Imager
    _scene: Scene

    @staticmethod
    def draw(rng: np.random.Generator) -> SimulatedPlace:
        """Some place of some building, through one of the simulator's cameras."""
        kind, name = str(rng.choice(WORLDS)), str(rng.choice(LENSES))
        world, setup = make_world(kind, int(rng.integers(1 << 20))), CAMERAS[name]
        camera, surfaces = setup.intrinsics, Surfaces(world)
        grid = np.stack(np.meshgrid(np.arange(20, 320, 20.0), np.arange(20, 160, 20.0)), -1).reshape(-1, 2)
        while True:
            pose = world.plan.random_free_pose(rng, CLEARANCE)
            if np.median(surfaces.see(pose, camera, grid).depths) > LEAST_DEPTH:
                break
        imager = Imager(setup, world.background, [int(rng.integers(1 << 30))])
        lens = Lens(camera, setup.distortion)
        return SimulatedPlace(camera, pose, surfaces, lens, imager, Scene([PanelSet.of(world.panels)]))

    @property
    def description(self) -> RobotDescription:
        """The description of a robot with this camera, whose features come without distortion."""
        return RobotDescription(self.camera)

    def nearby(self, rng: np.random.Generator) -> Pose2:
        """Another pose, seen from the place."""
        ahead, aside = rng.uniform(-NEAR, NEAR, 2)
        return Pose2(float(ahead), float(aside), float(rng.uniform(-TURNED, TURNED)))

    def picture(self, at: Pose2 | None = None) -> Image:
        """(H, W) grey, from the place or from a pose beside it, with lens, noise and exposure."""
        pose = self.pose @ (at or Pose2())
        rotation = np.eye(3)
        rotation[:2, :2] = pose.rotation
        return self._imager.picture(self._scene, (np.array([pose.x, pose.y, 0.0]), rotation), 1.0, 0.0, 0.1)

    def undistorted(self, raw: Array) -> Array:
        """(N, 2) px of pictures -> (N, 2) px of the ideal camera."""
        return self._lens.undistort(raw)

    def points(self, pixels: Array, at: Pose2 | None = None) -> Array:
        """(N, 3) m in world that undistorted pixels show; NaN for nothing."""
        return self._surfaces.see(self.pose @ (at or Pose2()), self.camera, pixels).points

    def depths(self, pixels: Array) -> Array:
        """(N,) m of undistorted pixels seen from the place; NaN for nothing."""
        depths = self._surfaces.see(self.pose, self.camera, pixels).depths
        return np.where(np.isfinite(depths), depths, np.nan)

    def project(self, points: Array, at: Pose2) -> Array:
        """(N, 2) undistorted px where points in world are seen from beside the place; NaN behind."""
        return self.camera.project((self.pose @ at).inverse().apply(points))

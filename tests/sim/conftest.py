"""A bare floor, a small office, and a ray caster that knows nothing of the renderer."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.sim.floorplan import BuildingPlan, Rectangle
from mapweave.sim.world import Block, PanelSet, World
from mapweave.sim.worlds.catalog import make_world
from tests.sim.stage import Stage


@dataclass(frozen=True, eq=False)
class Cast:
    """What rays hit.

    Attributes:
        panel: (N,) number of the nearest panel, -1 for none.
        points: (N, 3) m, in world.
        doubtful: (N,) whether an edge or a second surface is so near that rounding decides.
    """

    panel: np.ndarray
    points: Array
    doubtful: np.ndarray


class RayCaster:
    """Solves one 3 x 3 system for each pixel and panel."""

    def cast(self, panels: PanelSet, camera: Camera, rotation: Array, position: Array, pixels: Array) -> Cast:
        """Follow the rays of (N, 2) pixels from a camera on a robot with that pose in world."""
        rays = (camera.back_project(pixels, np.ones(len(pixels)))) - [
            camera.mount_forward,
            0,
            camera.mount_height,
        ]
        rays = rays @ rotation.T
        origin = position + rotation @ [camera.mount_forward, 0.0, camera.mount_height]
        depths = np.full((len(panels.corner), len(pixels)), np.inf)
        margins = np.full(depths.shape, np.inf)
        for k, (corner, along, down) in enumerate(zip(panels.corner, panels.along, panels.down, strict=True)):
            # origin + depth * ray = corner + p * along + q * down; seen if the ray goes along the normal.
            facing = rays @ np.cross(along, down)
            systems = np.stack(
                [rays, np.broadcast_to(-along, rays.shape), np.broadcast_to(-down, rays.shape)], axis=-1
            )
            solvable = np.abs(np.linalg.det(systems)) > 1e-12
            solution = np.zeros(rays.shape)
            solution[solvable] = np.linalg.solve(systems[solvable], (corner - origin)[:, None])[..., 0]
            depth, p, q = solution.T
            margin = np.minimum(np.minimum(p, 1 - p), np.minimum(q, 1 - q))
            hit = solvable & (facing > 0) & (margin >= 0) & (depth > 0.03) & (depth < 60.0)
            depths[k, hit] = depth[hit]
            near = solvable & (facing > 0) & (depth > 0)
            margins[k, near] = np.abs(margin[near])
        nearest = depths.min(axis=0)
        panel = np.where(np.isfinite(nearest), depths.argmin(axis=0), -1)
        second = np.sort(depths, axis=0)[1] if len(depths) > 1 else np.full(len(pixels), np.inf)
        with np.errstate(invalid="ignore"):
            tie = np.isfinite(second) & (second - nearest < 1e-4 * nearest)
        doubtful = (margins.min(axis=0) < 1e-5) | tie
        points = origin + np.where(np.isfinite(nearest), nearest, 0.0)[:, None] * rays
        return Cast(panel, points, doubtful)


@pytest.fixture(scope="session")
def caster() -> RayCaster:
    """An independent opinion on what is seen where."""
    return RayCaster()


@pytest.fixture(scope="session")
def office() -> World:
    """Three rooms."""
    return make_world("office", 11, rooms=3)


@pytest.fixture
def bare() -> World:
    """Nothing but floor, 200 m wide."""
    return World("bare", BuildingPlan((Rectangle.spanning(-100, -100, 100, 100, "room 0"),), ()), (), ())


@pytest.fixture
def walled() -> World:
    """A floor with one wall, its face at x = 1 m."""
    wall = Rectangle.spanning(1.0, -3.0, 1.2, 3.0)
    plan = BuildingPlan((Rectangle.spanning(-10, -10, 10, 10, "room 0"),), (wall,))
    return World("walled", plan, (Block(wall, 0.0, 2.0),), ())


def upright(pose: Pose2) -> tuple[Array, Array]:
    """Rotation and position in space of a robot that stands level."""
    rotation = np.eye(3)
    rotation[:2, :2] = pose.rotation
    return rotation, np.array([pose.x, pose.y, 0.0])


@pytest.fixture(scope="session")
def stand():
    """`upright` for tests."""
    return upright


@pytest.fixture
def stage() -> Iterator[Stage]:
    """A bridge, not yet started, that ends with the test."""
    made = Stage()
    yield made
    made.end()

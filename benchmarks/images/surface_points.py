"""Where the points that a robot follows really are: rays from its true camera against the world's panels."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.sim.scene import cross
from mapweave.sim.world import PanelSet, World

NEAREST = 0.03
"""As near as the simulator draws, m."""
PATCH_PX = 5.0
"""Half the side of the patch that is followed."""
FLAT = 0.02
"""A patch whose corners lie within this of one plane is on one surface, m."""


@dataclass(frozen=True, eq=False)
class Sight:
    """What rays meet.

    Attributes:
        points: (N, 3) m, in world; NaN where a ray meets nothing.
        normals: (N, 3) unit normals of the surfaces there; NaN likewise.
        depths: (N,) m along the optical axis; infinite where a ray meets nothing.
    """

    points: Array
    normals: Array
    depths: Array


class Surfaces:
    """All that stands still in a world, as a camera sees it. Knows nothing of the renderer."""

    def __init__(self, world: World) -> None:
        """Take the panels of a world as it is furnished now."""
        panels = PanelSet.of(world.panels)
        self._corner, self._along, self._down = panels.corner, panels.along, panels.down
        self._normal = cross(panels.along, panels.down)

    def see(self, world_from_robot: Pose2, camera: Camera, pixels: Array) -> Sight:
        """Follow the rays of pixels (N, 2) px, undistorted, from a robot that stands level."""
        eye = np.array([camera.mount_forward, 0.0, camera.mount_height])
        ahead = camera.back_project(pixels, np.ones(len(pixels))) - eye
        rays = Pose2(heading=world_from_robot.heading).apply(ahead)
        centre = world_from_robot.apply(eye)
        offset = self._corner - centre
        # centre + depth ray = corner + p along + q down, by Cramer's rule; a front looks against the normal.
        facing = rays @ self._normal.T
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.einsum("mi,mi->m", offset, self._normal) / facing
            p = rays @ cross(self._down, offset).T / facing
            q = rays @ cross(offset, self._along).T / facing
        inside = (p >= 0.0) & (p <= 1.0) & (q >= 0.0) & (q <= 1.0)
        depth = np.where((facing > 0.0) & inside & (depth > NEAREST), depth, np.inf)
        nearest = depth.argmin(axis=1)
        depths = depth[np.arange(len(rays)), nearest]
        met = np.isfinite(depths)
        points = np.full(rays.shape, np.nan)
        points[met] = centre + depths[met, None] * rays[met]
        normals = np.full(rays.shape, np.nan)
        met_normals = self._normal[nearest[met]]
        normals[met] = met_normals / np.linalg.norm(met_normals, axis=1, keepdims=True)
        return Sight(points, normals, depths)

    def flat(self, world_from_robot: Pose2, camera: Camera, pixels: Array) -> NDArray[np.bool_]:
        """(N,) whether the patch around each pixel (N, 2) px shows one plane, so that it is one point.

        Where a near edge stands before a far wall, what is followed is the crossing of two contours,
        which is no point of the world and moves as none would.
        """
        corners = PATCH_PX * np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])
        middle = self.see(world_from_robot, camera, pixels)
        around = self.see(world_from_robot, camera, (pixels[:, None] + corners).reshape(-1, 2))
        away = around.points.reshape(-1, 4, 3) - middle.points[:, None]
        off = np.abs(np.einsum("nki,ni->nk", away, middle.normals))
        # NaN, where something meets nothing, is not flat.
        return np.asarray((off <= FLAT).all(axis=1))

"""PyBullet's own camera on a world's blocks without textures: the least that a simulator on it pays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Pose2
from mapweave.sim.physics import Physics
from mapweave.sim.world import World

NEAR, FAR = 0.03, 60.0


class BareView:
    """Grey boxes in PyBullet's TinyRenderer, no shadows."""

    def __init__(self, world: World) -> None:
        """Build the blocks, for the eye alone."""
        self._physics = p = Physics()
        for block in world.blocks:
            base, height = block.base, block.top - block.bottom
            half = [base.length / 2, base.width / 2, height / 2]
            shape = p.createVisualShape(p.GEOM_BOX, halfExtents=half, rgbaColor=[0.6, 0.6, 0.6, 1])
            p.createMultiBody(
                0, -1, shape, [base.x, base.y, block.bottom + height / 2],
                p.getQuaternionFromEuler([0, 0, base.heading]),
            )  # fmt: skip

    def render(self, camera: Camera, world_from_robot: Pose2) -> NDArray[np.uint8]:
        """(H, W, 4) as PyBullet gives it."""
        p, c = self._physics, camera
        eye = world_from_robot.apply(np.array([c.mount_forward, 0.0, c.mount_height]))
        ahead = world_from_robot.apply(np.array([c.mount_forward + 1.0, 0.0, c.mount_height]))
        view = p.computeViewMatrix(eye.tolist(), ahead.tolist(), [0, 0, 1])
        projection = [
            2 * c.fx / c.width, 0, 0, 0, 0, 2 * c.fy / c.height, 0, 0,
            0, 0, -(FAR + NEAR) / (FAR - NEAR), -1, 0, 0, -2 * FAR * NEAR / (FAR - NEAR), 0,
        ]  # fmt: skip
        answer = p.getCameraImage(c.width, c.height, view, projection, renderer=p.ER_TINY_RENDERER, shadow=0)
        return np.asarray(answer[2], np.uint8).reshape(c.height, c.width, 4)

"""Landmarks as the filters return them: values, in metres and in the robot's frame."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.ekf.inverse_depth import points_of_rays
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array

Ids = NDArray[np.int64]
"""Landmark ids as the front end numbers them."""


class LandmarkEstimates(NamedTuple):
    """Landmarks as a filter knows them now, in columns.

    Attributes:
        ids: (N,) as the front end numbers them.
        points_in_robot: (N, 3) m, in robot; NaN for landmarks that may as well be at infinity (w <= 0).
        covariances_in_robot: (N, 3, 3) m^2, in robot, to first order; infinite where the point is NaN.
        depths: (N,) m along the optical axis from the optical centre; infinite for w <= 0.
        depth_sigmas: (N,) m, to first order; infinite for w <= 0.
    """

    ids: Ids
    points_in_robot: Array
    covariances_in_robot: Array
    depths: Array
    depth_sigmas: Array

    @staticmethod
    def of_rays(ids: Ids, rays: Array, covariances: Array, camera: Camera) -> LandmarkEstimates:
        """Make them of rays (N, 3) [a, b, w 1/m] in the camera and their covariances (N, 3, 3)."""
        w = rays[:, 2]
        finite = w > 0.0
        depths = np.where(finite, 1.0 / np.where(finite, w, 1.0), np.inf)
        sigmas = np.where(finite, np.sqrt(covariances[:, 2, 2]) * depths**2, np.inf)
        points, by_ray = points_of_rays(rays, camera.mount_forward, camera.mount_height)
        in_robot = by_ray @ covariances @ np.swapaxes(by_ray, 1, 2)
        in_robot[~finite] = np.inf
        return LandmarkEstimates(ids, points, in_robot, depths, sigmas)


class NodeLandmarks(NamedTuple):
    """Landmarks in a node's robot frame, in columns.

    Attributes:
        ids: (n,).
        points: (n, 3) m, in the node's robot frame; NaN where w <= 0, that may as well be at infinity.
        covariances: (n, 3, 3) m^2, in the node's robot frame, to first order.
    """

    ids: Ids
    points: Array
    covariances: Array

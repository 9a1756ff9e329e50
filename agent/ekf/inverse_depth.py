"""Landmarks anchored at a node's camera, seen from another pose: the localization filter's measurement.

A landmark is (a, b, w), slopes and inverse depth as in mapweave.agent.ekf.motion, here of a camera fixed at
the node. Only (a, w) are estimated, two numbers a landmark as in the paper. The paper fixes the height; here
b is fixed, which the node's image measures: the height of a landmark of uncertain depth is uncertain, its
slope is known to a pixel (docs/decisions/ekf-localization.md).
"""

from dataclasses import dataclass

import numpy as np

from mapweave.hybridmap.pose import Array


@dataclass(frozen=True, eq=False, slots=True)
class AnchoredProjection:
    """Landmarks as a camera at a pose sees them.

    Attributes:
        rays: (N, 3) [a, b, w 1/m] in that camera.
        by_pose: (N, 3, 3) Jacobian by the pose [x m, y m, heading rad] of the robot in the node.
        by_ray: (N, 3, 3) Jacobian by [a, b, w] at the node.
        scale: (N,) depth there over depth at the node; not positive behind the camera, where the other
            figures mean nothing.
    """

    rays: Array
    by_pose: Array
    by_ray: Array
    scale: Array


def project_anchored(pose_vector: Array, rays: Array, mount_forward: float) -> AnchoredProjection:
    """See a node's landmarks from a pose in the node's robot frame.

    Args:
        pose_vector: (3,) [x m, y m, heading rad], node_from_robot.
        rays: (N, 3) [a, b, w 1/m] at the node.
        mount_forward: of both optical centres ahead of their axles, m.
    """
    c, s = np.cos(pose_vector[2]), np.sin(pose_vector[2])
    x = pose_vector[0] + mount_forward * (c - 1.0)
    y = pose_vector[1] + mount_forward * s
    a, b, w = rays.T
    ahead, right = 1.0 - w * x, a + w * y
    scale = c * ahead - s * right
    safe = np.where(np.abs(scale) > 1e-9, scale, 1e-9)
    projected = np.stack([(s * ahead + c * right) / safe, b / safe, w / safe], axis=1)
    # Each is a quotient n / D: its derivative is (dn - (n / D) dD) / D.
    scale_by_pose = np.stack([-c * w, -s * w, -(s * ahead + c * right)], axis=1)
    by_pose = -projected[:, :, None] * scale_by_pose[:, None, :]
    by_pose[:, 0, 0] -= s * w
    by_pose[:, 0, 1] += c * w
    by_pose[:, 0, 2] += scale + mount_forward * w
    by_ray = np.zeros((len(rays), 3, 3))
    by_ray[:, :, 0] = s * projected
    by_ray[:, :, 2] = (c * x + s * y) * projected
    by_ray[:, 0, 0] += c
    by_ray[:, 0, 2] += c * y - s * x
    by_ray[:, 1, 1] = 1.0
    by_ray[:, 2, 2] += 1.0
    return AnchoredProjection(projected, by_pose / safe[:, None, None], by_ray / safe[:, None, None], scale)


def rays_of_points(points: Array, mount_forward: float, mount_height: float) -> tuple[Array, Array]:
    """Slopes and inverse depths of points.

    Args:
        points: (N, 3) m, in the node's robot frame; those not ahead of the camera give rays of w <= 0.
        mount_forward: of the optical centre ahead of the axle, m.
        mount_height: of the optical centre above the floor, m.

    Returns:
        (N, 3) [a, b, w 1/m], and the Jacobian by the point, (N, 3, 3).
    """
    depth = points[:, 0] - mount_forward
    w = 1.0 / np.where(np.abs(depth) > 1e-9, depth, 1e-9)
    rays = np.stack([-points[:, 1] * w, (mount_height - points[:, 2]) * w, w], axis=1)
    by_point = np.zeros((len(points), 3, 3))
    by_point[:, :, 0] = -rays * w[:, None]
    by_point[:, 0, 1] = by_point[:, 1, 2] = -w
    return rays, by_point


def points_of_rays(rays: Array, mount_forward: float, mount_height: float) -> tuple[Array, Array]:
    """Points (N, 3) m in robot of rays (N, 3) [a, b, w 1/m], and the Jacobian by the ray, (N, 3, 3).

    Rays with w <= 0 have no point: NaN.
    """
    finite = rays[:, 2] > 0
    depth = np.where(finite, 1.0 / np.where(finite, rays[:, 2], 1.0), np.nan)
    points = np.stack([depth + mount_forward, -rays[:, 0] * depth, mount_height - rays[:, 1] * depth], axis=1)
    by_ray = np.zeros((len(rays), 3, 3))
    by_ray[:, 1, 0] = by_ray[:, 2, 1] = -depth
    by_ray[:, 0, 2] = -(depth**2)
    by_ray[:, 1, 2] = rays[:, 0] * depth**2
    by_ray[:, 2, 2] = rays[:, 1] * depth**2
    return points, by_ray

"""Coordinates in which a filter may keep a landmark, and what a camera's motion does to them.

All are charts of one homogeneous vector (right, down, ahead, scale) in a camera's frame: the landmark lies at
the first three divided by the fourth, m. A motion of the camera is linear in it, and an image shows right /
ahead and down / ahead. Everything is written for complex numbers too, so that derivatives need no formula:
the imaginary part of f(x + ih) / h is f' to the last digit.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array

Numbers = NDArray[Any]
"""Real, or complex on the way of a derivative."""

_STEP = 1e-30


class Coordinates(Protocol):
    """A chart of landmarks."""

    def lift(self, landmarks: Numbers) -> Numbers:
        """(N, 4) homogeneous vectors of landmarks (N, 3)."""

    def drop(self, vectors: Numbers) -> Numbers:
        """(N, 3) landmarks of homogeneous vectors (N, 4)."""


class Points:
    """(p1, p2, p3) right, down and ahead, m: the paper's."""

    def lift(self, landmarks: Numbers) -> Numbers:
        """See Coordinates."""
        return np.concatenate([landmarks, np.ones((len(landmarks), 1))], axis=1)

    def drop(self, vectors: Numbers) -> Numbers:
        """See Coordinates."""
        return vectors[:, :3] / vectors[:, 3:]


class Rays:
    """(a, b, w), slopes and inverse depth 1/m."""

    def lift(self, landmarks: Numbers) -> Numbers:
        """See Coordinates."""
        a, b, w = landmarks.T
        return np.stack([a, b, np.ones_like(a), w], axis=1)

    def drop(self, vectors: Numbers) -> Numbers:
        """See Coordinates."""
        return vectors[:, [0, 1, 3]] / vectors[:, 2:3]


def from_pose(vectors: Numbers, pose_vector: Numbers, mount_forward: float) -> Numbers:
    """Homogeneous vectors (N, 4) as the camera sees them after the robot has moved to a pose (3,)."""
    x, y, heading = pose_vector
    c, s = np.cos(heading), np.sin(heading)
    right, down, ahead, scale = vectors.T
    ahead = ahead - (x + mount_forward * (c - 1.0)) * scale
    right = right + (y + mount_forward * s) * scale
    return np.stack(
        [s * ahead + c * right, down + 0.0 * right, c * ahead - s * right, scale + 0.0 * right], 1
    )


def of_robot(points: Array, camera: Camera) -> Array:
    """(N, 4) homogeneous vectors of points (N, 3) m in robot."""
    right, down = -points[:, 1], camera.mount_height - points[:, 2]
    return np.stack([right, down, points[:, 0] - camera.mount_forward, np.ones(len(points))], axis=1)


def in_robot(vectors: Array, camera: Camera) -> Array:
    """(N, 3) m, points in robot of homogeneous vectors (N, 4)."""
    right, down, ahead = (vectors[:, :3] / vectors[:, 3:]).T
    return np.stack([ahead + camera.mount_forward, -right, camera.mount_height - down], axis=1)


def jacobian(function: Callable[[Numbers], Numbers], at: Array) -> Array:
    """Derivative by the last axis of the argument, exact to rounding (complex step).

    Args:
        function: of (k,), or of (N, k) row by row, to any shape.
        at: where.

    Returns:
        The shape of the function's value, and k columns.
    """
    columns = []
    for i in range(at.shape[-1]):
        moved = at.astype(np.complex128)
        moved[..., i] += 1j * _STEP
        columns.append(np.imag(function(moved)) / _STEP)
    return np.stack(columns, axis=-1)

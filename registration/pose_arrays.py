"""Many planar poses at once: the operations of mapweave.hybridmap.pose on arrays.

A pose is a row (x m, y m, heading rad). A Gaussian pose is a row and a (3, 3) covariance of its
perturbation on the right, as in PoseGaussian.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Array


def compose_poses(a: Array, b: Array) -> Array:
    """(N, 3) `x_from_y` and (N, 3) `y_from_z` -> (N, 3) `x_from_z`, wrapped; either may be (1, 3)."""
    (ax, ay, turn), (bx, by, further) = a.T, b.T
    cos, sin = np.cos(turn), np.sin(turn)
    out = np.empty((np.broadcast(ax, bx).size, 3))
    out[:, 0] = ax + cos * bx - sin * by
    out[:, 1] = ay + sin * bx + cos * by
    out[:, 2] = (turn + further + np.pi) % (2 * np.pi) - np.pi
    return out


def inverse_poses(poses: Array) -> Array:
    """(N, 3) inverse poses."""
    x, y, heading = poses.T
    cos, sin = np.cos(heading), np.sin(heading)
    out = np.empty((len(poses), 3))
    out[:, 0] = -cos * x - sin * y
    out[:, 1] = sin * x - cos * y
    out[:, 2] = -heading
    return out


def adjoints(poses: Array) -> Array:
    """(N, 3, 3) matrices Ad with `pose @ delta == (Ad delta) @ pose` to first order."""
    out = np.zeros((len(poses), 3, 3))
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    out[:, 0, 0], out[:, 0, 1], out[:, 0, 2] = cos, -sin, poses[:, 1]
    out[:, 1, 0], out[:, 1, 1], out[:, 1, 2] = sin, cos, -poses[:, 0]
    out[:, 2, 2] = 1.0
    return out


@dataclass(frozen=True, eq=False)
class PoseGaussians:
    """N Gaussian poses.

    Attributes:
        means: (N, 3) m, m, rad.
        covariances: (N, 3, 3), in the moving frame.
    """

    means: Array
    covariances: Array

    def __matmul__(self, other: PoseGaussians) -> PoseGaussians:
        """Compose independent Gaussian poses to first order, row by row."""
        ad = adjoints(inverse_poses(other.means))
        carried = ad @ self.covariances @ ad.transpose(0, 2, 1)
        return PoseGaussians(compose_poses(self.means, other.means), carried + other.covariances)

    def inverse(self) -> PoseGaussians:
        """The Gaussians of the inverse poses to first order."""
        ad = adjoints(self.means)
        return PoseGaussians(inverse_poses(self.means), ad @ self.covariances @ ad.transpose(0, 2, 1))

    def distances2(self) -> Array:
        """(N,) squared Mahalanobis distances of the identity from the means, 3 degrees of freedom."""
        off = inverse_poses(self.means)
        off[:, 2] = (off[:, 2] + np.pi) % (2 * np.pi) - np.pi
        try:
            solved = np.linalg.solve(self.covariances, off[:, :, None])[:, :, 0]
        except np.linalg.LinAlgError:
            # Rounding next to a huge variance may make a covariance singular.
            solved = (np.linalg.pinv(self.covariances, hermitian=True) @ off[:, :, None])[:, :, 0]
        out: Array = (off * solved).sum(axis=1)
        return out

    def take(self, index: NDArray[Any]) -> PoseGaussians:
        """The rows that an index or a mask selects."""
        return PoseGaussians(self.means[index], self.covariances[index])

"""Planar poses, SE(2), and Gaussian poses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import InvalidValue

Array = NDArray[np.float64]


def wrap_angle(angle: float) -> float:
    """Return the angle in [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@dataclass(frozen=True, slots=True)
class Pose2:
    """A pose in the plane: pose of frame b in frame a. Name it `a_from_b`.

    Attributes:
        x: m, in a.
        y: m, in a.
        heading: rad, counter-clockwise from a's x axis to b's, not necessarily wrapped.
    """

    x: float = 0.0
    y: float = 0.0
    heading: float = 0.0

    def __matmul__(self, other: Pose2) -> Pose2:
        """Return `a_from_c = a_from_b @ b_from_c`, heading wrapped."""
        c, s = math.cos(self.heading), math.sin(self.heading)
        return Pose2(
            self.x + c * other.x - s * other.y,
            self.y + s * other.x + c * other.y,
            wrap_angle(self.heading + other.heading),
        )

    def inverse(self) -> Pose2:
        """Return `b_from_a`."""
        c, s = math.cos(self.heading), math.sin(self.heading)
        return Pose2(-c * self.x - s * self.y, s * self.x - c * self.y, wrap_angle(-self.heading))

    def apply(self, points: NDArray[Any]) -> Array:
        """Map points of frame b into frame a.

        Args:
            points: (..., 2) or (..., 3) m, in b; a third coordinate is height and stays.
        """
        points = np.asarray(points, dtype=np.float64)
        c, s = math.cos(self.heading), math.sin(self.heading)
        out = points.copy()
        out[..., 0] = self.x + c * points[..., 0] - s * points[..., 1]
        out[..., 1] = self.y + s * points[..., 0] + c * points[..., 1]
        return out

    @property
    def vector(self) -> Array:
        """(3,) [x m, y m, heading rad]."""
        return np.array([self.x, self.y, self.heading])

    @property
    def rotation(self) -> Array:
        """(2, 2) rotation that turns vectors of b into a."""
        c, s = math.cos(self.heading), math.sin(self.heading)
        return np.array([[c, -s], [s, c]])

    @property
    def adjoint(self) -> Array:
        """(3, 3) Ad with `pose @ delta == (Ad delta) @ pose` to first order, order (x, y, heading)."""
        c, s = math.cos(self.heading), math.sin(self.heading)
        return np.array([[c, -s, self.y], [s, c, -self.x], [0.0, 0.0, 1.0]])

    def distance(self, other: Pose2) -> float:
        """Euclidean distance of the two positions, m."""
        return math.hypot(self.x - other.x, self.y - other.y)

    @staticmethod
    def from_vector(vector: NDArray[Any]) -> Pose2:
        """Build from (3,) [x m, y m, heading rad]."""
        return Pose2(float(vector[0]), float(vector[1]), float(vector[2]))


@dataclass(frozen=True, eq=False)
class PoseGaussian:
    """A pose with uncertainty, perturbed on the right.

    The true pose is `mean @ Pose2(d)` with d ~ N(0, covariance): the covariance is in the moving
    frame b of `a_from_b`, order (x m, y m, heading rad). This is also GTSAM's convention.
    """

    mean: Pose2
    covariance: Array

    def __post_init__(self) -> None:
        """Refuse what is not finite, (3, 3), symmetric and positive semi-definite (InvalidValue)."""
        p = np.asarray(self.covariance, dtype=np.float64)
        numbers: list[float] = p.ravel().tolist()
        mean = self.mean
        if p.shape != (3, 3) or not all(map(math.isfinite, (mean.x, mean.y, mean.heading, *numbers))):
            raise InvalidValue("a pose needs finite numbers and a (3, 3) covariance")
        if not _is_covariance(*numbers):
            raise InvalidValue("a pose's covariance must be symmetric and positive semi-definite")
        _, xy, xh, yx, _, yh, hx, hy, _ = numbers
        symmetric = (xy, xh, yh) == (yx, hx, hy)
        object.__setattr__(self, "covariance", p.copy() if symmetric else 0.5 * (p + p.T))

    def __matmul__(self, other: PoseGaussian) -> PoseGaussian:
        """Compose two independent Gaussian poses to first order."""
        ad = other.mean.inverse().adjoint
        return PoseGaussian(
            self.mean @ other.mean, nearest_covariance(ad @ self.covariance @ ad.T + other.covariance)
        )

    def inverse(self) -> PoseGaussian:
        """Return the Gaussian of the inverse pose to first order."""
        ad = self.mean.adjoint
        return PoseGaussian(self.mean.inverse(), nearest_covariance(ad @ self.covariance @ ad.T))

    def mahalanobis2(self, other: Pose2) -> float:
        """Squared Mahalanobis distance of a pose from the mean, 3 degrees of freedom."""
        d = (self.mean.inverse() @ other).vector
        return float(d @ np.linalg.solve(self.covariance + 1e-12 * np.eye(3), d))

    @staticmethod
    def from_sigmas(mean: Pose2, sigma_xy: float, sigma_heading: float) -> PoseGaussian:
        """Build with independent standard deviations, m and rad."""
        return PoseGaussian(mean, np.diag([sigma_xy**2, sigma_xy**2, sigma_heading**2]))


def nearest_covariance(matrix: Array) -> Array:
    """(3, 3) the same if it is a covariance, else the nearest one.

    Of what was worked out with a lever of kilometres, or solved with directions of which hardly anything is
    known, rounding may leave none.
    """
    if _is_covariance(*matrix.ravel().tolist()):
        return matrix
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    nearest: Array = vectors * np.maximum(values, 0.0) @ vectors.T
    return nearest


def _is_covariance(*p: float) -> bool:
    """Whether a (3, 3) matrix, by rows, is symmetric and has no eigenvalue below -1e-6 of its largest number.

    By Cholesky's pivots of what that much more on the diagonal makes positive: a store of many thousand nodes
    asks this of each, and a call to LAPACK takes longer than the arithmetic.
    """
    slack = 1e-6 * max(max(map(abs, p)), 1e-12)
    if max(abs(p[1] - p[3]), abs(p[2] - p[6]), abs(p[5] - p[7])) > slack:
        return False
    first = p[0] + slack
    if first <= 0.0:
        return False
    # Quotients first: a power that overflows raises.
    second = p[4] + slack - p[3] * (p[3] / first)
    if second <= 0.0:
        return False
    mixed = p[7] - p[6] * (p[3] / first)
    return p[8] + slack - p[6] * (p[6] / first) - mixed * (mixed / second) > 0.0


def averaged(poses: Sequence[PoseGaussian]) -> PoseGaussian:
    """One pose from several estimates of it, each weighted by its information.

    The covariance is the mean of the estimates' own: their common errors do not average out, and their size
    is unknown.

    Args:
        poses: at least one, near to each other.
    """
    first = poses[0].mean
    weights = [np.linalg.inv(pose.covariance + 1e-12 * np.eye(3)) for pose in poses]
    pulls = [w @ (first.inverse() @ pose.mean).vector for w, pose in zip(weights, poses, strict=True)]
    step = np.linalg.solve(np.sum(weights, axis=0), np.sum(pulls, axis=0))
    covariance = np.mean([pose.covariance for pose in poses], axis=0)
    return PoseGaussian(first @ Pose2.from_vector(step), covariance)

"""Innovations of the mapping filter and their joint covariance.

The image measures entries of the state itself, the slopes (a, b) of landmarks. With S = L L^T the covariance
of all innovations of an image, W = L^-1 whitens them and serves everything: W^T W is the information for the
leave-one-out tests, |W r|^2 the NIS, W B the sensitivity to the wheels' errors, and W P_M the update's root.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Array

LEAF = 32
"""Rows of a triangle that LAPACK inverts at once: measured, for triangles of 20 to 200 rows."""


class Examined(NamedTuple):
    """An image compared with its prediction.

    Attributes:
        innovations: (m, 2) slopes, measured minus expected.
        whitening: (2m, 2m) W of all of them.
        worst: largest of their distances from the prediction by all others (`leave_one_out`).
        median: of these distances.
    """

    innovations: Array
    whitening: Array
    worst: float
    median: float


def measured_entries(slots: NDArray[np.intp]) -> NDArray[np.intp]:
    """(2m,) entries of the state that the pixels of some landmarks (m,) measure: their a and b."""
    return np.asarray((3 + 3 * slots[:, None] + (0, 1)).ravel(), np.intp)


def innovation_covariance(covariance: Array, slots: NDArray[np.intp], variances: Array) -> Array:
    """(2m, 2m) joint covariance S of the innovations of m landmarks.

    Args:
        covariance: (3 + 3n, 3 + 3n) of [pose, (a, b, w) of each landmark].
        slots: (m,) which landmarks, of 0 ... n - 1.
        variances: (2,) of a measured slope: horizontal, vertical.
    """
    index = measured_entries(slots)
    out: Array = covariance.take(index, axis=0).take(index, axis=1)
    diagonal = out.ravel()[:: len(index) + 1]
    diagonal[0::2] += variances[0]
    diagonal[1::2] += variances[1]
    return out


def whiten(covariance: Array) -> Array:
    """Inverse W, (n, n), of Cholesky's factor of the covariance S = L L^T, (n, n), lower triangular.

    W r are residuals of unit variance that know nothing of each other, and W^T W is the inverse of S.

    Raises:
        numpy.linalg.LinAlgError: S is no covariance, or a singular one.
    """
    return _inverse_of_triangle(np.asarray(np.linalg.cholesky(covariance), np.float64))


def _inverse_of_triangle(lower: Array) -> Array:
    """Inverse of a lower triangle by halves: [[A, 0], [B, C]] has the inverse [[A', 0], [-C' B A', C']].

    NumPy's inverse knows of no triangles: it takes 1.7 times as long for 46 rows, 3 times for 150.
    """
    size, half = len(lower), len(lower) // 2
    if size <= LEAF:
        return np.asarray(np.linalg.inv(lower), np.float64)
    out = np.zeros((size, size))
    out[:half, :half] = _inverse_of_triangle(lower[:half, :half])
    out[half:, half:] = _inverse_of_triangle(lower[half:, half:])
    out[half:, :half] = -out[half:, half:] @ (lower[half:, :half] @ out[:half, :half])
    return out


def leave_one_out(innovations: Array, whitening: Array) -> Array:
    """(m,) squared Mahalanobis distance of each innovation given all the others.

    With Q the inverse of S, an innovation given all others has mean residual Q_ii^-1 (Q r)_i and covariance
    Q_ii^-1, so that one inverse serves all m tests.

    Args:
        innovations: (m, 2) measured minus expected.
        whitening: (2m, 2m) W of S.
    """
    information = whitening.T @ whitening
    x, y = (information @ innovations.ravel()).reshape(-1, 2).T
    p, r = information.diagonal()[::2], information.diagonal()[1::2]
    q = information.diagonal(1)[::2]
    return np.asarray((r * x * x - 2.0 * q * x * y + p * y * y) / (p * r - q * q), np.float64)


def examine(
    rays: Array, covariance: Array, slots: NDArray[np.intp], slopes: Array, variances: Array
) -> Examined:
    """Compare an image with its prediction.

    Args:
        rays: (n, 3) expected.
        covariance: (3 + 3n, 3 + 3n) P.
        slots: (m,) landmarks seen, m > 0.
        slopes: (m, 2) where.
        variances: (2,) of a slope.
    """
    innovations = slopes - rays[slots, :2]
    whitening = whiten(innovation_covariance(covariance, slots, variances))
    distances = np.sort(leave_one_out(innovations, whitening))
    return Examined(innovations, whitening, float(distances[-1]), float(distances[len(slots) // 2]))


def turn_by_image(
    rays: Array, slots: NDArray[np.intp], slopes: Array, wheel_root: Array, most: float
) -> float:
    """How much the robot has turned further than its wheels measured, rad, by the landmarks in the image.

    The image shows a turn as da = (1 + a^2) du2, the same for near and far landmarks. The estimate is the
    mean of the middle half, so that a quarter may be wrong on either side, and its error follows from the
    half's width: a Gaussian's is 1.35 sigma wide, and its mean has 1.2 times the variance of the whole mean.
    It and the wheels are weighted by their variances.

    Args:
        rays: (n, 3) expected.
        slots: (m,) landmarks seen, m > 0.
        slopes: (m, 2) where.
        wheel_root: (2, 2) root of the covariance of (u1, u2).
        most: sigmas of the wheels that they may be off.
    """
    a = rays[slots, 0]
    turns = np.sort((slopes[:, 0] - a) / (1.0 + a * a))
    quarter = len(turns) // 4
    half = turns[quarter : len(turns) - quarter]
    variance = 1.2 * (float(half[-1] - half[0]) / 1.35) ** 2 / len(turns)
    wheels = float(wheel_root[1, 0] ** 2 + wheel_root[1, 1] ** 2)
    turn, limit = float(half.sum()) / len(half) * wheels / (wheels + variance), most * math.sqrt(wheels)
    return min(max(turn, -limit), limit)


def wheel_errors(
    by_input: Array, wheel_root: Array, slots: NDArray[np.intp], whitening: Array, residual: Array
) -> tuple[float, float, float]:
    """The wheels' errors, estimated from the residuals of some landmarks.

    With J = W B_M R, the errors in sigmas of the wheels have the score s = J^T W r, which is also their
    posterior mean, and J^T J is its covariance if the wheels are right: what the image could know of them.

    Args:
        by_input: (3 + 3n, 3) B, of which the first two columns count.
        wheel_root: (2, 2) root R of the covariance of (u1, u2).
        slots: (m,) which landmarks.
        whitening: (2m, 2m) W of S.
        residual: (m, 2) r, measured minus expected.

    Returns:
        The posterior mean R s of the errors of u1, m, and u2, rad; and the distance of the score from what
        correct wheels allow, in its own sigmas. Unlike the mean, this does not shrink with the wheels' noise:
        it also refutes wheels that report a standstill without noise, as with a lost encoder.
    """
    lever = whitening @ (by_input[measured_entries(slots), :2] @ wheel_root)
    score = lever.T @ (whitening @ residual.ravel())
    forward, turn = (wheel_root @ score).tolist()
    (p, q), (_, r) = (lever.T @ lever).tolist()
    x, y = score.tolist()
    squares = max(r * x * x - 2.0 * q * x * y + p * y * y, 0.0) / max(p * r - q * q, 1e-300)
    return forward, turn, math.sqrt(squares)

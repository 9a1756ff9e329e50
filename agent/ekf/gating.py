"""Which measurements to accept: chi-square gates and one-point RANSAC.

All tests are made on innovations and their joint covariance S, so that correlations count: a shared error
(the robot turned more than its wheels measured) moves all landmarks together and is no outlier. Everything is
computed for all landmarks at once and without random samples: there are only as many one-point hypotheses
(Civera et al., "1-point RANSAC for EKF filtering", 2010) as landmarks, so all are tried.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.ekf.innovations import leave_one_out, whiten
from mapweave.agent.ekf.update_report import Health
from mapweave.hybridmap.pose import Array

Mask = NDArray[np.bool_]


class Judgement(NamedTuple):
    """What to make of the landmarks of an image.

    Attributes:
        innovations: (m, 2) slopes, measured minus expected.
        inliers: (m,) which of them are accepted.
        whitening: (2k, 2k) what whitens the innovations of these k (mapweave.agent.ekf.innovations.whiten).
        health: of the filter, by this image.
        reason: what is wrong, in words; empty if nothing is.
    """

    innovations: Array
    inliers: Mask
    whitening: Array
    health: Health = Health.GOOD
    reason: str = ""

    @property
    def agreeing(self) -> int:
        """How many are accepted."""
        return len(self.whitening) // 2

    @staticmethod
    def of_none(innovations: Array, health: Health, reason: str) -> Judgement:
        """None of them is accepted."""
        return Judgement(innovations, np.zeros(len(innovations), np.bool_), np.zeros((0, 0)), health, reason)


MEDIAN = 2.0 * math.log(2.0)
"""Of a chi-square with two degrees of freedom."""
GATE_PROBABILITY = 0.999
"""Share of true measurements that each gate lets pass; `pixel_gate` of it is 13.8. Chosen: of 36 landmarks in
view a true one is refused in every 28th image; at 0.99 it would be one in three."""


def pixel_gate(probability: float) -> float:
    """Threshold of a chi-square with two degrees of freedom that inliers stay under with a probability."""
    return -2.0 * math.log1p(-probability)


def one_point_consensus(innovations: Array, covariance: Array, gate: float) -> Mask:
    """The largest set of innovations that one of them explains.

    For each landmark j in turn the state is corrected by j alone; the others agree with j if what remains of
    their innovation lies in the gate of its remaining covariance. Unlike a fixed pixel threshold this needs
    no second pass for landmarks of great uncertainty.

    Args:
        innovations: (N, 2) measured minus expected.
        covariance: (2N, 2N) S.
        gate: chi-square threshold.

    Returns:
        (N,) members of the best set, empty if no landmark lies within the gate by itself.
    """
    n = len(innovations)
    blocks = _blocks(covariance)
    own = blocks[_diagonal(n)]
    plausible = _quadratic(own, innovations) <= gate
    if not plausible.any():
        return np.zeros(n, np.bool_)
    gain = blocks @ _inverse(own)[None, :]
    left = innovations[:, None] - (gain @ innovations[None, :, :, None])[..., 0]
    left_covariance = own[:, None] - gain @ np.swapaxes(blocks, -1, -2)
    # A landmark explains itself: its remaining covariance is zero, so its own test is the plain one.
    left_covariance[_diagonal(n)] = own
    left[_diagonal(n)] = innovations
    distance = _quadratic(left_covariance, left)
    agrees = distance <= gate
    score = agrees.sum(axis=0) - np.minimum(distance, gate).mean(axis=0) / (2.0 * gate)
    return np.ascontiguousarray(agrees[:, int(np.argmax(np.where(plausible, score, -1.0)))])


def select_inliers(innovations: Array, covariance: Array, gate: float) -> tuple[Mask, Array, float]:
    """Which innovations to accept.

    If each agrees with all the others, all are accepted. Else those of the one-point consensus, from which
    the worst is removed until each agrees with all the rest.

    Args:
        innovations: (N, 2) measured minus expected, N > 0.
        covariance: (2N, 2N) S.
        gate: chi-square threshold.

    Returns:
        (N,) accepted; what whitens the accepted ones (mapweave.agent.ekf.innovations.whiten), (2K, 2K); and
        the median of their distances from the prediction by all others, MEDIAN if the noise is nominal and
        if there are none.
    """
    whitening = whiten(covariance)
    distances = leave_one_out(innovations, whitening)
    if distances.max() <= gate:
        return np.ones(len(innovations), np.bool_), whitening, _median(distances)
    return remove_outliers(innovations, covariance, gate)


def remove_outliers(innovations: Array, covariance: Array, gate: float) -> tuple[Mask, Array, float]:
    """The largest consistent set where some innovations do not agree with all the others.

    Args:
        innovations: (N, 2) slopes, measured minus expected.
        covariance: (2N, 2N) of these, joint.
        gate: of a chi-square with two degrees of freedom.

    Returns:
        (N,) which are accepted; the whitening of these, see `whiten`; the median of their distances.
    """
    accepted = one_point_consensus(innovations, covariance, gate)
    while True:
        chosen = np.flatnonzero(np.repeat(accepted, 2))
        whitening = whiten(covariance[np.ix_(chosen, chosen)])
        distances = leave_one_out(innovations[accepted], whitening)
        if not len(distances) or distances.max() <= gate:
            return accepted, whitening, _median(distances)
        accepted[np.flatnonzero(accepted)[int(np.argmax(distances))]] = False


def _median(distances: Array) -> float:
    return float(np.sort(distances)[len(distances) // 2]) if len(distances) else MEDIAN


def _blocks(matrix: Array) -> Array:
    """(N, N, 2, 2) view of a (2N, 2N) matrix."""
    n = len(matrix) // 2
    return matrix.reshape(n, 2, n, 2).transpose(0, 2, 1, 3)


def _diagonal(n: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    index = np.arange(n)
    return index, index


def _inverse(matrices: Array) -> Array:
    """Inverse of symmetric (..., 2, 2)."""
    p, q, r = matrices[..., 0, 0], matrices[..., 0, 1], matrices[..., 1, 1]
    out = np.stack([np.stack([r, -q], axis=-1), np.stack([-q, p], axis=-1)], axis=-2)
    return out / (p * r - q * q)[..., None, None]


def _quadratic(matrices: Array, vectors: Array) -> Array:
    """(...) v^T M^-1 v for symmetric (..., 2, 2) and (..., 2)."""
    p, q, r = matrices[..., 0, 0], matrices[..., 0, 1], matrices[..., 1, 1]
    x, y = vectors[..., 0], vectors[..., 1]
    out: Array = (r * x * x - 2.0 * q * x * y + p * y * y) / (p * r - q * q)
    return out

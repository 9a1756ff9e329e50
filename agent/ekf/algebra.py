"""The costly products of the mapping filter in NumPy; agent.ekf.compiled has them as machine code.

All covariances are those of agent.ekf.moving_state, (3 + 3n, 3 + 3n) of [posture, (a, b, w) of each one].
Here is what an image does to the state; agent.ekf.algebra_motion has what the wheels do.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from agent.ekf.algebra_motion import advance, ahead, drive, propagate, transition
from agent.ekf.landmarks import Ids
from hybridmap.pose import Array

__all__ = [
    "advance", "ahead", "condition", "drive", "examine", "glance", "innovations", "leave_one_out",
    "propagate", "sighted", "slots_of", "spread", "told", "transition", "vote", "wheel_errors", "whiten",
]  # fmt: skip


def spread(covariance: Array, slots: NDArray[np.intp], variances: Array) -> Array:
    """(2m, 2m) joint covariance S of the innovations of m landmarks.

    Args:
        covariance: P.
        slots: (m,) which landmarks, of 0 ... n - 1.
        variances: (2,) of a measured slope: horizontal, vertical.
    """
    index = measured(slots)
    out: Array = covariance[np.ix_(index, index)]
    diagonal = np.arange(len(index))
    out[diagonal, diagonal] += np.tile(variances, len(slots))
    return out


def whiten(spread: Array) -> Array:
    """Inverse W of Cholesky's factor of S = L L^T: W r are residuals of unit variance that know nothing of
    each other, and W^T W is the inverse of S.

    Raises:
        numpy.linalg.LinAlgError: S is no covariance, or a singular one.
    """
    return np.asarray(np.linalg.inv(np.linalg.cholesky(spread)), np.float64)


def leave_one_out(innovations: Array, whitening: Array) -> Array:
    """(m,) squared Mahalanobis distance of each innovation given all the others.

    With Q the inverse of S, an innovation given all others has mean residual Q_ii^-1 (Q r)_i and covariance
    Q_ii^-1, so that one inverse serves all m tests.

    Args:
        innovations: (m, 2) measured minus expected.
        whitening: (2m, 2m) W of S.
    """
    information = whitening.T @ whitening
    pulled = (information @ innovations.ravel()).reshape(-1, 2)
    p, r = information.diagonal()[::2], information.diagonal()[1::2]
    q = information.diagonal(1)[::2]
    x, y = pulled.T
    return np.asarray((r * x * x - 2.0 * q * x * y + p * y * y) / (p * r - q * q), np.float64)


def slots_of(held: Ids, ids: Ids) -> NDArray[np.intp]:
    """(N,) places in the state of landmarks by their ids; -1 for those that it does not hold.

    Args:
        held: (n,) ids of the state's landmarks, each once.
        ids: (N,) of whom.
    """
    places = {landmark: slot for slot, landmark in enumerate(held.tolist())}
    return np.array([places.get(landmark, -1) for landmark in ids.tolist()], np.intp)


def sighted(
    held: Ids, ids: Ids, pixels: Array, centre: Array, focal: Array
) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """Which landmarks of the state an image shows, and where.

    Args:
        held: (n,) ids of the state's landmarks, each once.
        ids: (N,) what was tracked.
        pixels: (N, 2) px where; a row with NaN or infinity was not seen.
        centre: (2,) px, principal point.
        focal: (2,) px.

    Returns:
        (m,) slots in the state and (m,) rows of the image, in the image's order; (m, 2) slopes.
    """
    places = slots_of(held, ids)
    rows = np.flatnonzero((places >= 0) & np.isfinite(pixels).all(axis=1))
    return places[rows], rows, (pixels[rows] - centre) / focal


def told(
    count: int, rows: NDArray[np.intp], believed: NDArray[np.bool_], innovations: Array, focal: Array
) -> tuple[NDArray[np.bool_], Array]:
    """What to tell of all that was tracked, where only some of it was seen.

    Args:
        count: N, of what was tracked.
        rows: (m,) what was seen.
        believed: (m,).
        innovations: (m, 2) slopes.
        focal: (2,) px.

    Returns:
        (N,) accepted, and (N, 2) px innovations; False and NaN for what was not seen.
    """
    accepted, pixels = np.zeros(count, np.bool_), np.full((count, 2), np.nan)
    accepted[rows], pixels[rows] = believed, innovations * focal
    return accepted, pixels


def innovations(rays: Array, slots: NDArray[np.intp], slopes: Array) -> Array:
    """(m, 2) slopes measured minus expected.

    Args:
        rays: (n, 3) expected.
        slots: (m,) which landmarks.
        slopes: (m, 2) measured.
    """
    return np.asarray(slopes - rays[slots, :2], np.float64)


def vote(rays: Array, slots: NDArray[np.intp], slopes: Array, wheel_root: Array, most: float) -> float:
    """By how much further than its wheels say the robot has turned, rad, as the landmarks seen vote.

    The image shows a turn as da = (1 + a^2) du2, alike for all landmarks, near and far. Their vote is the
    mean of the middle half, so that a quarter may be wrong on either side, and its error is told by the
    half's width: a Gaussian's is 1.35 sigma wide, and its mean has 1.2 times the variance of the whole mean.
    It and the wheels are weighed by their variances.

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
    turn, limit = float(half.mean()) * wheels / (wheels + variance), most * math.sqrt(wheels)
    return min(max(turn, -limit), limit)


def examine(
    rays: Array, covariance: Array, slots: NDArray[np.intp], slopes: Array, variances: Array
) -> tuple[Array, Array, float, float]:
    """An image beside what was expected of it.

    Args:
        rays: (n, 3) expected.
        covariance: P.
        slots: (m,) landmarks seen, m > 0.
        slopes: (m, 2) where.
        variances: (2,) of a slope.

    Returns:
        Innovations (m, 2) and W that whitens them; of the landmarks' distances from what all others say
        (leave_one_out) the largest and the median.
    """
    residual = innovations(rays, slots, slopes)
    whitening = whiten(spread(covariance, slots, variances))
    distances = np.sort(leave_one_out(residual, whitening))
    return residual, whitening, float(distances[-1]), float(distances[len(slots) // 2])


def glance(
    posture: Array,
    rays: Array,
    covariance: Array,
    measured: tuple[float, float],
    mount_forward: float,
    wheel_root: Array,
    side_slip: float,
    posture_variances: Array,
    expected: Array,
    slots: NDArray[np.intp],
    slopes: Array,
    variances: Array,
    most: float,
) -> tuple[float, Array, Array, Array, Array, Array, Array, float, float]:
    """A step linearised where its image seems to say that it went, and the image beside what it then expects.

    Three products in one, since each call costs a robot some microseconds: vote, advance, examine.

    Args:
        posture: (3,) before the step.
        rays: (n, 3) before the step.
        covariance: P of both.
        measured: (u1 m, u2 rad) as the wheels tell it.
        mount_forward: of the optical centre ahead of the axle, m.
        wheel_root: (2, 2) root of the covariance of (u1, u2).
        side_slip: sigma of u3, m.
        posture_variances: (3,) the diagonal of Q.
        expected: (n, 3) rays after the step, by the wheels alone.
        slots: (m,) landmarks seen, m > 0.
        slopes: (m, 2) where.
        variances: (2,) of a slope.
        most: sigmas of the wheels that they may be off.

    Returns:
        The turn where it is linearised, rad; what advance returns there; what examine returns.
    """
    turn = measured[1] + vote(expected, slots, slopes, wheel_root, most)
    after = advance(
        posture, rays, covariance, (measured[0], turn), measured, mount_forward, wheel_root, side_slip,
        posture_variances,
    )  # fmt: skip
    return turn, *after, *examine(after[1], after[3], slots, slopes, variances)


def wheel_errors(
    by_input: Array, wheel_root: Array, slots: NDArray[np.intp], whitening: Array, residual: Array
) -> tuple[float, float, float]:
    """What the residuals of some landmarks say of the wheels' errors.

    With J = W B_M R, the errors in sigmas of the wheels have the score s = J^T W r, which is also their
    posterior mean, and J^T J is its covariance if the wheels are right: what the image could know of them.

    Args:
        by_input: (3 + 3n, 3) B, of which the first two columns count.
        wheel_root: (2, 2) root R of the covariance of (u1, u2).
        slots: (m,) which landmarks.
        whitening: (2m, 2m) W of S.
        residual: (m, 2) measured minus expected.

    Returns:
        The posterior mean R s of the errors of u1, m, and u2, rad; and how far the score is from what right
        wheels allow, in its own sigmas. Unlike the mean this does not shrink with the wheels' noise: wheels
        that claim for certain to stand, as with a lost encoder, are refuted as well.
    """
    lever = whitening @ (by_input[measured(slots), :2] @ wheel_root)
    score = lever.T @ (whitening @ residual.ravel())
    forward, turn = (wheel_root @ score).tolist()
    (p, q), (_, r) = (lever.T @ lever).tolist()
    x, y = score.tolist()
    squares = max(r * x * x - 2.0 * q * x * y + p * y * y, 0.0) / max(p * r - q * q, 1e-300)
    return forward, turn, math.sqrt(squares)


def condition(
    posture: Array, rays: Array, covariance: Array, slots: NDArray[np.intp], whitening: Array, residual: Array
) -> tuple[Array, Array, Array, float]:
    """Kalman update by direct measurements of the slopes (a, b) of some landmarks.

    With G = W P_M the state moves by G^T W r, and G^T G is taken off P.

    Args:
        posture: (3,).
        rays: (n, 3).
        covariance: P of both.
        slots: (m,) which landmarks, each once.
        whitening: (2m, 2m) W of S.
        residual: (m, 2) measured minus expected.

    Returns:
        Posture, rays and P after, P symmetric to the last bit; and r^T S^-1 r.
    """
    root = whitening @ covariance[measured(slots)]
    white = whitening @ residual.ravel()
    step = white @ root
    # A product with its own transpose is symmetric to the last bit.
    after = covariance - root.T @ root
    return posture + step[:3], rays + step[3:].reshape(-1, 3), after, float(white @ white)


def measured(slots: NDArray[np.intp]) -> NDArray[np.intp]:
    """(2m,) entries of the state that the pixels of some landmarks measure: their a and b."""
    return np.asarray((3 + 3 * slots[:, None] + np.arange(2)).ravel(), np.intp)

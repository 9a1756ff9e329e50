"""The costly products of the mapping filter in NumPy; agent.ekf.compiled has them as machine code.

All covariances are those of agent.ekf.moving_state, (3 + 3n, 3 + 3n) of [posture, (a, b, w) of each one].
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from agent.ekf.landmarks import Ids
from agent.ekf.motion import move_posture, move_rays
from agent.observation import Odometry
from hybridmap.pose import Array


def transition(
    posture: Array, rays: Array, at: tuple[float, float], measured: tuple[float, float], mount_forward: float
) -> tuple[Array, Array, Array, Array, Array]:
    """A step of the wheels from a state, and its derivatives (agent.ekf.motion).

    Args:
        posture: (3,) [x m, y m, heading rad].
        rays: (n, 3) [a, b, w 1/m].
        at: (u1 m, u2 rad) where the step is linearised: the motion is exact there, and linear from there.
        measured: (u1 m, u2 rad) as the wheels tell it.
        mount_forward: of the optical centre ahead of the axle, m.

    Returns:
        Posture and rays after the step measured; (n,) depth after over depth before; (1 + n, 3, 3) blocks of
        the Jacobian by the state, of the posture and of each landmark; (3 + 3n, 3) Jacobian by (u1, u2, u3).
    """
    step = Odometry(*at)
    moved_posture, by_posture, posture_by_input = move_posture(posture, step)
    moved = move_rays(rays, step, mount_forward)
    blocks = np.concatenate([by_posture[None], moved.by_ray])
    by_input = np.concatenate([posture_by_input, moved.by_input.reshape(-1, 3)])
    if at == measured:
        return moved_posture, moved.rays, moved.scale, blocks, by_input
    shift = by_input[:, :2] @ np.subtract(measured, at)
    return moved_posture + shift[:3], moved.rays + shift[3:].reshape(-1, 3), moved.scale, blocks, by_input


def propagate(
    covariance: Array,
    transitions: Array,
    by_input: Array,
    wheel_root: Array,
    side_slip: float,
    variances: Array,
) -> Array:
    """A P A^T + B S B^T + Q of a motion whose A is block diagonal, symmetric to the last bit.

    Args:
        covariance: P before.
        transitions: (1 + n, 3, 3) blocks of A: of the posture, then of each landmark.
        by_input: (3 + 3n, 3) B, by (u1, u2, u3).
        wheel_root: (2, 2) root of the covariance of (u1, u2).
        side_slip: sigma of u3, m.
        variances: (3,) of the posture, the diagonal of Q.
    """
    blocks, size = len(transitions), len(covariance)
    # 3x3 blocks times rows, never the dense product.
    half = (transitions @ covariance.reshape(blocks, 3, size)).reshape(size, size)
    moved = (transitions @ half.T.reshape(blocks, 3, size)).reshape(size, size)
    out: Array = moved + moved.T
    out *= 0.5
    root = np.column_stack([by_input[:, :2] @ wheel_root, side_slip * by_input[:, 2]])
    out += root @ root.T
    out[[0, 1, 2], [0, 1, 2]] += variances
    return out


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


def ahead(rays: Array, scale: Array, nearest: float, widest_slope: float) -> NDArray[np.bool_]:
    """(n,) landmarks that lie before the camera after a step, not too near and not too far aside.

    Args:
        rays: (n, 3) after the step.
        scale: (n,) depth after over depth before.
        nearest: m.
        widest_slope: of |a|.
    """
    near = rays[:, 2] * nearest <= 1.0
    return np.asarray(near & (scale > 1e-3) & (np.abs(rays[:, 0]) <= widest_slope), np.bool_)


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

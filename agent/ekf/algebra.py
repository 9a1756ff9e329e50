"""The costly products of the mapping filter in NumPy; agent.ekf.compiled has them as machine code.

All covariances are those of agent.ekf.moving_state, (3 + 3n, 3 + 3n) of [posture, (a, b, w) of each one].
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agent.ekf.motion import move_posture, move_rays
from agent.observation import Odometry
from hybridmap.pose import Array


def transition(
    posture: Array, rays: Array, forward: float, turn: float, mount_forward: float
) -> tuple[Array, Array, Array, Array, Array]:
    """A step of the wheels from a state, and its derivatives (agent.ekf.motion).

    Args:
        posture: (3,) [x m, y m, heading rad].
        rays: (n, 3) [a, b, w 1/m].
        forward: u1, m.
        turn: u2, rad.
        mount_forward: of the optical centre ahead of the axle, m.

    Returns:
        Posture and rays after; (n,) depth after over depth before; (1 + n, 3, 3) blocks of the Jacobian by
        the state, of the posture and of each landmark; (3 + 3n, 3) Jacobian by (u1, u2, u3).
    """
    step = Odometry(forward, turn)
    moved_posture, by_posture, posture_by_input = move_posture(posture, step)
    moved = move_rays(rays, step, mount_forward)
    blocks = np.concatenate([by_posture[None], moved.by_ray])
    by_input = np.concatenate([posture_by_input, moved.by_input.reshape(-1, 3)])
    return moved_posture, moved.rays, moved.scale, blocks, by_input


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


def inverse(matrix: Array) -> Array:
    """Inverse of a positive definite matrix, symmetric to the last bit.

    Raises:
        numpy.linalg.LinAlgError: it is singular.
    """
    out = np.linalg.inv(matrix)
    return np.asarray(0.5 * (out + out.T), np.float64)


def leave_one_out(innovations: Array, information: Array) -> Array:
    """(m,) squared Mahalanobis distance of each innovation given all the others.

    With Q the inverse of S, an innovation given all others has mean residual Q_ii^-1 (Q r)_i and covariance
    Q_ii^-1, so that one inverse serves all m tests.

    Args:
        innovations: (m, 2) measured minus expected.
        information: (2m, 2m) inverse of S.
    """
    pulled = (information @ innovations.ravel()).reshape(-1, 2)
    p, r = information.diagonal()[::2], information.diagonal()[1::2]
    q = information.diagonal(1)[::2]
    x, y = pulled.T
    return np.asarray((r * x * x - 2.0 * q * x * y + p * y * y) / (p * r - q * q), np.float64)


def finite_rows(matrix: Array) -> NDArray[np.intp]:
    """(k,) rows of an (N, 2) matrix without NaN or infinity."""
    return np.flatnonzero(np.isfinite(matrix).all(axis=1))


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


def pull(by_input: Array, slots: NDArray[np.intp], information: Array, residual: Array) -> Array:
    """(2, 3) what the residuals of some landmarks say of the two inputs: B_M^T S^-1 [B_M, r].

    Args:
        by_input: (3 + 3n, 3) B, of which the first two columns count.
        slots: (m,) which landmarks.
        information: (2m, 2m) inverse of S.
        residual: (2m,) measured minus expected.
    """
    lever = by_input[measured(slots), :2]
    return np.asarray(lever.T @ information @ np.column_stack([lever, residual]), np.float64)


def condition(
    covariance: Array, slots: NDArray[np.intp], information: Array, variances: Array, residual: Array
) -> tuple[Array, Array]:
    """Kalman update by direct measurements of the slopes (a, b) of some landmarks.

    Args:
        covariance: P.
        slots: (m,) which landmarks.
        information: (2m, 2m) inverse of S.
        variances: (2,) of a slope, as given to spread; the compiled form needs them.
        residual: (2m,) measured minus expected.

    Returns:
        The step of the state, (3 + 3n,), and P after, symmetric to the last bit.
    """
    columns = covariance[:, measured(slots)]
    # A product with its own transpose stays symmetric to the last bit.
    root = columns @ np.linalg.cholesky(information)
    return columns @ (information @ residual), covariance - root @ root.T


def measured(slots: NDArray[np.intp]) -> NDArray[np.intp]:
    """(2m,) entries of the state that the pixels of some landmarks measure: their a and b."""
    return np.asarray((3 + 3 * slots[:, None] + np.arange(2)).ravel(), np.intp)

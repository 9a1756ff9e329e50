"""What the wheels do to the mapping filter's state, in NumPy (agent.ekf.algebra)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agent.ekf.motion import move_posture, move_rays
from agent.observation import Odometry
from hybridmap.pose import Array


def drive(
    posture: Array,
    rays: Array,
    measured: tuple[float, float],
    mount_forward: float,
    nearest: float,
    widest_slope: float,
) -> tuple[Array, Array, NDArray[np.bool_], int]:
    """Where a step of the wheels leads, without its derivatives.

    Args:
        posture: (3,) [x m, y m, heading rad].
        rays: (n, 3) [a, b, w 1/m].
        measured: (u1 m, u2 rad) as the wheels tell it.
        mount_forward: of the optical centre ahead of the axle, m.
        nearest: m; see ahead.
        widest_slope: see ahead.

    Returns:
        Posture and rays after the step; (n,) which landmarks are still ahead, and how many are not.
    """
    moved_posture, _, _ = move_posture(posture, Odometry(*measured))
    moved = move_rays(rays, Odometry(*measured), mount_forward)
    stays = ahead(moved.rays, moved.scale, nearest, widest_slope)
    return moved_posture, moved.rays, stays, len(stays) - int(np.count_nonzero(stays))


def advance(
    posture: Array,
    rays: Array,
    covariance: Array,
    at: tuple[float, float],
    measured: tuple[float, float],
    mount_forward: float,
    wheel_root: Array,
    side_slip: float,
    posture_variances: Array,
) -> tuple[Array, Array, Array, Array]:
    """The whole state after a step: transition and propagate.

    Args:
        posture: (3,) before the step.
        rays: (n, 3) before the step.
        covariance: P of both.
        at: (u1 m, u2 rad) where the step is linearised.
        measured: (u1 m, u2 rad) as the wheels tell it.
        mount_forward: of the optical centre ahead of the axle, m.
        wheel_root: (2, 2) root of the covariance of (u1, u2).
        side_slip: sigma of u3, m.
        posture_variances: (3,) the diagonal of Q.

    Returns:
        Posture and rays after the step; (3 + 3n, 3) Jacobian of both by (u1, u2, u3); P after it.
    """
    moved, after, _, blocks, by_input = transition(posture, rays, at, measured, mount_forward)
    predicted = propagate(covariance, blocks, by_input, wheel_root, side_slip, posture_variances)
    return moved, after, by_input, predicted


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

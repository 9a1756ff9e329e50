"""The five laws of the switching servo: equations (4) and (5) of the paper, repaired.

Each law is the same feedback in another chart of the circle: chart 1 drives forward to the goal from behind,
charts 2 to 5 drive backward to it from ahead, around either side and turning either way. All five have their
equilibrium at the goal pose. In its own chart every law closes the same loop,

    rho' = -rho cos^2(b),   phi~' = sin(2 b) / 2,   b' = -lambda b - sinc(2 b) phi~      (b = beta~)

whose two angles know nothing of rho: `rollout.py` lives on that.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Array

BETA_SHIFT: Array = np.array([0.0, -1.0, -1.0, 1.0, 1.0]) * math.pi
"""(5,) rad, beta~_i = beta + BETA_SHIFT[i]."""

PHI_SHIFT: Array = np.array([-1.0, -2.0, 0.0, -2.0, 0.0]) * math.pi
"""(5,) rad, phi~_i = phi + PHI_SHIFT[i]."""

LAWS = len(BETA_SHIFT)


def charts(phi: Any, beta: Any) -> tuple[Array, Array]:
    """Return (phi~, beta~), each (..., 5) rad, of phi and beta (...)."""
    phi, beta = np.asarray(phi, dtype=np.float64), np.asarray(beta, dtype=np.float64)
    return phi[..., None] + PHI_SHIFT, beta[..., None] + BETA_SHIFT


def lyapunov(rho: Any, phi: Any, beta: Any) -> Array:
    """(..., 5) V_i = (rho^2 + phi~_i^2 + beta~_i^2) / 2, equation (4)."""
    phi_tilde, beta_tilde = charts(phi, beta)
    rho = np.asarray(rho, dtype=np.float64)[..., None]
    value: Array = 0.5 * (rho**2 + phi_tilde**2 + beta_tilde**2)
    return value


def control(phi: Any, beta: Any, lambda_: float) -> tuple[Array, Array]:
    """Equation (5): u and omega of the five laws.

    sin(beta) cos(beta) / beta~ is written as sinc(2 beta~), which has no hole at beta~ = 0.

    Args:
        phi: (...) rad.
        beta: (...) rad.
        lambda_: gain; 2 is critically damped at the goal, 1 rings.

    Returns:
        u: (...) 1/s, forward speed divided by rho; the same for all laws.
        omega: (..., 5) rad/s.
    """
    phi_tilde, beta_tilde = charts(phi, beta)
    u: Array = np.cos(np.asarray(beta, dtype=np.float64))
    omega = lambda_ * beta_tilde + np.sinc(2.0 * beta_tilde / math.pi) * (phi_tilde + beta_tilde)
    return u, omega


def saturate(forward: float, turn: float, max_forward: float, max_turn: float) -> tuple[float, float]:
    """Slow both speeds by one factor until both limits hold: the curvature, so the path, stays.

    Args:
        forward: m/s.
        turn: rad/s.
        max_forward: limit, m/s, positive.
        max_turn: limit, rad/s, positive.
    """
    excess = max(abs(forward) / max_forward, abs(turn) / max_turn, 1.0)
    return forward / excess, turn / excess


def law_paths(laws: NDArray[np.intp], rho: Array, phi_tilde: Array, beta_tilde: Array) -> Array:
    """Poses of chart coordinates.

    Args:
        laws: (L,) law of each path, 0 to 4.
        rho: (T, L) m.
        phi_tilde: (T, L) rad.
        beta_tilde: (T, L) rad.

    Returns:
        (L, T, 3) x m, y m, heading rad, in goal.
    """
    phi = phi_tilde - PHI_SHIFT[laws]
    heading = math.pi + phi - (beta_tilde - BETA_SHIFT[laws])
    return np.stack([rho * np.cos(phi), rho * np.sin(phi), heading], axis=-1).transpose(1, 0, 2)

"""The five laws rolled forward to the goal at once, before one of them is trusted with the wheels."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.servo.laws import LAWS, charts, law_paths
from mapweave.agent.servo.polar import Polar
from mapweave.hybridmap.pose import Array

_STEPS: Array = np.concatenate([np.full(24, 0.06), np.full(24, 0.25)])
"""(T-1,) s of the unsaturated laws; saturation changes the time, not the path. rho falls by up to e^-7.4."""


@dataclass(frozen=True, eq=False)
class Rollouts:
    """Where the five laws would lead.

    Attributes:
        poses: (5, T, 3) x m, y m, heading rad (unwrapped), in goal; constant after a path has parked.
        parked: (5,) whether the path ends in the dead zone.
        lengths: (5,) m driven.
        turns: (5,) rad turned in all, with the last turn on the spot to heading 0.
    """

    poses: Array
    parked: NDArray[np.bool_]
    lengths: Array
    turns: Array


def roll_out(polar: Polar, lambda_: float, dead_zone: float) -> Rollouts:
    """Integrate all five laws from a pose until the dead zone.

    phi~ and beta~ of every law follow one autonomous system (see laws.py), integrated by the midpoint rule;
    rho is the exponential of the integral of -cos^2(beta~).

    Args:
        polar: where the robot is.
        lambda_: gain of the laws.
        dead_zone: m, where a path has parked.
    """
    count = len(_STEPS) + 1
    phis, betas, middles = np.empty((count, LAWS)), np.empty((count, LAWS)), np.empty((count - 1, LAWS))
    phis[0], betas[0] = charts(polar.phi, polar.beta)
    for k, dt in enumerate(_STEPS.tolist()):
        phi, beta = phis[k], betas[k]
        phi_rate, beta_rate = _rates(phi, beta, lambda_)
        middles[k] = middle = beta + (0.5 * dt) * beta_rate
        phi_rate, beta_rate = _rates(phi + (0.5 * dt) * phi_rate, middle, lambda_)
        phis[k + 1] = phi + dt * phi_rate
        betas[k + 1] = beta + dt * beta_rate
    decay = np.zeros((count, LAWS))
    np.cumsum(-_STEPS[:, None] * np.cos(middles) ** 2, axis=0, out=decay[1:])
    rho = polar.rho * np.exp(decay)
    inside = rho <= dead_zone
    parked = inside[-1]
    last = np.where(parked, inside.argmax(axis=0), count - 1)
    after = np.arange(count)[:, None] > last
    columns = np.arange(LAWS)
    for values in (rho, phis, betas):
        np.copyto(values, values[last, columns], where=after)
    poses = law_paths(columns, rho, phis, betas)
    steps = np.diff(poses, axis=1)
    lengths = np.hypot(steps[..., 0], steps[..., 1]).sum(axis=1)
    final = np.mod(poses[:, -1, 2] + math.pi, 2.0 * math.pi) - math.pi
    turns = np.abs(steps[..., 2]).sum(axis=1) + np.abs(final)
    return Rollouts(poses, parked, lengths, turns)


def _rates(phi: Array, beta: Array, lambda_: float) -> tuple[Array, Array]:
    """phi~' and beta~' of every law in its own chart."""
    beta = beta + 1e-9 * (beta == 0.0)
    half_sine = 0.5 * np.sin(2.0 * beta)
    return half_sine, -lambda_ * beta - half_sine / beta * phi

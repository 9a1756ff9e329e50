"""What is known of the parameters beforehand, what of them matters, and how well they can be estimated."""

import math

import numpy as np

from mapweave.agent.drive_geometry import Parameter
from mapweave.hybridmap.pose import Array

P = Parameter
PRIOR_SIGMAS = {
    P.WHEEL_SCALE: 0.15, P.TURN_SCALE: 0.15, P.DRIFT: 0.05, P.FORWARD: 1.5, P.LEFT: 0.5, P.HEADING: 0.15,
    P.PITCH: 0.15, P.ROLL: 0.05, P.HEIGHT: 0.01, P.DELAY: 0.15,
}  # fmt: skip
"""How far a declared value may be off before anything is seen. Floor and wheels show the height only as a
multiple of the way: the height, which a tape measures to a percent, is held; the wheels' scale follows."""
USEFUL_SIGMAS = {
    P.WHEEL_SCALE: 0.02, P.TURN_SCALE: 0.02, P.DRIFT: 0.005, P.FORWARD: 0.1, P.LEFT: 0.1, P.HEADING: 0.01,
    P.PITCH: 0.01, P.ROLL: 0.01, P.HEIGHT: 0.02, P.DELAY: 0.02,
}  # fmt: skip
"""A drive shows a parameter if its sigma is below this: smaller errors do not show in a map. How far the
camera stands off counts as a share of its height: 16 cm on a car, 3 cm on a robot with a mast of 30 cm."""
MODEL_SIGMAS = np.array([0.005, 0.005, 0.001, 0.01, 0.015, 0.002, 0.001, 0.001, 0.002, 0.005])
"""Errors of the estimator itself, in the order of `Parameter`: depths are not Gaussian, pairs short. Measured
on drives through simulated buildings, that of the delay on a street; no sigma is smaller."""


def useful(declared: Array) -> Array:
    """(10,) sigmas below which a drive shows a parameter, for a declared geometry."""
    sigmas = np.array([USEFUL_SIGMAS[p] for p in P])
    sigmas[[P.FORWARD, P.LEFT]] *= math.exp(declared[P.HEIGHT])
    return sigmas

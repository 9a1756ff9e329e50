"""How far the footprint may move, by the present ranger readings."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.observation import RobotDescription

ASIDE = 0.06
"""m, kept free to the sides of the footprint."""
BEFORE = 0.12
"""m, kept free ahead of it."""

TIGHT = 0.14
"""Something nearer than this counts as what is in the way, m."""


def obstacle_words(description: RobotDescription, proximity: NDArray[Any]) -> str:
    """What is next to the robot, in words; empty if nothing is near.

    Args:
        description: footprint and rangers.
        proximity: (K,) m from the robot's edge.
    """
    bearings = description.ranger_bearings
    if len(proximity) == len(bearings) and len(bearings):
        nearest = int(np.argmin(proximity))
        if proximity[nearest] < TIGHT:
            side = math.degrees(math.remainder(bearings[nearest], math.tau))
            return f"something is {proximity[nearest]:.2f} m off, at {side:.0f} degrees to the left"
    return ""


def clearance(
    description: RobotDescription, proximity: NDArray[Any], direction: float, unknown: float = math.inf
) -> float:
    """How far the footprint may move in a direction, m.

    Args:
        description: footprint and rangers.
        proximity: (K,) m from the robot's edge.
        direction: rad, 0 ahead, positive to the left.
        unknown: returned if no ranger looks that way, or if nothing is within the reach of short rangers.
    """
    bearings, radius = np.array(description.ranger_bearings), description.radius
    if not len(bearings) or len(proximity) != len(bearings):
        return unknown
    off = np.angle(np.exp(1j * (bearings - direction)))
    reach = proximity + radius
    lateral = np.abs(reach * np.sin(off))
    in_way = (np.cos(off) > 0.3) & (lateral < radius + ASIDE)
    if not in_way.any():
        return unknown
    free = np.maximum((reach * np.cos(off))[in_way] - radius - BEFORE, 0.0)
    nothing = proximity[in_way] >= description.ranger_reach - 1e-6
    return float(np.where(nothing, np.maximum(free, unknown), free).min())

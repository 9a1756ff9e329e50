"""Finding a plan: two legs in closed form first, the lattice for what they cannot do; wide margins first."""

from __future__ import annotations

import math

import numpy as np

from agent.servo.lattice import lattice
from agent.servo.plan import Plan, Surroundings
from agent.servo.settings import ServoSettings
from agent.servo.zigzag import zigzag
from hybridmap.pose import Pose2

_DETOUR = 1.6
"""A two-leg way longer than this many times the distance is worth a search for a better one,"""

_DETOUR_M = 0.6
"""if it is also this much longer, m."""


def find_plan(around: Surroundings, start: Pose2, settings: ServoSettings) -> Plan | None:
    """A plan from a posture to the goal, with as wide a margin as there is one for.

    Args:
        around: constraints.
        start: posture in goal.
        settings: margins and price.

    Returns:
        The plan, or None if none was found.
    """
    distance = math.hypot(start.x, start.y)
    for margin in settings.margins():
        turned = turned_inside(around, start, margin)
        if turned is None:
            continue
        plan = zigzag(around, turned, margin, settings.price)
        if plan is None or plan.length > _DETOUR * distance + _DETOUR_M:
            other = lattice(around, turned, margin, settings.price)
            if plan is None or (other is not None and other.cost < plan.cost):
                plan = other
        if plan is not None:
            return plan
    turned = turned_inside(around, start, settings.least_margin)
    if turned is None:
        return None
    return lattice(around, turned, settings.least_margin, settings.price, cell=0.06, room=1.5)


def turned_inside(around: Surroundings, start: Pose2, margin: float) -> Pose2 | None:
    """The start, turned by as little as brings it inside a margin; None if no small turn does."""
    offsets = np.linspace(-0.6, 0.6, 49)
    offsets = offsets[np.argsort(np.abs(offsets), kind="stable")]
    postures = np.column_stack(
        [np.full(len(offsets), start.x), np.full(len(offsets), start.y), start.heading + offsets]
    )
    fine = np.flatnonzero(around.field.slack(postures) >= margin)
    if not len(fine):
        return None
    return Pose2(start.x, start.y, float(postures[fine[0], 2]))

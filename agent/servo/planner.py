"""Finding a plan: two legs in closed form first, the lattice for what they cannot do; wide margins first."""

from __future__ import annotations

import math

import numpy as np

from mapweave.agent.servo.lattice_planner import lattice_plan
from mapweave.agent.servo.margins import MARGINS
from mapweave.agent.servo.plan import ServoPlan, Surroundings
from mapweave.agent.servo.two_leg_planner import two_leg_plan
from mapweave.hybridmap.pose import Pose2

_DETOUR = 1.6
"""A two-leg way longer than this many times the distance is worth a search for a better one,"""

_DETOUR_M = 0.6
"""if it is also this much longer, m."""


def quick_plan(around: Surroundings, start: Pose2) -> ServoPlan | None:
    """A plan of two legs with as wide a margin as there is one for: milliseconds.

    Args:
        around: constraints.
        start: pose in goal.

    Returns:
        The plan, or None if two legs will not do.
    """
    for margin in MARGINS:
        turned = turned_inside(around, start, margin)
        plan = two_leg_plan(around, turned, margin) if turned is not None else None
        if plan is not None:
            return plan
    return None


def needs_thought(plan: ServoPlan | None) -> bool:
    """Whether a quick plan is so long, or missing, that the thorough search is worth its time."""
    return plan is None or plan.length > _DETOUR * math.hypot(plan.start.x, plan.start.y) + _DETOUR_M


def thorough_plan(around: Surroundings, start: Pose2) -> ServoPlan | None:
    """The cheapest plan that two legs or the lattice know: tens to hundreds of milliseconds.

    Args:
        around: constraints.
        start: pose in goal.

    Returns:
        The plan, or None if none was found.
    """
    quick = quick_plan(around, start)
    _, middle, _, least = MARGINS
    for margin, cell, room in ((middle, 0.1, 1.2), (least, 0.1, 1.2), (least, 0.06, 1.5)):
        if quick is not None and margin < quick.margin:
            break
        turned = turned_inside(around, start, margin)
        plan = lattice_plan(around, turned, margin, cell, room) if turned is not None else None
        if plan is not None:
            return plan if quick is None or plan.cost < quick.cost else quick
    return quick


def turned_inside(around: Surroundings, start: Pose2, margin: float) -> Pose2 | None:
    """The start, turned by as little as brings it inside a margin; None if no small turn does."""
    offsets = np.linspace(-0.6, 0.6, 49)
    offsets = offsets[np.argsort(np.abs(offsets), kind="stable")]
    poses = np.column_stack(
        [np.full(len(offsets), start.x), np.full(len(offsets), start.y), start.heading + offsets]
    )
    fine = np.flatnonzero(around.field.slack(poses) >= margin)
    if not len(fine):
        return None
    return Pose2(start.x, start.y, float(poses[fine[0], 2]))

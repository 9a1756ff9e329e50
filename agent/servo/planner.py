"""Finding a plan: two legs in closed form, with a wide margin if there is one."""

import math

import numpy as np

from mapweave.agent.servo.margins import MARGINS
from mapweave.agent.servo.plan import LEG_PRICE, TURN_PRICE, Leg, ServoPlan, Surroundings, sample
from mapweave.hybridmap.pose import Array, Pose2

_SPACING = 0.06
"""rad between candidate headings."""

_REACH = 1.5
"""rad to either side in which headings are searched."""
_LONGEST = 4.0
"""Longest leg, m."""

_ALONG: Array = np.linspace(0.0, 1.0, 9)[1:]
"""Shares of a leg at which it is tested."""


def headings_around(surroundings: Surroundings, pose: Pose2, margin: float) -> Array:
    """(H,) headings that a turn on the spot reaches without leaving the field of view, ascending."""
    offsets = _SPACING * np.arange(-int(_REACH / _SPACING), int(_REACH / _SPACING) + 1)
    poses = np.column_stack(
        [np.full(len(offsets), pose.x), np.full(len(offsets), pose.y), pose.heading + offsets]
    )
    fine = surroundings.field.slack(poses) >= margin
    middle = len(offsets) // 2
    low = high = middle
    while low > 0 and fine[low - 1]:
        low -= 1
    while high < len(offsets) - 1 and fine[high + 1]:
        high += 1
    return poses[low : high + 1, 2]


def two_leg_plan(surroundings: Surroundings, start: Pose2, margin: float) -> ServoPlan | None:
    """The cheapest admissible plan of at most two legs.

    For headings h1 and h2 the lengths follow from d1 e(h1) + d2 e(h2) = -start; a negative one is driven
    backward. Pairs are tried in the order of their cost until one keeps the constraints.

    Args:
        surroundings: constraints.
        start: pose in goal.
        margin: slack to keep, rad.

    Returns:
        The plan, or None if no pair of headings will do.
    """
    if not surroundings.allowed(np.array([start.vector, [0.0, 0.0, 0.0]]), margin).all():
        return None
    first = headings_around(surroundings, start, margin)
    second = headings_around(surroundings, Pose2(), margin)
    direct = _direct_headings(start)
    first = np.concatenate([first, direct[(direct > first[0]) & (direct < first[-1])]])
    second = np.concatenate([second, direct[(direct > second[0]) & (direct < second[-1])]])
    h1, h2 = (h.ravel() for h in np.meshgrid(first, second, indexing="ij"))
    d1, d2 = _lengths(start, h1, h2)
    cost = np.abs(d1) + np.abs(d2)
    cost += TURN_PRICE * (np.abs(h1 - start.heading) + np.abs(h2 - h1) + np.abs(h2))
    cost += LEG_PRICE * ((np.abs(d1) > 1e-6).astype(float) + (np.abs(d2) > 1e-6))
    usable = np.isfinite(cost) & (np.maximum(np.abs(d1), np.abs(d2)) <= _LONGEST)
    order = np.flatnonzero(usable)[np.argsort(cost[usable], kind="stable")]
    done, size = 0, 24
    while done < len(order):
        batch = order[done : done + size]
        poses = _samples(start, h1[batch], d1[batch], h2[batch])
        for index in batch[surroundings.allowed(poses, margin).all(axis=1)]:
            legs = _legs(start, h1[index], d1[index], h2[index], d2[index])
            if surroundings.allowed(sample(start, legs), margin).all():
                return ServoPlan(start, legs, float(cost[index]), margin)
        done, size = done + size, min(4 * size, 400)
    return None


def _direct_headings(start: Pose2) -> Array:
    """Headings of a single leg to the goal, on the branches around 0."""
    toward = math.atan2(-start.y, -start.x)
    return np.array([toward - 2 * math.pi, toward - math.pi, toward, toward + math.pi, toward + 2 * math.pi])


def _lengths(start: Pose2, h1: Array, h2: Array) -> tuple[Array, Array]:
    """Signed lengths; infinite for (nearly) parallel headings."""
    det = np.sin(h2 - h1)
    safe = np.where(np.abs(det) > 0.02, det, np.nan)
    d1 = (-start.x * np.sin(h2) + start.y * np.cos(h2)) / safe
    d2 = (start.x * np.sin(h1) - start.y * np.cos(h1)) / safe
    return np.where(np.abs(d1) < 1e-9, 0.0, d1), np.where(np.abs(d2) < 1e-9, 0.0, d2)


def _samples(start: Pose2, h1: Array, d1: Array, h2: Array) -> Array:
    """(B, M, 3) coarse poses along both legs and the turn between them."""
    mx, my = start.x + d1 * np.cos(h1), start.y + d1 * np.sin(h1)
    s = _ALONG

    def blend(a: Array | float, b: Array | float) -> Array:
        a, b = np.broadcast_to(a, mx.shape), np.broadcast_to(b, mx.shape)
        return a[:, None] + s * (b - a)[:, None]

    out = np.stack([blend(start.x, mx), blend(start.y, my), blend(h1, h1)], axis=-1)
    turn = np.stack([blend(mx, mx), blend(my, my), blend(h1, h2)], axis=-1)
    back = np.stack([blend(mx, 0.0), blend(my, 0.0), blend(h2, h2)], axis=-1)
    return np.concatenate([out, turn, back], axis=1)


def _legs(start: Pose2, h1: float, d1: float, h2: float, d2: float) -> tuple[Leg, ...]:
    mx, my = start.x + d1 * math.cos(h1), start.y + d1 * math.sin(h1)
    legs = (
        Leg(float(h1), math.copysign(1.0, d1), float(mx), float(my), float(abs(d1))),
        Leg(float(h2), math.copysign(1.0, d2), 0.0, 0.0, float(abs(d2))),
    )
    return tuple(leg for leg in legs if leg.length > 1e-6)


def find_plan(around: Surroundings, start: Pose2) -> ServoPlan | None:
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

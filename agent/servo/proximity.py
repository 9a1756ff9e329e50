"""The last safety layer: no command moves the footprint into something that the rangers see."""

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.observation import Command, RobotDescription
from mapweave.hybridmap.pose import Array

_MARGIN = 0.045
"""m, room that is kept between the footprint and what the rangers see."""

_DECELERATION = 1.0
"""m/s^2, counted on for the stopping distance."""

_SHARES: Array = np.linspace(1.0, 0.0, 11)[:-1]
"""Shares of a command's speed that are tried, the full one first."""

_BETWEEN: Array = np.array([0.25, 0.5, 0.75])[:, None, None]
"""Shares of the way from one hit to the next, where points are added."""


class Guarded(NamedTuple):
    """A command that is safe, and why it is not the one asked for ("" if it is)."""

    command: Command
    reason: str


def ranger_points(proximity: NDArray[Any], description: RobotDescription) -> Array:
    """Points that the rangers hit, with points between neighbouring hits that belong together.

    Args:
        proximity: (K,) m from the robot's edge; readings at the rangers' reach hit nothing.
        description: directions and reach of the rangers, radius of the footprint.

    Returns:
        (M, 2) m, in robot.
    """
    distances = np.asarray(proximity, dtype=np.float64)
    directions, order, following = _directions(tuple(description.ranger_bearings), len(distances))
    distances = distances[: len(directions)]
    hit = np.isfinite(distances) & (distances < description.ranger_reach - 1e-6)
    points = (description.radius + np.maximum(distances, 0.0))[:, None] * directions
    first, second = points[order], points[following]
    across, along = (first - second).T
    between = hit[order] & hit[following] & (np.sqrt(across**2 + along**2) < 2.0 * description.radius)
    first, second = first[between], second[between]
    filled = first + _BETWEEN * (second - first)
    return np.concatenate([points[hit], filled.reshape(-1, 2)])


@lru_cache(maxsize=16)
def _directions(
    bearings: tuple[float, ...], readings: int
) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
    """Directions of K rangers: (K, 2) unit vectors, (K,) their order around the robot, (K,) the next."""
    angles = np.asarray(bearings[:readings], dtype=np.float64)
    order = np.argsort(angles, kind="stable")
    return np.stack([np.cos(angles), np.sin(angles)], axis=-1), order, np.roll(order, -1)


def guard(command: Command, proximity: NDArray[Any], description: RobotDescription) -> Guarded:
    """The command, or as much of it as cannot touch what the rangers see before the robot could stop.

    The round footprint is swept along the arc of the command for two ticks and the stopping distance, and as
    far again: it may be another robot that comes the other way and brakes no sooner. A turn on the spot
    moves no round footprint and always passes; so does a motion that leads away from a point which is too
    near already.

    Args:
        command: wanted.
        proximity: (K,) m from the robot's edge, one for each of the description's ranger bearings.
        description: footprint, rangers and tick.
    """
    if abs(command.forward) < 1e-6:
        return Guarded(command, "")
    points = ranger_points(proximity, description)
    if not len(points):
        return Guarded(command, "")
    for share in _SHARES.tolist():
        slowed = Command(command.forward * share, command.turn * share)
        if _free(slowed, points, description):
            if share == 1.0:
                return Guarded(command, "")
            return Guarded(slowed, "slowed: an obstacle is near")
    where = "ahead" if command.forward > 0 else "behind"
    return Guarded(Command(0.0, command.turn), f"stopped: an obstacle is {where}")


def _free(command: Command, points: Array, description: RobotDescription) -> bool:
    """Whether the arc of a command, with its stopping distance, stays clear of the points."""
    speed = abs(command.forward)
    way = 2.0 * (2.0 * speed * description.tick + speed * speed / (2.0 * _DECELERATION))
    s = np.linspace(0.0, way, 2 + math.ceil(way / 0.02))[1:]
    turn = command.turn / speed * s
    chord = math.copysign(1.0, command.forward) * s * np.sinc(0.5 * turn / math.pi)
    x, y = chord * np.cos(0.5 * turn), chord * np.sin(0.5 * turn)
    distance = np.hypot(x[:, None] - points[:, 0], y[:, None] - points[:, 1])
    now = np.hypot(points[:, 0], points[:, 1])
    needed = np.minimum(description.radius + _MARGIN, now)
    return bool((distance >= needed - 1e-9).all())

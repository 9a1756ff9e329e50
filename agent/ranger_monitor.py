"""Whether the proximity sensors that a robot promises are read: without them free room is unknown."""

from __future__ import annotations

import numpy as np

from mapweave.agent.cautious_driving import ALONG_EDGES, CREEP, SLOW, lacks_rangers
from mapweave.agent.observation import RobotDescription
from mapweave.hybridmap.pose import Array


def not_exploring(name: str) -> str:
    """Why an agent without proximity sensors does not explore, and what to do."""
    return (
        f"without proximity sensors it does not explore by itself: drive it with `mapweave drive {name}`, "
        "or allow it with --without-rangers"
    )


def announcement(description: RobotDescription, name: str, explores: bool) -> list[str]:
    """What a robot without proximity sensors will not do, one line each; nothing for one that has some.

    Args:
        description: of the robot.
        name: of its agent.
        explores: whether a person allows it to explore by its camera alone.
    """
    if not lacks_rangers(description):
        return []
    return [
        "no proximity sensors: it does not stop before obstacles; a touch (bumper, wheels) stops it",
        f"it explores at {CREEP:g} to {SLOW:g} m/s by its camera; expect it to touch things"
        if explores
        else not_exploring(name),
        f"to a goal it drives at {ALONG_EDGES:g} m/s, only along edges of the map that a robot has driven",
    ]


class RangerMonitor:
    """Compares each tick's readings with the description.

    A robot that promises no rangers drives without them, by the choice of who described it. One that
    promises some and sends none, or another number, has a broken sensor or driver: its readings belong to
    no known bearing, and everywhere counts as free.
    """

    def __init__(self, description: RobotDescription) -> None:
        """Nothing is read yet, and nothing is missing."""
        self._promised = len(description.ranger_bearings)
        self._tick = description.tick
        self._read = self._promised
        self._missing_ticks = 0

    def see(self, proximity: Array) -> None:
        """Take one tick's readings, m; those that are not finite or negative are none."""
        good = int((np.isfinite(proximity) & (proximity >= 0.0)).sum())
        self._read = good if len(proximity) == self._promised else len(proximity)
        self._missing_ticks = 0 if good == len(proximity) == self._promised else self._missing_ticks + 1

    @property
    def fault(self) -> str:
        """What is missing now, in words; empty if every promised sensor was read in this tick."""
        if not self._missing_ticks:
            return ""
        sensors = "proximity sensor" if self._promised == 1 else "proximity sensors"
        seconds = self._missing_ticks * self._tick
        return (
            f"{self._promised} {sensors} promised, {self._read or 'none'} read for {seconds:.1f} s: standing"
        )

"""Whether promised proximity sensors are read, and live: without them free room is unknown."""

import math

import numpy as np

from mapweave.agent.cautious_driving import ALONG_EDGES, CREEP, SLOW, lacks_rangers
from mapweave.agent.observation import Odometry, RobotDescription
from mapweave.hybridmap.pose import Array, Pose2

TOWARD = math.radians(45.0)
"""A reading within this of the direction of the drive gets shorter or longer on the way,"""
WAY = 0.2
"""after this much of it, m, by several steps of any sensor. What is nearer than that, the guard has stopped
the drive for."""
TURN = 0.5
"""After this turn, rad, no reading that hits anything is what it was."""


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
    no known bearing, and everywhere counts as free. Readings that stay the same to the last bit while the
    robot moves toward or past what they hit are old. Where all are at their maximum that does not show.

    Attributes:
        frozen: whether the readings are old.
    """

    def __init__(self, description: RobotDescription) -> None:
        """Nothing is read yet, and nothing is missing."""
        self._promised = len(description.ranger_bearings)
        self._tick = description.tick
        self._read = self._promised
        self._missing_ticks = 0
        self._bearings = np.array(description.ranger_bearings)
        self._reach = description.ranger_reach
        self.frozen = False
        self._last: Array = np.zeros(0)
        self._moved = Pose2()

    def see(self, proximity: Array, odometry: Odometry) -> None:
        """Take one tick's readings, m; those that are not finite or negative are none."""
        self._compare(proximity, odometry)
        good = int((np.isfinite(proximity) & (proximity >= 0.0)).sum())
        self._read = good if len(proximity) == self._promised else len(proximity)
        self._missing_ticks = 0 if good == len(proximity) == self._promised else self._missing_ticks + 1

    def _compare(self, proximity: Array, odometry: Odometry) -> None:
        self._moved = self._moved @ odometry.motion()
        if len(proximity) != self._promised or not np.array_equal(proximity, self._last):
            self._last, self._moved, self.frozen = proximity, Pose2(), False
            return
        hits = proximity < self._reach - 1e-6
        way, turn = math.hypot(self._moved.x, self._moved.y), abs(self._moved.heading)
        aside = self._bearings - (0.0 if self._moved.x >= 0.0 else math.pi)
        toward = hits & (np.cos(aside) >= math.cos(TOWARD))
        self.frozen = self.frozen or bool(hits.any() and turn > TURN) or bool(toward.any() and way > WAY)

    @property
    def fault(self) -> str:
        """What is wrong now, in words; empty if every promised sensor was read in this tick, and lives."""
        if self.frozen:
            return "the proximity sensors read the same again and again while the wheels move: frozen"
        if not self._missing_ticks:
            return ""
        sensors = "proximity sensor" if self._promised == 1 else "proximity sensors"
        seconds = self._missing_ticks * self._tick
        return (
            f"{self._promised} {sensors} promised, {self._read or 'none'} read for {seconds:.1f} s: standing"
        )

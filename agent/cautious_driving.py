"""Driving without proximity sensors: slowly, and back from where something was touched."""

import math

import numpy as np

from mapweave.agent.observation import Command, Observation, RobotDescription
from mapweave.hybridmap.pose import Pose2

CREEP = 0.05
"""Speed where the floor ahead is unknown, m/s: a touch at this speed displaces nothing."""
SLOW = 0.15
"""Largest speed over floor that is known to be free, m/s: it stops within a tick's way and 1 cm."""
ALONG_EDGES = 0.1
"""Largest speed along edges of the map, m/s: what stands there now, no sensor sees."""
BACK_OFF = 0.1
"""How far it drives back from a touch, m."""
WATCHED = 10
"""Ticks over which commands, wheels and images are compared."""
LEAST_WAY = 0.03
"""Commanded, or driven by the wheels, in these ticks before they say anything, m."""
MOVED = 0.3
"""With less of the way than this share the wheels stall, or turn on the spot."""


def lacks_rangers(description: RobotDescription) -> bool:
    """Whether a robot that drives has no proximity sensors."""
    return not description.ranger_bearings and description.max_forward > 0.0


class CautiousDriving:
    """Limits commands, recognises touches (bumper, wheels that stall or slip) and backs off from them.

    Attributes:
        touched: what was touched in this tick, in words; empty without a new touch.
    """

    def __init__(self, description: RobotDescription) -> None:
        """Nothing was touched yet."""
        self.touched = ""
        self._tick = description.tick
        self._direction = 1.0
        self._commanded = 0.0
        self._watched: list[tuple[float, float, Pose2 | None]] = []
        self._back = 0.0
        self._patience = 0

    @property
    def backing_off(self) -> bool:
        """Whether it drives back from a touch."""
        return self._patience > 0

    @property
    def heading(self) -> float:
        """Direction in robot in which it drives, or drove last, rad: 0 ahead, pi behind."""
        return 0.0 if self._direction > 0.0 else math.pi

    def see(self, observation: Observation, map_from_robot: Pose2 | None) -> None:
        """Begin a tick: compare what was commanded with what came of it.

        Args:
            observation: now.
            map_from_robot: pose by wheels and images, by the wheels alone where no image tells more; None if
                it is not known.
        """
        self.touched = ""
        wheels = observation.odometry.forward
        if self.backing_off:
            self._patience -= 1
            self._back += abs(wheels)
            if self._back >= BACK_OFF:
                self._patience = 0
            return
        if self._commanded * self._direction < 0.0 or not self._commanded:
            self._watched = []
        if self._commanded:
            self._direction = math.copysign(1.0, self._commanded)
            self._watched = [*self._watched[-WATCHED:], (self._commanded, wheels, map_from_robot)]
        if observation.bumped and self._commanded:
            self.touched = "the bumper is pressed"
        elif len(self._watched) > WATCHED:
            self.touched = self._stalled()
        if self.touched:
            self._watched, self._back = [], 0.0
            self._patience = math.ceil(2.0 * BACK_OFF / CREEP / self._tick)

    def _stalled(self) -> str:
        """What does not follow the command over the last ticks, in words; empty if all does."""
        wanted = abs(sum(commanded for commanded, _, _ in self._watched[1:])) * self._tick
        driven = abs(sum(wheels for _, wheels, _ in self._watched[1:]))
        if wanted >= LEAST_WAY and driven < MOVED * wanted:
            return "the wheels stall"
        first, last = self._watched[0][2], self._watched[-1][2]
        if first is None or last is None:
            return ""
        if driven >= LEAST_WAY and first.distance(last) < MOVED * driven:
            return "the wheels turn and the image stands"
        return ""

    def command(self, wanted: Command, most: float, follow: bool = False) -> Command:
        """The command for the wheels: away from a touch, or what is wanted, no faster than a speed.

        Args:
            wanted: by the behaviour, or by a person.
            most: m/s; the curvature stays.
            follow: whether a person drives, who backs off by himself.
        """
        if follow:
            self._patience = 0
        if self.backing_off:
            safe = Command(-self._direction * CREEP, 0.0)
        else:
            share = min(1.0, most / max(abs(wanted.forward), 1e-9))
            safe = Command(wanted.forward * share, wanted.turn * share) if share < 1.0 else wanted
        self._commanded = safe.forward
        return safe


def speed_for(known: float) -> float:
    """Largest speed, m/s, with so much known free floor ahead (m): it comes to the border at a creep."""
    return float(np.clip(known / 1.0, CREEP, SLOW))

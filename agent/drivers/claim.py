"""One agent a robot: another of the same name is refused before it moves anything."""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable

from mapweave.hybridmap.errors import DeviceError
from mapweave.wire.bus import Bus
from mapweave.wire.keys import Keys

LEAVING = 4.0
"""s; an agent that was killed or lost its power is gone from the network by then (the bus waits 2.5 s)."""
SETTLING = 0.5
"""s; news of an agent that starts at the same time takes no longer."""


class Claim:
    """The right to drive a robot, held until closed or dead.

    Attributes:
        number: drawn at random; under it the agent is seen.
    """

    def __init__(self, bus: Bus, keys: Keys, robot: str, leaving: float = LEAVING) -> None:
        """Take it.

        An agent looks first and then announces itself. Two that do so at the same time see each other when
        they look again; the one with the greater number gives way. Without a router nobody is seen: a port
        can be opened by one process alone, and a body on the network cannot be reached either.

        Args:
            bus: of the body; connected, if it can be.
            keys: of the fleet.
            robot: its name.
            leaving: how long to wait for an agent that is seen and may be dead, s.

        Raises:
            DeviceError: another agent drives the robot.
        """
        self.number = secrets.randbits(52)
        self._others: set[int] = set()
        self._changed = threading.Condition()
        self._keys = keys
        self._robot = robot
        self._watch = bus.watch(keys.robot_drivers_of(robot), self._presence)
        try:
            if not self._wait(lambda: not self._others, leaving):
                raise self._refusal()
            self._alive = bus.announce(keys.robot_driver(robot, self.number))
        except BaseException:
            self._watch.close()
            raise
        if not self._wait(lambda: all(self.number < other for other in self._others), 0.0):
            self.close()
            raise self._refusal()

    def close(self) -> None:
        """Give it back. Twice is no error."""
        self._alive.close()
        self._watch.close()

    def _presence(self, key: str, alive: bool) -> None:
        _, number = self._keys.parse_robot_driver(key)
        if number == self.number:
            return
        with self._changed:
            (self._others.add if alive else self._others.discard)(number)
            self._changed.notify_all()

    def _wait(self, free: Callable[[], bool], patience: float) -> bool:
        """Whether the robot is free, once news has had time to come, or within the patience after that."""
        time.sleep(SETTLING)
        with self._changed:
            return self._changed.wait_for(free, patience)

    def _refusal(self) -> DeviceError:
        return DeviceError(f"another agent drives {self._robot}; stop it, or give this robot another name")

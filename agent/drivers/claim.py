"""One agent per robot: a second agent of the same name, or at the same topic, moves nothing."""

import secrets
import threading
import time
from collections.abc import Callable
from typing import Protocol

from mapweave.hybridmap.errors import DeviceError
from mapweave.wire.bus import Bus
from mapweave.wire.bus_settings import AGENT_LEASE

LEAVING = 4.0
"""s; an agent whose process has ended has left the network by then. One that hangs, or has lost the network,
leaves after `AGENT_LEASE`."""
SETTLING = 0.5
"""s; liveliness of an agent that starts at the same time arrives within this time."""


class ClaimKeys(Protocol):
    """Keys of those who drive a robot: those of a fleet, or `mapweave.wire.ros2.keys.CommandKeys`."""

    def robot_drivers_of(self, robot: str) -> str:
        """Pattern: all who drive the robot."""

    def robot_driver(self, robot: str, number: int) -> str:
        """Liveliness of the one with this number."""

    def parse_robot_driver(self, key: str) -> tuple[str, int]:
        """Which robot, and the number of who drives it."""


class Claim:
    """Exclusive right to drive a robot, held until closed or until the process dies.

    Attributes:
        number: random; part of the agent's liveliness key.
    """

    def __init__(
        self, bus: Bus, keys: ClaimKeys, robot: str, leaving: float = LEAVING, refusal: str = ""
    ) -> None:
        """Claim the robot.

        The agent checks for other claims and then announces its own. Two agents that start at the same time
        see each other in a second check; the one with the greater number gives up. Without a router no other
        agent is seen; the serial port is locked, and a remote base is out of reach.

        Args:
            bus: bus of the robot base, connected if a router is there.
            keys: keys of the fleet, or of a topic.
            robot: name of the robot, or of the topic that drives it.
            leaving: how long to wait for the end of another claim, whose agent may be dead, s.
            refusal: what to say to a second agent; by default that of a fleet.

        Raises:
            DeviceError: another agent drives the robot.
        """
        self.number = secrets.randbits(52)
        self._others: set[int] = set()
        self._changed = threading.Condition()
        self._keys = keys
        self._refused = refusal or (
            f"another agent drives {robot}; stop it, or give this robot another name. "
            f"One that hangs, or has lost the network, is gone after {AGENT_LEASE:g} s"
        )
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
        """Release the claim. May be called twice."""
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
        """Whether the robot is free after the settling time, or within the patience after that."""
        time.sleep(SETTLING)
        with self._changed:
            return self._changed.wait_for(free, patience)

    def _refusal(self) -> DeviceError:
        return DeviceError(self._refused)

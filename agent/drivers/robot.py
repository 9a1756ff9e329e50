"""The Robot protocol: a few methods that a driver, a recording, the simulator and a test all have.

SI units and radians throughout; `docs/drivers.md` says how to write one.
"""

from __future__ import annotations

from typing import Protocol

from mapweave.agent.observation import Command, Observation, RobotDescription


class Robot(Protocol):
    """A robot base: returns observations, executes commands."""

    def describe(self) -> RobotDescription:
        """Camera, footprint, limits."""
        ...

    def sense(self) -> Observation | None:
        """Wait for the next observation, at most two ticks. None when there will be no more.

        A line to the robot that fails later does not end it: the robot stands, its odometry and proximity
        readings stop, and the driver connects again.

        Raises:
            DeviceError: the robot cannot be read.
        """
        ...

    def act(self, command: Command) -> Command:
        """Send a command; returns the command that is really applied. Takes no time.

        The wheels stop within 0.5 s when no further command comes, also when this process dies.
        """
        ...

    def close(self) -> None:
        """Stop the wheels and let go."""
        ...

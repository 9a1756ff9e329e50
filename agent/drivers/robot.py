"""The Robot protocol, which drivers, recordings, the simulator and tests implement.

SI units and radians throughout. `docs/drivers.md` explains how to write a driver.
"""

from __future__ import annotations

from typing import Protocol

from mapweave.agent.observation import Command, Observation, RobotDescription


class Robot(Protocol):
    """A robot base: returns observations, executes commands."""

    def describe(self) -> RobotDescription:
        """Camera, footprint, limits."""

    def sense(self) -> Observation | None:
        """Wait for the next observation, at most two ticks. None at the end of the observations.

        A driver whose line fails later reconnects. Meanwhile the robot stands, and its observations have zero
        odometry and no proximity readings.

        Raises:
            DeviceError: the robot cannot be read.
        """

    def act(self, command: Command) -> Command:
        """Send a command; returns the applied command. Does not block.

        The wheels stop within 0.5 s when no further command follows, also when this process dies.
        """

    def close(self) -> None:
        """Stop the wheels and let go."""

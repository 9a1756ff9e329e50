"""The Robot protocol: a few methods that the Koala, a recording, the simulator and a test all have."""

from __future__ import annotations

from typing import Protocol

from mapweave.agent.observation import Command, Observation, RobotDescription


class Robot(Protocol):
    """A robot base: returns observations, executes commands."""

    def describe(self) -> RobotDescription:
        """Camera, footprint, limits."""
        ...

    def sense(self) -> Observation | None:
        """Wait for the next observation. None when there will be no more (end of a recording).

        Raises:
            DeviceError: the robot cannot be read.
        """
        ...

    def act(self, command: Command) -> Command:
        """Send a command; returns the command that is really applied (clipped to the limits)."""
        ...

    def close(self) -> None:
        """Stop the wheels and let go."""
        ...

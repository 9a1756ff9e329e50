"""The Robot protocol, which drivers, recordings, the simulator and tests implement.

SI units and radians throughout. `docs/drivers.md` explains how to write a driver.
"""

import math
from typing import Protocol

from mapweave.agent.observation import Command, Observation, RobotDescription
from mapweave.hybridmap.errors import InvalidValue


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


def clip(command: Command, description: RobotDescription) -> Command:
    """The command within the robot's limits.

    Raises:
        InvalidValue: it is not finite.
    """
    if not (math.isfinite(command.forward) and math.isfinite(command.turn)):
        raise InvalidValue(f"command: {command} is not finite")
    forward, turn = description.max_forward, description.max_turn
    return Command(
        min(max(command.forward, -forward), forward),
        min(max(command.turn, -turn), turn),
    )

"""A robot whose observations and commands are written down on the way."""

from __future__ import annotations

from mapweave.agent.drivers.robot import Robot
from mapweave.agent.observation import Command, Observation, RobotDescription
from mapweave.agent.recordings.mcap_writer import McapWriter


class RecordedRobot:
    """The Robot protocol around another robot."""

    def __init__(self, robot: Robot, writer: McapWriter) -> None:
        """Both become this one's to close."""
        self._robot, self._writer, self._applied = robot, writer, Command()

    def describe(self) -> RobotDescription:
        """The other robot's."""
        return self._robot.describe()

    def sense(self) -> Observation | None:
        """The other robot's next observation; see Robot.

        Raises:
            DeviceError: the robot cannot be read.
        """
        observation = self._robot.sense()
        if observation is not None:
            self._writer.write(observation, self._applied)
        return observation

    def act(self, command: Command) -> Command:
        """Send a command; returns what is applied."""
        self._applied = self._robot.act(command)
        return self._applied

    def close(self) -> None:
        """Stop the wheels first, then finish the recording."""
        try:
            self._robot.close()
        finally:
            self._writer.close()

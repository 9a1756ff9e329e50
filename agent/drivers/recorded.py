"""A robot whose observations and commands are written down on the way."""

from collections.abc import Callable
from pathlib import Path

from mapweave.agent.drivers.robot import Robot
from mapweave.agent.observation import Command, Observation, RobotDescription
from mapweave.agent.recordings.mcap_writer import McapWriter, check_new


class RecordedRobot:
    """The Robot protocol around another robot."""

    def __init__(
        self,
        robot: Robot,
        folder: Path,
        lossless: bool = False,
        print_line: Callable[[str], None] = lambda line: None,
    ) -> None:
        """Check where the recording goes. It begins when the robot has been described.

        Args:
            robot: becomes this one's to close.
            folder: new or empty.
            lossless: images as PNG instead of JPEG.
            print_line: takes lines for people.

        Raises:
            DeviceError: the folder cannot be made, or holds something.
        """
        check_new(folder)
        self._robot, self._folder, self._lossless, self._print = robot, folder, lossless, print_line
        self._writer: McapWriter | None = None
        self._applied = Command()

    @property
    def written(self) -> int:
        """Observations that are on the disk."""
        return 0 if self._writer is None else self._writer.written

    @property
    def failed(self) -> bool:
        """Whether the recording has ended by itself, as on a full disk; a line has said why."""
        return self._writer is not None and self._writer.failed

    def describe(self) -> RobotDescription:
        """Description of the other robot."""
        description = self._robot.describe()
        if self._writer is None:
            self._writer = McapWriter(self._folder, description, self._lossless, self._print)
        return description

    def sense(self) -> Observation | None:
        """The other robot's next observation; see Robot.

        Raises:
            DeviceError: the robot cannot be read.
        """
        observation = self._robot.sense()
        if observation is not None and self._writer is not None:
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
            if self._writer is not None:
                self._writer.close()

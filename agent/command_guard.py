"""The guard over all behaviours: what of a command is safe by rangers, camera and bumper."""

import math

from mapweave.agent.camera_occupancy import CameraOccupancyGrid
from mapweave.agent.cautious_driving import ALONG_EDGES, CautiousDriving, speed_for
from mapweave.agent.exploration.camera_exploration import with_readings
from mapweave.agent.observation import Command, Observation, RobotDescription
from mapweave.agent.occupancy_grid import OccupancyGrid
from mapweave.agent.servo.proximity import guard
from mapweave.hybridmap.pose import Pose2


class CommandGuard:
    """Makes commands safe; the last before the wheels."""

    def __init__(self, caution: CautiousDriving | None) -> None:
        """Take how a robot without rangers drives; None of one with rangers."""
        self._caution = caution
        self._direction = 1.0

    def safe(
        self,
        command: Command,
        observation: Observation,
        description: RobotDescription,
        driven: bool,
        floor: OccupancyGrid | None,
        pose: Pose2,
    ) -> tuple[Command, str]:
        """The command as far as it is safe, and why it is not the one that was wanted.

        Args:
            command: that is wanted.
            observation: what the robot senses now.
            description: of the robot.
            driven: whether a person drives.
            floor: that an exploring robot knows; one without rangers keeps to what its camera has seen of it.
            pose: `map_from_robot`.
        """
        warning, caution = "", self._caution
        if caution is None:
            safe, warning = guard(command, observation.proximity, description)
        elif driven:
            safe = caution.command(command, description.max_forward, follow=True)
        else:
            most = ALONG_EDGES
            if isinstance(floor, CameraOccupancyGrid):
                command, warning = guard(command, floor.readings(pose), with_readings(description))
                direction = 0.0 if command.forward >= 0.0 else math.pi
                most = speed_for(floor.known_ahead(pose, direction, 0.5))
            safe = caution.command(command, most)
            warning = "backing off from a touch" if caution.backing_off else warning
        if observation.bumped and safe.forward * self._direction > 0:
            return Command(0.0, safe.turn), "stopped: the bumper is pressed"
        if not observation.bumped and safe.forward:
            self._direction = math.copysign(1.0, safe.forward)
        return safe, warning

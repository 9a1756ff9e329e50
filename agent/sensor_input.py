"""What a robot senses as its pipeline uses it: of a pinhole, calibrated, without what failed sensors say."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.blind_zone import BlindZone
from mapweave.agent.calibration.online import OnlineCalibration
from mapweave.agent.observation import Command, Observation, RobotDescription
from mapweave.agent.sensor_health.odometry_convention import OdometryConvention
from mapweave.agent.sensor_health.sensor_monitor import SensorMonitor
from mapweave.agent.sensor_health.silent_wheel import SilentWheel
from mapweave.vision.lens import NO_DISTORTION, Lens


def as_pinhole(description: RobotDescription) -> RobotDescription:
    """The robot with the images that are used: those of a fisheye are rectified."""
    rectifies = Lens(description.camera, description.distortion).rectifies
    return replace(description, distortion=NO_DISTORTION) if rectifies else description


class SensorInput:
    """Rectifies, corrects and checks each observation.

    Attributes:
        monitor: which sensors cannot be believed.
        image: (H, W) grey, the last one as it is used; None without one.
    """

    def __init__(self, declared: RobotDescription, description: RobotDescription) -> None:
        """All sensors are believed until they fail.

        Args:
            declared: the robot as its settings describe it.
            description: as it is calibrated.
        """
        self._lens = Lens(declared.camera, declared.distortion)
        self._convention = OdometryConvention(declared.camera)
        self.monitor = SensorMonitor(description)
        self._silent = SilentWheel(description)
        self._blind_zone = BlindZone(description)
        self.image: NDArray[np.uint8] | None = None

    def believed(
        self, observation: Observation, command: Command | None, calibration: OnlineCalibration
    ) -> Observation:
        """What of an observation is used.

        Args:
            observation: as the driver gives it.
            command: that the robot itself has given last; None if it has not.
            calibration: corrects the odometry.
        """
        if self._lens.rectifies and observation.image is not None:
            observation = replace(observation, image=self._lens.rectified(observation.image))
        self.image = observation.image
        self._convention.see(observation)
        if command is None:
            self._silent.see(observation)
        observation = self.monitor.see(calibration.correct(observation), command)
        observation = self._blind_zone.fill(observation)
        if self.monitor.pose_lost:
            self.forget_ranges()
        return observation

    def forget_ranges(self) -> None:
        """The robot is elsewhere: what was near is void."""
        self._blind_zone.forget()

    @property
    def complaints(self) -> list[str]:
        """What was found to be wrong with the odometry, a line each."""
        # A dead encoder explains what else is strange about the odometry.
        return [self._silent.complaint] if self._silent.complaint else self._convention.complaints

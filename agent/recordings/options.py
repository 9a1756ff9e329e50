"""What a person adds to a recording that does not say everything."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from mapweave.agent.drive_geometry import check_mount
from mapweave.agent.recordings.camera_file import read_camera
from mapweave.agent.recordings.incomplete import CameraAndLens, CameraGiven
from mapweave.hybridmap.errors import DeviceError, InvalidValue


@dataclass(frozen=True)
class RecordingSettings:
    """Which topics of a bag are the robot's; other recordings have none. The command line overrides it.

    Attributes:
        image_topic: images; empty takes the topic with most.
        odometry_topic: odometry; empty takes the most likely topic, by its type and name.
        camera_info_topic: calibration of the camera; empty takes the topic beside the images.
    """

    image_topic: str = ""
    odometry_topic: str = ""
    camera_info_topic: str = ""


@dataclass(frozen=True)
class RecordingOptions:
    """The options of `mapweave replay` and `mapweave info` that say how a recording is read.

    Attributes:
        camera: a camera.toml, instead of what the recording says.
        camera_height: above the floor, m, if the recording does not say.
        odometry: file with poses, see `mapweave.agent.recordings.pose_files`.
        image_topic: of a bag; None takes the most likely one.
        odometry_topic: of a bag; likewise.
        camera_info_topic: of a bag; None takes the one beside the images.
        settings: topics of bags where none are given here.
    """

    camera: Path | None = None
    camera_height: float | None = None
    odometry: Path | None = None
    image_topic: str | None = None
    odometry_topic: str | None = None
    camera_info_topic: str | None = None
    settings: RecordingSettings = field(default_factory=RecordingSettings)

    def of_bag(self) -> RecordingOptions:
        """The same with the topics of the settings where none are given."""
        return replace(
            self,
            image_topic=self.image_topic or self.settings.image_topic or None,
            odometry_topic=self.odometry_topic or self.settings.odometry_topic or None,
            camera_info_topic=self.camera_info_topic or self.settings.camera_info_topic or None,
        )

    def check_used(self, path: Path, is_bag: bool, has_height: bool) -> None:
        """Refuse an option that the recording does not use: a person who gives one expects an effect.

        Args:
            path: of the recording.
            is_bag: whether it has topics.
            has_height: whether its camera.toml gives the height of the camera.

        Raises:
            DeviceError: the option.
        """
        topics = {
            "--image-topic": self.image_topic,
            "--odometry-topic": self.odometry_topic,
            "--camera-info-topic": self.camera_info_topic,
        }
        for option, topic in topics.items():
            if topic is not None and not is_bag:
                raise DeviceError(f"{path}: is no bag and has no topics: leave out {option}")
        if self.camera_height is not None and (has_height or self.camera is not None):
            file = self.camera or path / "camera.toml"
            raise DeviceError(f"{path}: the height is height_m of {file}: leave out --camera-height")

    def camera_of(self, given: CameraAndLens | None, height_given: bool = False) -> CameraGiven:
        """The camera: the person's file, else the recording's with the person's height.

        Args:
            given: by the recording.
            height_given: whether its mount is, too.

        Raises:
            DeviceError: the person's file is missing or wrong, or the height cannot be right.
        """
        if self.camera is not None:
            return CameraGiven(read_camera(self.camera))
        if given is None:
            return CameraGiven(None, "does not say what camera it is; give --camera FILE (a camera.toml)")
        camera, distortion = given
        if self.camera_height is not None:
            try:
                check_mount(self.camera_height)
            except InvalidValue as error:
                raise DeviceError(f"--camera-height: {error}") from None
            return CameraGiven((replace(camera, mount_height=self.camera_height), distortion))
        lacks = "" if height_given else "does not say how high the camera is; give --camera-height METRES"
        return CameraGiven(given, lacks)

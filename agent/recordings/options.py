"""What a person adds to a recording that does not say everything."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from mapweave.agent.recordings.camera_file import read_camera
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import DeviceError
from mapweave.vision.lens import Distortion


@dataclass(frozen=True)
class RecordingOptions:
    """Of `mapweave replay` and `mapweave info`.

    Attributes:
        camera: a camera.toml, instead of what the recording says.
        camera_height: above the floor, m, if the recording does not say.
        odometry: file with poses, see `mapweave.agent.recordings.pose_files`.
        image_topic: of a bag; None takes the most likely one.
        odometry_topic: of a bag; likewise.
    """

    camera: Path | None = None
    camera_height: float | None = None
    odometry: Path | None = None
    image_topic: str | None = None
    odometry_topic: str | None = None

    def camera_of(
        self, path: Path, given: tuple[Camera, Distortion] | None, height_given: bool = False
    ) -> tuple[Camera, Distortion]:
        """The camera: the person's file, else the recording's with the person's height.

        Args:
            path: of the recording, for the error.
            given: by the recording.
            height_given: whether its mount is, too.

        Raises:
            DeviceError: the camera or its height is not given.
        """
        if self.camera is not None:
            return read_camera(self.camera)
        if given is None:
            raise DeviceError(f"{path}: does not say what camera it is; give --camera FILE (a camera.toml)")
        camera, distortion = given
        if self.camera_height is not None:
            return replace(camera, mount_height=self.camera_height), distortion
        if not height_given:
            raise DeviceError(f"{path}: does not say how high the camera is; give --camera-height METRES")
        return given


NO_ODOMETRY = (
    "no odometry: give --odometry FILE (stamped poses), or let `mapweave replay` map it by its images alone, "
    "without a scale"
)

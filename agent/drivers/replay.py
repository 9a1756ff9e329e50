"""A robot that is a recording: the same pipeline runs on its camera images and odometry.

What formats there are stands in `mapweave.agent.recordings.opening`. `splits.toml` beside a recording cuts it
into robots. Ground truth is for scoring and is never read here.
"""

from pathlib import Path

import numpy as np

from mapweave.agent.drive_geometry import DriveGeometry
from mapweave.agent.observation import Command, Observation, Odometry, RobotDescription
from mapweave.agent.recordings.geometry_file import read_geometry
from mapweave.agent.recordings.opening import open_recording
from mapweave.agent.recordings.options import RecordingOptions
from mapweave.agent.recordings.recording import Recording
from mapweave.agent.recordings.splits import read_split
from mapweave.agent.recordings.wheel_data import WheelModel
from mapweave.hybridmap.errors import DeviceError

AXLE_PER_HEIGHT = 0.9
"""Where a recording does not give its robot's axle; taller robots are wider."""


class Replay:
    """The Robot protocol over a recording. It takes no commands."""

    def __init__(
        self,
        path: Path,
        robot: str | None = None,
        frames: range | None = None,
        options: RecordingOptions | None = None,
    ) -> None:
        """Open a recording.

        Args:
            path: of the recording.
            robot: which robot of the `splits.toml` in its folder; None plays all frames.
            frames: only these, without regard to `splits.toml`; ascending.
            options: what the recording does not say.

        Raises:
            DeviceError: something is missing or wrong, in one line.
        """
        self.recording: Recording = open_recording(path, options)
        folder = path if path.is_dir() else path.parent
        settings = options.camera if options is not None and options.camera is not None else None
        given = read_geometry(settings or folder / "camera.toml")
        self._geometry = DriveGeometry(**given) if given else None
        try:
            self._frames = frames or read_split(folder / "splits.toml", robot, len(self.recording))
        except DeviceError as error:
            # Images may be too few since what follows cannot be read.
            raise DeviceError("; ".join((str(error), *self.recording.damage))) from None
        if not 0 <= self._frames[0] <= self._frames[-1] < len(self.recording):
            raise DeviceError(f"{path}: {self._frames} is not within the {len(self.recording)} images")
        self._position = 0
        self._before: int | None = None
        self._unreadable: list[str] = []

    def __len__(self) -> int:
        """How many observations there are."""
        return len(self._frames)

    @property
    def played(self) -> int:
        """How many observations were given, or left out since they cannot be read."""
        return self._position

    def describe(self) -> RobotDescription:
        """The camera; no rangers and no wheels to command."""
        recording = self.recording
        tick = float(np.median(np.diff(recording.stamps_ns))) * 1e-9 * self._frames.step
        wheels = recording.wheels
        if wheels is None:
            axle = AXLE_PER_HEIGHT * max(recording.camera.mount_height, 0.1)
            wheels = WheelModel(axle, RobotDescription.wheel_noise, RobotDescription.side_slip)
        return RobotDescription(
            camera=recording.camera,
            distortion=recording.distortion,
            axle=wheels.axle,
            wheel_noise=wheels.wheel_noise,
            side_slip=wheels.side_slip,
            max_forward=0.0,
            max_turn=0.0,
            tick=tick,
            geometry=self._geometry,
        )

    @property
    def damage(self) -> list[str]:
        """What of the recording could not be read so far, a line each."""
        lines = list(self.recording.damage)
        if self._unreadable:
            count = len(self._unreadable)
            lines.append(f"{self._unreadable[0]} (left out, {count} of {len(self)} images)")
        return lines

    def sense(self) -> Observation | None:
        """The next frame that can be read, with the odometry since the one before; None at the end.

        Raises:
            DeviceError: no image of the recording can be read.
        """
        while self._position < len(self._frames):
            frame = self._frames[self._position]
            self._position += 1
            try:
                image = self.recording.read(frame)
            except DeviceError as error:
                self._unreadable.append(str(error))
                continue
            before, self._before = frame if self._before is None else self._before, frame
            forward, turn = self.recording.increments[before + 1 : frame + 1].sum(axis=0)
            stamp_ns = int(self.recording.stamps_ns[frame])
            flags = self.recording.kidnapped
            kidnapped = flags is not None and bool(flags[min(before + 1, frame) : frame + 1].any())
            return Observation(stamp_ns, Odometry(float(forward), float(turn)), image, kidnapped=kidnapped)
        if self._before is None:
            raise DeviceError(self._unreadable[0])
        return None

    def act(self, command: Command) -> Command:
        """Nothing moves: what is applied is always standing still."""
        return Command()

    def close(self) -> None:
        """Nothing to let go of."""

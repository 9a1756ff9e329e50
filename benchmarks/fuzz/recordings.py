"""Recordings of every format but MCAP, small and good: what is mutated is one of their files.

An input is the number of a file of the recording, one byte, and what that file then has. All others are good.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.fuzz.texts import CAMERA_TOML
from mapweave.agent.recordings.opening import open_recording
from mapweave.agent.recordings.options import RecordingOptions

COUNT = 3
"""Images of each."""
HEIGHT = 0.3
"""Of the camera, m, where the format does not say it."""
KITTI_CALIB = "P0: 60 0 32 0 0 60 24 0 0 0 1 0\nP1: 60 0 32 -30 0 60 24 0 0 0 1 0\n"
EUROC_SENSOR = """\
sensor_type: camera
rate_hz: 20
resolution: [64, 48]
camera_model: pinhole
intrinsics: [60.0, 60.0, 32.0, 24.0]
distortion_model: radial-tangential
distortion_coefficients: [-0.28, 0.07, 0.0001, 1.7e-05]
"""


def _pixels(number: int) -> np.ndarray[Any, np.dtype[np.uint8]]:
    return np.random.default_rng(number).integers(0, 255, (48, 64), dtype=np.uint8)


def _images(folder: Path, names: list[str]) -> None:
    folder.mkdir(parents=True)
    for number, name in enumerate(names):
        (folder / name).write_bytes(cv2.imencode(".png", _pixels(number))[1].tobytes())


def _kitti(folder: Path) -> Path:
    _images(folder / "image_0", [f"{k:06}.png" for k in range(COUNT)])
    (folder / "calib.txt").write_text(KITTI_CALIB)
    (folder / "times.txt").write_text("0.0\n1.0e-01\n2.0e-01\n")
    return folder


def _euroc(folder: Path) -> Path:
    camera = folder / "mav0" / "cam0"
    stamps = [10**18 + k * 10**8 for k in range(COUNT)]
    _images(camera / "data", [f"{stamp}.png" for stamp in stamps])
    (camera / "sensor.yaml").write_text(EUROC_SENSOR)
    rows = "".join(f"{stamp},{stamp}.png\n" for stamp in stamps)
    (camera / "data.csv").write_text("#timestamp [ns],filename\n" + rows)
    return folder


def _tum(folder: Path) -> Path:
    _images(folder / "rgb", [f"{k}.png" for k in range(COUNT)])
    (folder / "rgb.txt").write_text(
        "# timestamp filename\n" + "".join(f"1.{k} rgb/{k}.png\n" for k in range(COUNT))
    )
    return folder


def _four_seasons(folder: Path) -> Path:
    _images(folder / "undistorted_images" / "cam0", [f"{10**9 + k}.png" for k in range(COUNT)])
    (folder / "times.txt").write_text("".join(f"{10**9 + k} 1.{k} 0.01\n" for k in range(COUNT)))
    return folder


def _images_folder(folder: Path) -> Path:
    _images(folder / "images", [f"{k}.png" for k in range(COUNT)])
    (folder / "camera.toml").write_text(CAMERA_TOML)
    (folder / "times.txt").write_text("0.0\n0.1\n0.2\n")
    (folder / "odometry.csv").write_text("forward_m,turn_rad\n" + "0.01,0.002\n" * COUNT)
    return folder


def _video(folder: Path) -> Path:
    path = folder / "drive.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (64, 48))
    for number in range(COUNT):
        writer.write(np.dstack([_pixels(number)] * 3))
    writer.release()
    return path


def _ros1(folder: Path) -> Path:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    types, path = get_typestore(Stores.ROS1_NOETIC), folder / "drive.bag"
    with Writer(path) as writer:
        _write_messages(writer, types, types.serialize_ros1, {"seq": 0})
    return path


def _ros2(folder: Path) -> Path:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    types, path = get_typestore(Stores.ROS2_HUMBLE), folder / "drive"
    with Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        _write_messages(writer, types, types.serialize_cdr, {})
    return path


def _write_messages(writer: Any, types: Any, serialize: Any, sequence: dict[str, int]) -> None:
    """Images, what camera they are of, and odometry.

    Args:
        writer: of a bag.
        types: the message types of its ROS.
        serialize: a message.
        sequence: further fields of a header; ROS 1 has a sequence number.
    """
    kinds = {"/image": "sensor_msgs/msg/Image", "/camera_info": "sensor_msgs/msg/CameraInfo",
             "/odom": "nav_msgs/msg/Odometry"}  # fmt: skip
    connections = {
        topic: writer.add_connection(topic, kind, typestore=types) for topic, kind in kinds.items()
    }
    made = types.types
    lens = ("D", "K", "R", "P") if sequence else ("d", "k", "r", "p")
    for number in range(COUNT):
        stamp = made["builtin_interfaces/msg/Time"](sec=number + 1, nanosec=0)
        header = made["std_msgs/msg/Header"](**sequence, stamp=stamp, frame_id="camera")
        region = made["sensor_msgs/msg/RegionOfInterest"](
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        optics = (np.zeros(5), np.array([60.0, 0, 32, 0, 60, 24, 0, 0, 1]), np.eye(3).ravel(), np.zeros(12))
        pose = made["geometry_msgs/msg/Pose"](
            position=made["geometry_msgs/msg/Point"](x=0.1 * number, y=0.0, z=0.0),
            orientation=made["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
        )
        still = made["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
        messages = {
            "/image": made[kinds["/image"]](
                header=header, height=48, width=64, encoding="mono8", is_bigendian=0, step=64,
                data=_pixels(number).ravel(),
            ),
            "/camera_info": made[kinds["/camera_info"]](
                header=header, height=48, width=64, distortion_model="plumb_bob",
                **dict(zip(lens, optics, strict=True)), binning_x=0, binning_y=0, roi=region,
            ),
            "/odom": made[kinds["/odom"]](
                header=header, child_frame_id="base_link",
                pose=made["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36)),
                twist=made["geometry_msgs/msg/TwistWithCovariance"](
                    twist=made["geometry_msgs/msg/Twist"](linear=still, angular=still),
                    covariance=np.zeros(36),
                ),
            ),
        }  # fmt: skip
        for topic, message in messages.items():
            writer.write(connections[topic], (number + 1) * 10**9, serialize(message, kinds[topic]))


@dataclass
class RecordingTarget:
    """Recordings of one format.

    Attributes:
        make: makes a good one in an empty folder, and returns its path.
        has_camera: whether it says what its camera is, but for its height; else a person does.
        has_height: whether it says that as well.
        stamps: of its images, s, if it has no odometry of its own.
    """

    make: Callable[[Path], Path]
    has_camera: bool = False
    has_height: bool = False
    stamps: tuple[float, ...] = ()
    _path: Path | None = field(default=None, repr=False)
    _folder: tempfile.TemporaryDirectory[str] | None = field(default=None, repr=False)

    def samples(self) -> list[bytes]:
        """Each file once; of equal kinds, such as images, the first."""
        files = self._files()
        suffixes = [file.suffix for file in files]
        return [
            bytes([number]) + file.read_bytes()
            for number, file in enumerate(files)
            if file.suffix not in (".png",) or suffixes.index(file.suffix) == number
        ]

    def run(self, data: bytes, folder: Path) -> None:
        """Open the recording with one file as it is given, and read its first images."""
        if not data:
            return
        files = self._files()
        file = files[data[0] % len(files)]
        good = file.read_bytes()
        file.write_bytes(data[1:])
        try:
            recording = open_recording(self._recording(), self._options(folder))
            for number in range(min(len(recording.stamps_ns), COUNT)):
                recording.read(number)
        finally:
            file.write_bytes(good)

    def _recording(self) -> Path:
        if self._path is None:
            # Removed as the process ends.
            self._folder = tempfile.TemporaryDirectory(prefix="fuzz-recording-")
            self._path = self.make(Path(self._folder.name))
        return self._path

    def _files(self) -> list[Path]:
        path = self._recording()
        return [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())

    def _options(self, folder: Path) -> RecordingOptions:
        options = RecordingOptions()
        if self.stamps:
            poses = folder / "poses.txt"
            rows = (f"{stamp} {0.1 * k} 0 0 0 0 0 1\n" for k, stamp in enumerate(self.stamps))
            poses.write_text("".join(rows))
            options = replace(options, odometry=poses)
        if self.has_height:
            return options
        if self.has_camera:
            return replace(options, camera_height=HEIGHT)
        camera = folder / "camera.toml"
        camera.write_text(CAMERA_TOML)
        return replace(options, camera=camera)


RECORDINGS = {
    "kitti": RecordingTarget(_kitti, has_camera=True, stamps=(0.0, 0.1, 0.2)),
    "euroc": RecordingTarget(_euroc, has_camera=True, stamps=(1e9, 1e9 + 0.1, 1e9 + 0.2)),
    "tum_rgbd": RecordingTarget(_tum, stamps=(1.0, 1.1, 1.2)),
    "four_seasons": RecordingTarget(_four_seasons, stamps=(1.0, 1.1, 1.2)),
    "images_folder": RecordingTarget(_images_folder, has_camera=True, has_height=True),
    "video": RecordingTarget(_video, stamps=(0.0, 0.1, 0.2)),
    "ros1_bag": RecordingTarget(_ros1),
    "ros2_bag": RecordingTarget(_ros2, has_camera=True),
}

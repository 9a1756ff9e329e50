"""Recordings as MCAP with standard ROS 2 messages: Foxglove and rviz open them, `mapweave replay` too."""

from __future__ import annotations

import math
import os
import queue
import struct
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from mapweave.agent.observation import Command, Observation, RobotDescription
from mapweave.agent.recordings.wheel_data import wheel_data
from mapweave.agent.ros_messages import making
from mapweave.agent.ros_messages.values import FOOTPRINT as BASE
from mapweave.agent.ros_messages.values import KIDNAP_TYPE
from mapweave.hybridmap.errors import DeviceError
from mapweave.hybridmap.pose import Pose2
from mapweave.storage.os_errors import reason_of
from mapweave.wire.ros2.messages import make, typestore

if TYPE_CHECKING:
    from rosbags.interfaces import Qos
    from rosbags.rosbag2 import Writer

PART_S = 60.0
"""A recording is a row of files, none longer than this, s: what a disk's failure can damage."""
FLUSH_S = 2.0
"""So often all is on the disk, and file and metadata complete, s: a robot whose power fails loses no more."""
MCAP_END = struct.pack("<BQI", 0x0F, 4, 0) + struct.pack("<BQQQI", 0x02, 20, 0, 0, 0) + b"\x89MCAP0\r\n"
"""A data end and a footer without checksums, summary and index (https://mcap.dev/spec): a reader scans."""
WAITING = 200
"""Observations that wait for the disk; more are dropped, and counted."""
JPEG_QUALITY = 95
"""Chosen, OpenCV's default. `--lossless` writes PNG."""
KEPT = ("/tf_static", "/kidnap_status")
"""Topics whose last message holds: who subscribes later gets it too (durability transient-local)."""
ODOM = "odom"
"""Frame of REP 105."""


def check_new(folder: Path) -> None:
    """Make the folder of a recording, unless it is there and empty.

    Raises:
        DeviceError: it cannot be made, or holds something.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise DeviceError(f"{folder}: not empty; a recording overwrites nothing, give another folder")
    except OSError as error:
        raise DeviceError(f"{folder}: {reason_of(error)}") from None


class McapWriter:
    """Writes a robot's observations and commands, in a thread of its own.

    Topics: /camera/image/compressed, /camera/camera_info, /odom, /tf, /tf_static, /cmd_vel, /bumper,
    /kidnap_status (when it changes), /proximity/N.
    """

    def __init__(
        self,
        folder: Path,
        description: RobotDescription,
        lossless: bool = False,
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        """Begin a recording.

        Args:
            folder: new or empty; gets a bag of at most `PART_S` each.
            description: of the robot.
            lossless: images as PNG instead of JPEG: three to four times as large.
            say: takes lines for people.

        Raises:
            DeviceError: the folder cannot be made, or holds something.
        """
        check_new(folder)
        self._folder, self._description, self._lossless, self._say = folder, description, lossless, say
        self._waiting: queue.Queue[tuple[Observation, Command, Pose2] | None] = queue.Queue(WAITING)
        self._part: _Part | None = None
        self._parts, self.written, self.dropped = 0, 0, 0
        self._failed = ""
        self._odom_from_robot = Pose2()
        self._thread = threading.Thread(target=self._write, name="recording", daemon=True)
        self._thread.start()

    def write(self, observation: Observation, command: Command) -> None:
        """Take an observation, and the command that was applied before it. Never waits."""
        self._odom_from_robot = self._odom_from_robot @ observation.odometry.motion()
        try:
            self._waiting.put_nowait((observation, command, self._odom_from_robot))
        except queue.Full:
            self.dropped += 1
            if self.dropped == 1:
                self._say(f"{self._folder}: the disk is too slow, observations are left out of the recording")

    @property
    def failed(self) -> bool:
        """Whether the recording has ended before it was closed: nothing more is written."""
        return bool(self._failed)

    def close(self) -> None:
        """Write what waits and finish the file."""
        if not self._thread.is_alive():
            return
        self._waiting.put(None)
        self._thread.join()
        if self.dropped:
            self._say(
                f"{self._folder}: {self.dropped} of {self.dropped + self.written} observations were left out"
            )

    def _write(self) -> None:
        while (item := self._waiting.get()) is not None:
            if self._failed:
                continue
            observation, command, odom_from_robot = item
            try:
                if self._part is None or observation.stamp_ns - self._part.begun_ns > PART_S * 1e9:
                    self._next_part(observation.stamp_ns)
                assert self._part is not None
                self._part.write(observation, command, odom_from_robot)
                self.written += 1
            except Exception as error:  # noqa: BLE001 - a thread that ends without a word records nothing
                self._fail(error)
        try:
            if self._part is not None:
                self._part.close()
        except Exception as error:  # noqa: BLE001 - as above: the disk may be full
            self._fail(error)

    def _fail(self, error: Exception) -> None:
        if self._failed:
            return
        words = " ".join(str(error).split()) or type(error).__name__
        self._failed = reason_of(error) if isinstance(error, OSError) else words
        self._say(f"{self._folder}: the recording ends here, {self._failed}")

    def _next_part(self, stamp_ns: int) -> None:
        if self._part is not None:
            self._part.close()
        path = self._folder / f"{self._folder.name}_{self._parts}"
        self._part = _Part(path, self._description, stamp_ns, self._lossless)
        self._parts += 1


class McapTopics:
    """Messages of ROS 2 in a bag; a topic is there once it has a message."""

    def __init__(self, writer: Writer) -> None:
        """Take a bag that is open."""
        self._writer, self._store = writer, typestore()
        self._connections: dict[str, Any] = {}

    def send(self, topic: str, message: Any, stamp_ns: int) -> None:
        """Write a message."""
        name = message.__msgtype__
        if topic not in self._connections:
            profiles = [_transient_local()] if topic in KEPT else []
            self._connections[topic] = self._writer.add_connection(
                topic, name, typestore=self._store, offered_qos_profiles=profiles
            )
        data = self._store.serialize_cdr(message, name)
        self._writer.write(self._connections[topic], stamp_ns, data)


class _Part:
    """One bag of a recording."""

    def __init__(self, path: Path, description: RobotDescription, begun_ns: int, lossless: bool) -> None:
        from rosbags.rosbag2 import StoragePlugin, Writer

        self.begun_ns = self._flushed_ns = begun_ns
        self._lossless = lossless
        self._kidnapped: bool | None = None
        self._writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
        for key, value in wheel_data(description).items():
            self._writer.set_custom_data(key, value)
        self._writer.open()
        self._topics = McapTopics(self._writer)
        self._description = description
        self._put(
            "/tf_static",
            "tf2_msgs/msg/TFMessage",
            begun_ns,
            transforms=[making.mount(begun_ns, description.camera), *self._ranger_mounts()],
        )
        self._flush()

    def write(self, observation: Observation, command: Command, odom_from_robot: Pose2) -> None:
        stamp = observation.stamp_ns
        if observation.image is not None:
            kind = ".png" if self._lossless else ".jpg"
            quality = [] if self._lossless else [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
            data = cv2.imencode(kind, observation.image, quality)[1].reshape(-1)
            header = making.header(stamp, making.OPTICAL)
            name = "sensor_msgs/msg/CompressedImage"
            word = "png" if self._lossless else "jpeg"
            self._put("/camera/image/compressed", name, stamp, header=header, format=word, data=data)
            info = making.camera_info(header, self._description.camera, self._description.distortion)
            self._topics.send("/camera/camera_info", info, stamp)
        unknown = np.zeros(36)
        pose = make(
            "geometry_msgs/msg/PoseWithCovariance", pose=making.pose(odom_from_robot), covariance=unknown
        )
        twist = make(
            "geometry_msgs/msg/TwistWithCovariance", twist=making.twist(Command()), covariance=unknown
        )
        header, name = making.header(stamp, ODOM), "nav_msgs/msg/Odometry"
        self._put("/odom", name, stamp, header=header, child_frame_id=BASE, pose=pose, twist=twist)
        moved = making.transform(stamp, ODOM, BASE, odom_from_robot)
        self._put("/tf", "tf2_msgs/msg/TFMessage", stamp, transforms=[moved])
        name = "geometry_msgs/msg/TwistStamped"
        self._put("/cmd_vel", name, stamp, header=making.header(stamp, BASE), twist=making.twist(command))
        if observation.bumped:
            self._put("/bumper", "std_msgs/msg/Bool", stamp, data=True)
        if observation.kidnapped != self._kidnapped:
            self._kidnapped = observation.kidnapped
            header = making.header(stamp, BASE)
            self._put("/kidnap_status", KIDNAP_TYPE, stamp, header=header, is_kidnapped=self._kidnapped)
        d = self._description
        # There are none while the sensors have failed.
        for k, distance in enumerate(observation.proximity):
            self._put(
                f"/proximity/{k}", "sensor_msgs/msg/Range", stamp,
                header=making.header(stamp, f"proximity_{k}"), radiation_type=1, field_of_view=0.1,
                min_range=0.0, max_range=d.ranger_reach, range=float(distance), variance=0.0,
            )  # fmt: skip

        if stamp - self._flushed_ns >= FLUSH_S * 1e9:
            self._flush()
            self._flushed_ns = stamp

    def close(self) -> None:
        self._writer.close()

    def _flush(self) -> None:
        """Bring all to the disk as a file that is complete for readers; the next chunk replaces its end."""
        storage: Any = self._writer.storage
        storage.close_chunk()
        end = storage.bio.tell()
        storage.bio.write(MCAP_END)
        storage.bio.flush()
        os.fsync(storage.bio.fileno())
        storage.bio.seek(end)
        # rosbags writes the metadata, atomically, when it closes a bag: it closes a stand-in here.
        self._writer.storage = _KeptOpen(storage.path)  # type: ignore[assignment]
        try:
            self._writer.close()
        finally:
            self._writer.storage = storage

    def _put(self, topic: str, name: str, stamp_ns: int, **fields: Any) -> None:
        self._topics.send(topic, make(name, **fields), stamp_ns)

    def _ranger_mounts(self) -> list[Any]:
        """The proximity sensors, each at the robot's edge along its bearing."""
        d, mounts = self._description, []
        for k, bearing in enumerate(d.ranger_bearings):
            at = Pose2(d.radius * math.cos(bearing), d.radius * math.sin(bearing), bearing)
            mounts.append(making.transform(self.begun_ns, BASE, f"proximity_{k}", at))
        return mounts


class _KeptOpen:
    """Stands in for the storage of a bag that stays open."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def close(self, version: int, metadata: str) -> None:
        """Nothing: the storage itself is written on."""


def _transient_local() -> Qos:
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    default = QosTime(0, 0)
    return Qos(
        QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL,
        default, default, QosLiveliness.AUTOMATIC, default, False,
    )  # fmt: skip

"""Bags are written here with rosbags alone, field by field; what Mapweave writes is read by rosbags."""

from __future__ import annotations

import contextlib
import json
import math
import sqlite3
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from mapweave import Command, Observation, Odometry, Pose2, RobotDescription
from mapweave.agent.drivers.replay import Replay
from mapweave.agent.recordings import bag
from mapweave.agent.recordings.camera_info_check import doubts
from mapweave.agent.recordings.incomplete import Incomplete, NoOdometry
from mapweave.agent.recordings.mcap_writer import FLUSH_S, McapWriter
from mapweave.agent.recordings.opening import open_recording
from mapweave.agent.recordings.options import RecordingOptions, RecordingSettings
from mapweave.agent.ros_messages.values import Mount, camera_of
from mapweave.cli import main
from mapweave.exit_status import FAILED
from mapweave.hybridmap.errors import DeviceError
from mapweave.vision.lens import NO_DISTORTION
from tests.agent.recordings.conftest import BEGUN_NS, COUNT, STEP_NS, Drive, between
from tests.recordings import write_folder

STORE = get_typestore(Stores.ROS2_HUMBLE)
STORE1 = get_typestore(Stores.ROS1_NOETIC)
KIDNAP = "irobot_create_msgs/msg/KidnapStatus"
STORE.register(get_types_from_msg("std_msgs/Header header\nbool is_kidnapped", KIDNAP))
TF = "tf2_msgs/msg/TFMessage"
STORE1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))


def make(store: Any, name: str, **fields: Any) -> Any:
    return store.types[name](**fields)


def header(store: Any, stamp: int, frame: str) -> Any:
    time = make(store, "builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
    extra = {"seq": 0} if store is STORE1 else {}
    return make(store, "std_msgs/msg/Header", stamp=time, frame_id=frame, **extra)


def odometry(store: Any, stamp: int, pose: Pose2) -> Any:
    point = make(store, "geometry_msgs/msg/Point", x=pose.x, y=pose.y, z=0.0)
    half = pose.heading / 2
    turn = make(store, "geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sin(half), w=math.cos(half))
    zero = make(store, "geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    twist = make(store, "geometry_msgs/msg/Twist", linear=zero, angular=zero)
    where = make(store, "geometry_msgs/msg/Pose", position=point, orientation=turn)
    none = np.zeros(36)
    return make(
        store, "nav_msgs/msg/Odometry", header=header(store, stamp, "odom"), child_frame_id="base_link",
        pose=make(store, "geometry_msgs/msg/PoseWithCovariance", pose=where, covariance=none),
        twist=make(store, "geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=none),
    )  # fmt: skip


def camera_info(store: Any, stamp: int, drive: Drive) -> Any:
    c = drive.camera
    k = np.array([c.fx, 0, c.cx, 0, c.fy, c.cy, 0, 0, 1], np.float64)
    names = "DKRP" if store is STORE1 else "dkrp"
    values = (np.array([0.1, 0.0, 0.0, 0.0, 0.0]), k, np.eye(3).ravel(), np.zeros(12))
    region = make(
        store, "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
    )
    return make(
        store, "sensor_msgs/msg/CameraInfo", header=header(store, stamp, "camera"), height=c.height,
        width=c.width, distortion_model="plumb_bob", binning_x=0, binning_y=0, roi=region,
        **dict(zip(names, values, strict=True)),
    )  # fmt: skip


def image(store: Any, stamp: int, grey: np.ndarray, encoding: str) -> Any:
    """Rows are padded, as drivers with aligned memory send them."""
    colour = {"mono8": grey[:, :, None], "mono16": np.stack([np.full_like(grey, 7), grey], axis=2)}
    pixels = colour.get(encoding, np.repeat(grey[:, :, None], 4 if encoding.endswith("a8") else 3, axis=2))
    rows = pixels.reshape(len(grey), -1)
    padded = np.concatenate([rows, np.zeros((len(rows), 5), np.uint8)], axis=1)
    return make(
        store, "sensor_msgs/msg/Image", header=header(store, stamp, "camera"), height=grey.shape[0],
        width=grey.shape[1], encoding=encoding, is_bigendian=0, step=padded.shape[1], data=padded.ravel(),
    )  # fmt: skip


def write_bag(
    path: Path,
    drive: Drive,
    encoding: str = "mono8",
    ros1: bool = False,
    lifted: Mapping[float, bool] = MappingProxyType({}),
    **named: str,
) -> None:
    """Images at their stamps, odometry four times as often; both arrive late. `lifted` is by image."""
    store: Any = STORE1 if ros1 else STORE
    topics = {"image": "/cam/image_raw", "info": "/cam/camera_info", "odom": "/odom", **named}
    other = topics.pop("second", "")
    kinds = {
        "image": "sensor_msgs/msg/" + ("CompressedImage" if encoding in ("jpeg", "png") else "Image"),
        "info": "sensor_msgs/msg/CameraInfo", "odom": "nav_msgs/msg/Odometry",
    }  # fmt: skip
    plugin = StoragePlugin.SQLITE3 if encoding == "bgra8" else StoragePlugin.MCAP
    writer: Any = Writer1(path) if ros1 else Writer(path, version=8, storage_plugin=plugin)
    serialize: Callable[[Any, str], Any] = store.serialize_ros1 if ros1 else store.serialize_cdr
    with writer:
        opened = {key: writer.add_connection(topics[key], kinds[key], typestore=store) for key in topics}
        if other:
            opened["second"] = writer.add_connection(other, kinds["info"], typestore=store)
        for at, is_kidnapped in lifted.items():
            stamp = BEGUN_NS + round(at * STEP_NS)
            opened["kidnap"] = opened.get("kidnap") or writer.add_connection("/k", KIDNAP, typestore=store)
            message = make(store, KIDNAP, header=header(store, stamp, "base"), is_kidnapped=is_kidnapped)
            writer.write(opened["kidnap"], stamp, serialize(message, KIDNAP))
        fine = [Pose2(*row) for row in between(drive.poses, 4)]
        for k, pose in enumerate(fine):
            stamp = BEGUN_NS + k * STEP_NS // 4
            late = stamp + 30_000_000
            writer.write(opened["odom"], late, serialize(odometry(store, stamp, pose), kinds["odom"]))
            if k % 4:
                continue
            grey = drive.images[k // 4]
            if encoding in ("jpeg", "png"):
                data = cv2.imencode(f".{encoding}", grey)[1].ravel()
                head = header(store, stamp, "camera")
                message = make(store, kinds["image"], header=head, format=encoding, data=data)
            else:
                message = image(store, stamp, grey, encoding)
            writer.write(opened["image"], late, serialize(message, kinds["image"]))
            for name in opened.keys() & {"info", "second"}:
                info = camera_info(store, stamp, drive)
                writer.write(opened[name], late, serialize(info, kinds["info"]))


@pytest.mark.parametrize(
    ("encoding", "ros1"),
    [("mono8", False), ("rgb8", False), ("bgr8", False), ("bgra8", False), ("mono16", False), ("png", False),
     ("mono8", True)],
)  # fmt: skip
def test_a_bag_is_read_as_it_was(encoding: str, ros1: bool, drive: Drive, tmp_path):
    path = tmp_path / ("drive.bag" if ros1 else "drive")
    write_bag(path, drive, encoding, ros1)
    replay = Replay(path, options=RecordingOptions(camera_height=0.3))
    description = replay.describe()
    assert description.camera == drive.camera and description.distortion == (0.1, 0.0, 0.0, 0.0, 0.0)
    assert replay.recording.notes == ("images from /cam/image_raw", "odometry from /odom")
    seen = list(iter(replay.sense, None))
    assert [observation.stamp_ns for observation in seen] == drive.stamps_ns
    for observation, grey, (forward, turn) in zip(seen, drive.images, drive.increments, strict=True):
        assert np.array_equal(observation.image, grey)
        assert (observation.odometry.forward, observation.odometry.turn) == pytest.approx((forward, turn))


def test_a_bag_of_the_first_recorders_of_ros2_is_read(drive: Drive, tmp_path):
    """They wrote the types without /msg/: as a bag's folder, its file alone, and its file cut off."""
    write_bag(tmp_path / "bag", drive, "bgra8")
    (file,) = (tmp_path / "bag").glob("*.db3")
    metadata = tmp_path / "bag" / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("/msg/", "/"))
    with contextlib.closing(sqlite3.connect(file)) as database:
        database.execute("UPDATE topics SET type = replace(type, '/msg/', '/')")
        database.commit()
    cut = tmp_path / "cut.db3"
    cut.write_bytes(file.read_bytes()[: file.stat().st_size * 3 // 4])
    for path in (tmp_path / "bag", file, cut):
        recording = open_recording(path, RecordingOptions(camera_height=0.3))
        assert np.array_equal(recording.read(1), drive.images[1])
        assert recording.bag is not None
        assert {topic.kind for topic in recording.bag.topics} == {
            "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo", "nav_msgs/msg/Odometry"
        }  # fmt: skip


def test_a_single_mcap_file_is_read_without_its_folder(drive: Drive, tmp_path):
    write_bag(tmp_path / "drive", drive)
    (file,) = (tmp_path / "drive").glob("*.mcap")
    recording = open_recording(file, RecordingOptions(camera_height=0.3))
    assert len(recording) == COUNT


def test_a_bag_whose_own_types_lack_a_field_is_refused_in_one_line(drive: Drive, tmp_path):
    write_bag(tmp_path / "drive", drive)
    (file,) = (tmp_path / "drive").glob("*.mcap")
    data = file.read_bytes()
    for field, other in (
        (b"string child_frame_id", b"string child_frame_ix"),
        (b"uint32 width", b"string width"),
    ):
        assert field in data
        file.write_bytes(data.replace(field, other))
        name = field.decode().split()[1]
        with pytest.raises(DeviceError, match=f"in this bag, .* has no field {name} as ROS defines it"):
            open_recording(file, RecordingOptions(camera_height=0.3))


def test_topics_are_named_by_the_person_or_guessed(drive: Drive, tmp_path):
    write_bag(tmp_path / "drive", drive, odom="/ground_truth/odom")
    height = 0.3
    with pytest.raises(DeviceError, match=r"no odometry.*/ground_truth/odom \(nav_msgs/msg/Odometry\)"):
        open_recording(tmp_path / "drive", RecordingOptions(camera_height=height))
    given = RecordingOptions(camera_height=height, odometry_topic="/ground_truth/odom")
    assert len(open_recording(tmp_path / "drive", given)) == COUNT
    with pytest.raises(DeviceError, match=r"no topic /camera; it has .*/cam/image_raw"):
        open_recording(tmp_path / "drive", RecordingOptions(image_topic="/camera"))
    with pytest.raises(DeviceError, match=r"/cam/camera_info has 9 messages of .*CameraInfo; images"):
        open_recording(tmp_path / "drive", RecordingOptions(image_topic="/cam/camera_info"))


FORMATS = {"ros1": ("mono8", True), "mcap": ("png", False), "db3": ("bgra8", False)}
"""Encodings of which `write_bag` makes a bag of that format."""


@pytest.fixture(scope="session")
def whole_bags(drive: Drive, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The bytes of one bag of each format."""
    out = {}
    for name, (encoding, ros1) in FORMATS.items():
        path = tmp_path_factory.mktemp(name) / ("drive.bag" if ros1 else "drive")
        write_bag(path, drive, encoding, ros1)
        (file,) = [path] if ros1 else [p for p in path.iterdir() if p.suffix != ".yaml"]
        out[name] = file.read_bytes()
    return out


SUFFIX = {"ros1": ".bag", "mcap": ".mcap", "db3": ".db3"}
OPTIONS = RecordingOptions(camera_height=0.3)


def check_prefix(path: Path, drive: Drive) -> int:
    """How many images a damaged bag still has; all are the first ones, and the loss is said in one line."""
    try:
        replay = Replay(path, options=OPTIONS)
    except DeviceError as error:
        assert str(path) in str(error) and "\n" not in str(error)
        return 0
    seen = list(iter(replay.sense, None))
    assert [observation.stamp_ns for observation in seen] == drive.stamps_ns[: len(seen)]
    for observation, grey, (forward, turn) in zip(seen, drive.images, drive.increments, strict=False):
        assert np.array_equal(observation.image, grey)
        assert (observation.odometry.forward, observation.odometry.turn) == pytest.approx((forward, turn))
    assert replay.damage and all("\n" not in line for line in replay.damage)
    return len(seen)


def mcap_record(opcode: int, *parts: bytes | str | int) -> bytes:
    """By the specification of MCAP: strings have their length before them; numbers are uint16."""
    packed = [
        part if isinstance(part, bytes)
        else struct.pack("<H", part) if isinstance(part, int)
        else struct.pack("<I", len(part)) + part.encode()
        for part in parts
    ]  # fmt: skip
    content = b"".join(packed)
    return struct.pack("<BQ", opcode, len(content)) + content


def write_bare_mcap(path: Path, drive: Drive, profile: str) -> None:
    """As another recorder writes it, in two chunks, without index; the second has the last three images."""
    ros1 = profile == "ros1"
    store: Any = STORE1 if ros1 else STORE
    serialize = store.serialize_ros1 if ros1 else store.serialize_cdr
    kinds = ["sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo", "nav_msgs/msg/Odometry"]
    records = []
    for k, kind in enumerate(kinds):
        name = kind.replace("/msg", "") if ros1 else kind
        records.append(mcap_record(3, k + 1, name, "ros1msg" if ros1 else "ros2msg", ""))
        topic = ("/cam/image_raw", "/cam/camera_info", "/odom")[k]
        records.append(mcap_record(4, k, k + 1, topic, "ros1" if ros1 else "cdr", ""))
    for stamp, grey, pose in zip(drive.stamps_ns, drive.images, drive.poses, strict=True):
        made = (
            image(store, stamp, grey, "mono8"),
            camera_info(store, stamp, drive),
            odometry(store, stamp, pose),
        )
        for k, message in enumerate(made):
            head = struct.pack("<HIQQ", k, 0, stamp, stamp)
            records.append(mcap_record(5, head + bytes(serialize(message, kinds[k]))))
    chunks = []
    for part in (records[:-9], records[-9:]):
        data = b"".join(part)
        head = struct.pack("<QQQI", drive.stamps_ns[0], drive.stamps_ns[-1], len(data), zlib.crc32(data))
        chunks.append(mcap_record(6, head, "", struct.pack("<Q", len(data)) + data))
    end = mcap_record(15, bytes(4)) + mcap_record(2, bytes(20))
    magic = b"\x89MCAP0\r\n"
    path.write_bytes(magic + mcap_record(1, profile, "other") + b"".join(chunks) + end + magic)


@pytest.mark.parametrize("profile", ["ros1", ""])
def test_an_mcap_that_is_not_said_to_be_of_ros2_is_read(profile: str, drive: Drive, tmp_path):
    """Its messages of ROS 1 were no images, and one without a profile was called damaged."""
    path = tmp_path / "drive.mcap"
    write_bare_mcap(path, drive, profile)
    replay = Replay(path, options=OPTIONS)
    seen = list(iter(replay.sense, None))
    assert [observation.stamp_ns for observation in seen] == drive.stamps_ns
    assert all(np.array_equal(one.image, grey) for one, grey in zip(seen, drive.images, strict=True))
    assert not replay.damage
    data = path.read_bytes()
    at = len(data) * 5 // 6
    path.write_bytes(data[:at])
    assert COUNT - 3 <= check_prefix(path, drive) < COUNT, "the pose after the last image may be missing"
    assert "its end is missing" in open_recording(path, OPTIONS).damage[0]
    path.write_bytes(data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :])
    assert check_prefix(path, drive) == COUNT - 3, "the chunk's checksum is wrong"


@pytest.mark.parametrize("name", FORMATS)
@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0.0, 0.99))
def test_a_bag_cut_off_anywhere_is_used_up_to_there(
    name: str, share: float, whole_bags: dict[str, bytes], drive: Drive, tmp_path
):
    path = tmp_path / f"drive{SUFFIX[name]}"
    path.write_bytes(whole_bags[name][: int(share * len(whole_bags[name]))])
    check_prefix(path, drive)


@pytest.mark.parametrize("cut", range(0, 32768, 331))
def test_a_database_cut_off_in_its_list_of_topics_is_used_up_to_there(
    cut: int, whole_bags: dict[str, bytes], drive: Drive, tmp_path
):
    path = tmp_path / "drive.db3"
    path.write_bytes(whole_bags["db3"][:cut])
    check_prefix(path, drive)


@pytest.mark.parametrize("name", FORMATS)
def test_the_longer_a_cut_bag_is_the_more_images_it_has(
    name: str, whole_bags: dict[str, bytes], drive: Drive, tmp_path
):
    whole, counts = whole_bags[name], list[int]()
    for share in (0.02, 0.3, 0.6, 0.9):
        path = tmp_path / f"drive{SUFFIX[name]}"
        path.write_bytes(whole[: round(share * len(whole))])
        counts.append(check_prefix(path, drive))
    assert counts == sorted(counts) and counts[0] == 0
    assert counts[2] >= 0.5 * 0.6 * COUNT and counts[3] >= 0.6 * COUNT


def moved(store: Any, stamp: int, frames: tuple[str, str], pose: Pose2) -> Any:
    """A TransformStamped on the floor."""
    across = make(store, "geometry_msgs/msg/Vector3", x=pose.x, y=pose.y, z=0.0)
    z, w = math.sin(pose.heading / 2), math.cos(pose.heading / 2)
    turned = make(store, "geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=z, w=w)
    return make(
        store, "geometry_msgs/msg/TransformStamped", header=header(store, stamp, frames[0]),
        child_frame_id=frames[1],
        transform=make(store, "geometry_msgs/msg/Transform", translation=across, rotation=turned),
    )  # fmt: skip


@pytest.mark.parametrize("ros1", [False, True])
def test_a_base_that_tells_its_odometry_by_tf_alone(ros1: bool, drive: Drive, tmp_path):
    """What a localizer corrects, and where a second robot and a wheel are, is not its odometry."""
    path, store = tmp_path / ("drive.bag" if ros1 else "drive"), STORE1 if ros1 else STORE
    writer: Any = Writer1(path) if ros1 else Writer(path, version=8, storage_plugin=StoragePlugin.MCAP)
    serialize: Callable[[Any, str], Any] = store.serialize_ros1 if ros1 else store.serialize_cdr
    topics = {
        "/tf": TF,
        "/cam/image_raw": "sensor_msgs/msg/Image",
        "/cam/camera_info": "sensor_msgs/msg/CameraInfo",
    }
    with writer:
        opened = {name: writer.add_connection(name, kind, typestore=store) for name, kind in topics.items()}
        for k, (stamp, grey) in enumerate(zip(drive.stamps_ns, drive.images, strict=True)):
            transforms = [
                moved(store, stamp, ("map", "odom"), Pose2(k, 0.0, 0.0)),
                moved(store, stamp, ("/odom", "base_footprint"), drive.poses[k]),
                moved(store, stamp, ("base_link", "wheel"), Pose2(0.0, 0.1, k)),
            ] + [moved(store, stamp, ("r1/odom", "r1/base_link"), Pose2(0.0, k, 0.0))] * (k % 2)
            for name, message in (
                ("/tf", make(store, TF, transforms=transforms)),
                ("/cam/image_raw", image(store, stamp, grey, "mono8")),
                ("/cam/camera_info", camera_info(store, stamp, drive)),
            ):
                writer.write(opened[name], stamp + 30_000_000, serialize(message, topics[name]))
    replay = Replay(path, options=OPTIONS)
    assert replay.recording.notes == (
        "images from /cam/image_raw",
        "odometry from /tf, odom to base_footprint",
    )
    seen = list(iter(replay.sense, None))
    assert [observation.stamp_ns for observation in seen] == drive.stamps_ns
    for observation, (forward, turn) in zip(seen, drive.increments, strict=True):
        assert (observation.odometry.forward, observation.odometry.turn) == pytest.approx((forward, turn))


def test_a_cut_bag_of_ros1_still_says_where_the_camera_is(drive: Drive, tmp_path):
    """Without its index it is read by ROS 1's standard types, of which rosbags lacks that of tf."""
    path = tmp_path / "drive.bag"
    across = make(STORE1, "geometry_msgs/msg/Vector3", x=0.1, y=0.0, z=0.3)
    ahead = make(STORE1, "geometry_msgs/msg/Quaternion", x=-0.5, y=0.5, z=-0.5, w=0.5)
    held = make(
        STORE1, "geometry_msgs/msg/TransformStamped", header=header(STORE1, BEGUN_NS, "base_link"),
        child_frame_id="camera",
        transform=make(STORE1, "geometry_msgs/msg/Transform", translation=across, rotation=ahead),
    )  # fmt: skip
    images = [image(STORE1, *each, "mono8") for each in zip(drive.stamps_ns, drive.images, strict=True)]
    with Writer1(path) as writer:
        for topic, kind, messages in (
            ("/tf_static", TF, [make(STORE1, TF, transforms=[held])]),
            ("/cam/camera_info", "sensor_msgs/msg/CameraInfo", [camera_info(STORE1, BEGUN_NS, drive)]),
            ("/cam/image_raw", "sensor_msgs/msg/Image", images),
        ):
            opened = writer.add_connection(topic, kind, typestore=STORE1)
            for message in messages:
                writer.write(opened, BEGUN_NS, STORE1.serialize_ros1(message, kind))
    path.write_bytes(path.read_bytes()[:-600])
    with pytest.raises(NoOdometry) as found:
        open_recording(path)
    camera = found.value.recording.camera
    assert (camera.mount_height, camera.mount_forward) == pytest.approx((0.3, 0.1))


def test_poses_that_go_back_in_time_are_left_out_and_said(drive: Drive, tmp_path, monkeypatch):
    write_bag(tmp_path / "drive", drive)
    messages = bag.Bag.messages

    def again(self: bag.Bag, topic: str) -> Iterator[tuple[int, Any]]:
        found = list(messages(self, topic))
        return iter([*found[:4], *found[2:]] if topic == "/odom" else found)

    monkeypatch.setattr(bag.Bag, "messages", again)
    recording = open_recording(tmp_path / "drive", OPTIONS)
    assert "2 poses of /odom go back in time or repeat a stamp: left out" in recording.notes
    assert recording.increments == pytest.approx(drive.increments)


@pytest.mark.parametrize("late", [0, 5])
def test_images_that_go_back_in_time_are_left_out_and_said(late: int, drive: Drive, tmp_path, monkeypatch):
    """The whole bag was refused for one of them. The first of a simulator may have no stamp at all."""
    write_bag(tmp_path / "drive", drive)
    messages = bag.Bag.messages

    def spoilt(self: bag.Bag, topic: str) -> Iterator[tuple[int, Any]]:
        for k, (stamp, message) in enumerate(messages(self, topic)):
            if topic == "/cam/image_raw" and k == late:
                message.header.stamp.sec, message.header.stamp.nanosec = 0, 0
                if late:
                    message.header.stamp.sec = 1
                yield (10**9 if late else stamp + 10**15), message
            else:
                yield stamp, message

    monkeypatch.setattr(bag.Bag, "messages", spoilt)
    replay = Replay(tmp_path / "drive", options=OPTIONS)
    why = "goes back in time or repeats a stamp" if late else "has no stamp"
    assert f"1 image of /cam/image_raw {why}: left out" in replay.recording.notes
    left = [k for k in range(COUNT) if k != late]
    for k, observation in zip(left, iter(replay.sense, None), strict=True):
        assert observation.stamp_ns == drive.stamps_ns[k]
        assert np.array_equal(observation.image, drive.images[k])
    # The way across it is kept.
    assert replay.recording.increments[1:].sum(axis=0) == pytest.approx(
        drive.increments[left[0] + 1 :].sum(axis=0), abs=1e-4
    )


def test_a_clock_that_begins_at_zero_loses_no_message(drive: Drive, tmp_path):
    """As a robot's own recordings of a simulation or of a replay have it."""
    writer = McapWriter(tmp_path / "drive", RobotDescription(drive.camera), True, lambda line: None)
    for k, (grey, (forward, turn)) in enumerate(zip(drive.images, drive.increments, strict=True)):
        writer.write(Observation(k * STEP_NS, Odometry(forward, turn), grey), Command())
    writer.close()
    replay = Replay(tmp_path / "drive")
    assert not any("left out" in note for note in replay.recording.notes)
    assert [o.stamp_ns for o in iter(replay.sense, None)] == [k * STEP_NS for k in range(COUNT)]


def test_images_of_distances_are_not_taken_where_there_are_others(drive: Drive, tmp_path):
    opened = SimpleNamespace(
        path=tmp_path,
        topics=[
            bag.BagTopic("/camera/aligned_depth_to_color/image_raw", bag.IMAGE_TYPES[1], 90),
            bag.BagTopic("/camera/color/image_raw", bag.IMAGE_TYPES[1], 80),
        ],
    )
    assert bag._chosen(opened, None, bag.IMAGE_TYPES, "images").name == "/camera/color/image_raw"
    del opened.topics[1]
    assert "depth" in bag._chosen(opened, None, bag.IMAGE_TYPES, "images").name


def test_odometry_without_orientation_is_refused(drive: Drive, tmp_path, monkeypatch):
    """Its heading was taken for 0 all the way, and the map was wrong."""
    write_bag(tmp_path / "drive", drive)
    messages = bag.Bag.messages

    def empty(self: bag.Bag, topic: str) -> Iterator[tuple[int, Any]]:
        for stamp, message in messages(self, topic):
            if topic == "/odom":
                message.pose.pose.orientation.z = message.pose.pose.orientation.w = 0.0
            yield stamp, message

    monkeypatch.setattr(bag.Bag, "messages", empty)
    with pytest.raises(DeviceError, match="pose 0 of /odom has no orientation"):
        open_recording(tmp_path / "drive", OPTIONS)


def test_a_pose_that_is_no_number_ends_the_odometry(drive: Drive, tmp_path):
    spoiled = [*drive.poses[:6], *(Pose2(0.0, 0.0, 0.0) for _ in drive.poses[6:])]
    object.__setattr__(spoiled[6], "x", math.nan)
    write_bag(tmp_path / "drive", replace(drive, poses=spoiled))
    replay = Replay(tmp_path / "drive", options=OPTIONS)
    assert [o.stamp_ns for o in iter(replay.sense, None)] == drive.stamps_ns[:5]
    (line,) = replay.damage
    assert "of /odom is not finite; what comes before is used" in line


def test_what_is_damaged_of_odometry_beside_a_bag_is_said(drive: Drive, poses_file: Path, tmp_path):
    write_bag(tmp_path / "drive", drive)
    lines = poses_file.read_text().splitlines()
    poses_file.write_text("\n".join([*lines[:20], "no pose", ""]))
    recording = open_recording(tmp_path / "drive", replace(OPTIONS, odometry=poses_file))
    (line,) = recording.damage
    assert line.startswith(f"{poses_file}: line 21: a pose is") and line.endswith("before it are used")


def test_all_of_a_killed_recorder_but_the_last_seconds_is_there(drive: Drive, tmp_path):
    """A process records ten observations a second of its own clock; it is killed within a minute."""
    program = (
        "import sys\n"
        "from pathlib import Path\n"
        "import numpy as np\n"
        "from mapweave.agent.observation import Command, Observation, Odometry, RobotDescription\n"
        "from mapweave.agent.recordings.mcap_writer import McapWriter\n"
        "from mapweave.hybridmap.camera import Camera\n"
        "camera = Camera(32, 24, 30.0, 30.0, 15.5, 11.5, mount_height=0.3)\n"
        "writer = McapWriter(Path(sys.argv[1]), RobotDescription(camera=camera))\n"
        "for k in range(95):\n"
        f"    at, image = {BEGUN_NS} + k * 100_000_000, np.full((24, 32), k, np.uint8)\n"
        "    writer.write(Observation(at, Odometry(0.02, 0.0), image), Command())\n"
        "while writer.written < 95:\n"
        "    pass\n"
        "print('recorded', flush=True)\n"
        "sys.stdin.read()\n"
    )
    folder = tmp_path / "walk"
    command = [sys.executable, "-c", program, str(folder)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdout.readline() == "recorded\n"
        process.kill()
    replay = Replay(folder)
    stamps = [observation.stamp_ns for observation in iter(replay.sense, None)]
    assert stamps == [BEGUN_NS + k * 100_000_000 for k in range(len(stamps))]
    assert 95 - len(stamps) <= 10 * FLUSH_S and not replay.damage
    # The folder is a bag for other programs as well: its metadata was written with the messages.
    with AnyReader([folder / "walk_0"]) as reader:
        assert {c.topic: c.msgcount for c in reader.connections}["/odom"] == len(stamps)
        assert sum(1 for _ in reader.messages()) == reader.message_count


def test_a_robot_that_is_lifted_between_two_images_was_lifted_at_the_second(drive: Drive, tmp_path):
    """A base says so by a clock of its own, in a bag without definitions of messages."""
    said = {0.0: False, 2.4: True, 2.6: False, 5.5: True, 6.5: True, 7.5: False}
    write_bag(tmp_path / "drive", drive, "bgra8", lifted=said)
    seen = list(iter(Replay(tmp_path / "drive", options=RecordingOptions(camera_height=0.3)).sense, None))
    assert [k for k, observation in enumerate(seen) if observation.kidnapped] == [3, 6, 7]


def test_a_camera_topic_that_lost_its_messages_is_reported_in_one_line():
    """Its count says that there are some; found by fuzzing."""
    topic = bag.BagTopic("/camera/camera_info", bag.CAMERA_TYPE, 3)
    opened = SimpleNamespace(path="walk.mcap", topics=[topic], damage=[], messages=lambda name: iter(()))
    with pytest.raises(DeviceError, match="camera_info has no message"):
        bag._camera(opened, "/camera/image", RecordingOptions(), [])


def test_the_topic_of_the_camera_may_be_given(drive: Drive, tmp_path):
    write_bag(tmp_path / "drive", drive, info="/elsewhere/info", second="/other/info")
    given = replace(OPTIONS, camera_info_topic="/elsewhere/info")
    assert open_recording(tmp_path / "drive", given).camera == drive.camera
    with pytest.raises(DeviceError, match="no topic /none; it has"):
        open_recording(tmp_path / "drive", replace(OPTIONS, camera_info_topic="/none"))


def test_the_settings_name_the_topics_and_the_command_line_overrides_them(drive: Drive, tmp_path, capfd):
    """There were options alone: they had to be given with every command."""
    path = tmp_path / "drive"
    write_bag(path, drive, info="/elsewhere/info", second="/other/info", odom="/amcl/odom")
    file = tmp_path / "robot.toml"
    file.write_text(
        '[recording]\nodometry_topic = "/amcl/odom"\ncamera_info_topic = "/elsewhere/info"\n'
        'image_topic = "/cam/image_raw"\n'
    )
    command = ["info", str(path), "--camera-height", "0.3", "--json"]
    assert main(command) == 0
    guessed = json.loads(capfd.readouterr().out)
    assert guessed["focal_px"] is None and guessed["missing"], "two cameras, and no odometry"
    assert main([*command, "--settings", str(file)]) == 0
    facts = json.loads(capfd.readouterr().out)
    assert not facts["missing"] and facts["focal_px"] == drive.camera.fx and facts["driven_m"] > 0.0
    assert facts["notes"][:2] == ["images from /cam/image_raw", "odometry from /amcl/odom"]
    assert main([*command, "--settings", str(file), "--odometry-topic", "/none"]) == FAILED
    assert "no topic /none; it has" in capfd.readouterr().err
    replayed = ["replay", str(path), "--camera-height", "0.3", "--offline", "--data", str(tmp_path / "maps")]
    assert main([*replayed, "--settings", str(file)]) == 0
    assert "odometry from /amcl/odom" in capfd.readouterr().out


def test_a_recording_without_topics_does_without_those_of_the_settings(drive: Drive, tmp_path):
    folder = write_folder(tmp_path / "walk", drive.images, drive.increments)
    options = RecordingOptions(settings=RecordingSettings(image_topic="/cam/image_raw"))
    assert len(open_recording(folder, options)) == COUNT


def test_what_a_bag_lacks_is_said_with_what_is_in_it(drive: Drive, tmp_path):
    write_bag(tmp_path / "drive", drive, odom="/ground_truth/odom")
    with pytest.raises(Incomplete, match="--camera-height METRES") as caught:
        open_recording(tmp_path / "drive")
    found = caught.value
    assert found.recording is not None and len(found.recording) == COUNT and not found.odometry
    assert found.bag is not None and found.bag.seconds == pytest.approx((COUNT - 1) * STEP_NS * 1e-9)
    counts = {topic.name: topic.count for topic in found.bag.topics}
    assert counts == {"/cam/image_raw": COUNT, "/cam/camera_info": COUNT, "/ground_truth/odom": 4 * COUNT - 3}


def test_three_coefficients_of_distortion_are_named(drive: Drive, tmp_path, monkeypatch):
    """The third was taken for p1, without a word."""
    made = camera_info
    lens = np.array([0.1, 0.02, 0.001])
    monkeypatch.setitem(globals(), "camera_info", lambda *given: replace(made(*given), d=lens))
    write_bag(tmp_path / "drive", drive)
    recording = open_recording(tmp_path / "drive", RecordingOptions(camera_height=0.3))
    assert any("3 coefficients of distortion" in note for note in recording.notes)


@pytest.mark.parametrize(("topic", "matrix"), [("/cam/image_raw", "K"), ("/cam/image_rect", "P")])
def test_a_camera_that_is_not_calibrated_is_asked_for(
    topic: str, matrix: str, drive: Drive, tmp_path, monkeypatch
):
    """Its driver leaves zeros: focal lengths had to be positive, and nothing was said of what is there."""
    made, zeros = camera_info, np.zeros(9 if matrix == "K" else 12)
    monkeypatch.setitem(
        globals(), "camera_info", lambda *given: replace(made(*given), **{matrix.lower(): zeros})
    )
    write_bag(tmp_path / "drive", drive, image=topic)
    with pytest.raises(Incomplete, match=f"its {matrix} is zero; give --camera FILE") as caught:
        open_recording(tmp_path / "drive", OPTIONS)
    assert caught.value.recording is not None and len(caught.value.recording) == COUNT


@pytest.mark.parametrize("ros1", [False, True])
def test_images_without_distortion_are_not_rectified_again(ros1: bool, drive: Drive, tmp_path, monkeypatch):
    """Beside them a CameraInfo still tells K and D of the images before, and theirs is P (REP 104)."""
    made, p = camera_info, np.array([300.0, 0.0, 150.0, 0.0, 0.0, 310.0, 110.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    monkeypatch.setitem(
        globals(), "camera_info", lambda *given: replace(made(*given), **{"P" if ros1 else "p": p})
    )
    path = tmp_path / ("drive.bag" if ros1 else "drive")
    write_bag(path, drive, ros1=ros1, image="/cam/image_rect_color")
    recording = open_recording(path, RecordingOptions(camera_height=0.3))
    camera = recording.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (300.0, 310.0, 150.0, 110.0)
    assert recording.distortion == NO_DISTORTION


@pytest.mark.parametrize(
    ("mount", "words"),
    [
        (Mount(0.1, 0.04, 0.3, 0.04, -0.04), ""),
        (Mount(0.1, 0.2, 0.3, 0.0), "0.20 m to the left"),
        (Mount(0.1, 0.0, 0.3, 0.3), "17 deg to the left"),
        (Mount(0.1, 0.0, 0.3, 0.0, 0.3), "17 deg down by tf"),
        (Mount(0.1, 0.0, 0.3, 0.0, -0.3), "17 deg up by tf"),
        (None, ""),
    ],
)
def test_a_camera_that_does_not_look_ahead_is_named(mount: Mount | None, words: str):
    lines = doubts(SimpleNamespace(d=[0.0] * 3), mount)
    assert len(lines) == bool(words) and words in "".join(lines)


def test_a_lens_of_eight_coefficients_is_refused_with_what_to_do(drive: Drive):
    message = camera_info(STORE, BEGUN_NS, drive)
    message.d, message.distortion_model = np.full(8, 0.1), "rational_polynomial"
    with pytest.raises(
        DeviceError, match="of 8 coefficients is not supported; measure five: mapweave calibrate"
    ):
        camera_of(message)

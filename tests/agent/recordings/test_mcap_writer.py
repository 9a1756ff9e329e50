"""What a robot records: replayed as it sensed it, and read by rosbags as standard messages."""

import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from mapweave import Camera, Command, MapId, Observation, Odometry, Pose2, RobotDescription
from mapweave.agent.drivers.checked import CheckedRobot
from mapweave.agent.drivers.recorded import RecordedRobot
from mapweave.agent.drivers.replay import Replay
from mapweave.agent.mission import Carried
from mapweave.agent.pipeline import Pipeline
from mapweave.agent.recordings.mcap_writer import PART_S, McapWriter
from mapweave.agent.recordings.options import RecordingOptions
from mapweave.agent.ros_messages import making
from mapweave.hybridmap.errors import DeviceError, InvalidValue
from mapweave.vision.equidistant import Equidistant
from mapweave.vision.image_reduction import MOST_PIXELS
from mapweave.vision.lens import NO_DISTORTION, Distortion, Lens
from tests.agent.conftest import DESCRIPTION, PhotoWalls
from tests.agent.recordings.conftest import BEGUN_NS, COUNT, Drive

LIFTED = (3, 4, 8)
"""Images at which the robot below is lifted."""


class Driven:
    """A robot that senses a drive, and is lifted on it."""

    def __init__(self, drive: Drive, lens: Distortion = (-0.1, 0.02, 0.001, 0.0, 0.0)) -> None:
        self._drive, self._lens, self._at, self.closed = drive, lens, 0, False

    def describe(self) -> RobotDescription:
        return RobotDescription(
            camera=self._drive.camera, distortion=self._lens, ranger_bearings=(0.0, 0.5), ranger_reach=2.0
        )

    def sense(self) -> Observation | None:
        k, self._at = self._at, self._at + 1
        if k == COUNT:
            return None
        forward, turn = self._drive.increments[k]
        return Observation(
            self._drive.stamps_ns[k], Odometry(forward, turn), self._drive.images[k], np.array([1.0, 2.0]),
            kidnapped=k in LIFTED,
        )  # fmt: skip

    def act(self, command: Command) -> Command:
        return Command(min(command.forward, 0.3), command.turn)

    def close(self) -> None:
        self.closed = True


def record(drive: Drive, folder: Path, lossless: bool = True, *lens: Distortion) -> Driven:
    robot = Driven(drive, *lens)
    recorded = RecordedRobot(robot, folder, lossless)
    recorded.describe()
    while recorded.sense() is not None:
        assert recorded.act(Command(0.5, 0.1)) == Command(0.3, 0.1)
    recorded.close()
    return robot


def test_what_a_robot_recorded_is_replayed_as_it_sensed_it(drive: Drive, tmp_path):
    robot = record(drive, tmp_path / "walk")
    assert robot.closed
    replay = Replay(tmp_path / "walk")
    assert replay.describe().camera == drive.camera
    assert replay.describe().distortion == robot.describe().distortion
    seen = list(iter(replay.sense, None))
    assert [observation.stamp_ns for observation in seen] == drive.stamps_ns
    assert [k for k, observation in enumerate(seen) if observation.kidnapped] == [*LIFTED]
    assert "the robot was lifted 2 times" in replay.recording.notes
    for observation, grey, increment in zip(seen, drive.images, drive.increments, strict=True):
        assert np.array_equal(observation.image, grey)
        assert (observation.odometry.forward, observation.odometry.turn) == pytest.approx(
            tuple(increment), abs=1e-9
        )


def carried(description: RobotDescription, seen: list[Observation]) -> dict[int, Pose2]:
    """The map that is made on the way, by the stamps of its nodes."""
    pipeline = Pipeline(MapId("r0", 1), description)
    pipeline.set_mission(Carried())
    for one in seen:
        pipeline.step(one)
    pipeline.finish()
    return {node.stamp_ns: node.map_from_robot.mean for node in pipeline.map.nodes.values()}


def on_a_curve(walls: PhotoWalls) -> list[Observation]:
    """As long as the walls are in view, with noise of wheels."""
    rng, pose, seen = np.random.default_rng(1), Pose2(), list[Observation]()
    for k in range(90):
        turn = 0.05 * math.sin(0.1 * k)
        step = Odometry(0.03, turn).motion()
        pose = pose @ step
        measured = Odometry(0.03 * rng.normal(1.0, 0.05), turn + rng.normal(0.0, 0.005))
        seen.append(Observation(1 + k * 100_000_000, measured, walls.render(pose)))
    return seen


@pytest.mark.slow
def test_a_lossless_recording_is_replayed_to_the_very_same_map(walls: PhotoWalls, tmp_path):
    """Axle and noise of the wheels were guessed: other nodes were made, some centimetres off."""
    robot = replace(DESCRIPTION, axle=0.35, wheel_noise=0.06, side_slip=0.01)
    seen = on_a_curve(walls)
    writer = McapWriter(tmp_path / "walk", robot, lossless=True)
    for one in seen:
        while writer.written < one.stamp_ns // 100_000_000 - 50:
            time.sleep(0.01)
        writer.write(one, Command())
    writer.close()
    replay = Replay(tmp_path / "walk")
    described = replay.describe()
    assert (described.axle, described.wheel_noise, described.side_slip) == (0.35, 0.06, 0.01)
    made, replayed = carried(robot, seen), carried(described, list(iter(replay.sense, None)))
    assert len(made) >= 6 and replayed.keys() == made.keys()
    for stamp, pose in made.items():
        assert replayed[stamp].vector == pytest.approx(pose.vector, abs=1e-6)


@pytest.mark.parametrize(("given", "line"), [
    ("'-3.0'", "gives what no wheels can have: mapweave.axle_m '-3.0'"),
    ("wide", "gives what no wheels can have: mapweave.axle_m 'wide'"),
    (".nan", "gives what no wheels can have: mapweave.axle_m nan"),
    (None, "lacks mapweave.axle_m"),
])  # fmt: skip
def test_wheels_of_the_metadata_that_cannot_be_right_are_named(
    drive: Drive, given: str | None, line: str, tmp_path
):
    record(drive, tmp_path / "walk")
    metadata = tmp_path / "walk" / "walk_0" / "metadata.yaml"
    lines = metadata.read_text().splitlines()
    (at,) = (k for k, text in enumerate(lines) if "mapweave.axle_m" in text)
    lines[at : at + 1] = [] if given is None else [f"    mapweave.axle_m: {given}"]
    metadata.write_text("\n".join(lines))
    replay = Replay(tmp_path / "walk")
    assert len(replay) == COUNT and replay.describe().wheel_noise == RobotDescription.wheel_noise
    (damage,) = replay.damage
    assert line in damage


def test_failed_proximity_sensors_do_not_end_a_recording(drive: Drive, tmp_path):
    """A driver gives no readings then, see `mapweave.agent.drivers.checked`."""

    class Blind(Driven):
        def sense(self) -> Observation | None:
            seen = super().sense()
            failed = seen is not None and seen.stamp_ns in drive.stamps_ns[2:5]
            return replace(seen, proximity=np.zeros(0)) if seen is not None and failed else seen

    robot, lines = Blind(drive), list[str]()
    recorded = RecordedRobot(robot, tmp_path / "walk", False, lines.append)
    recorded.describe()
    while recorded.sense() is not None:
        recorded.act(Command())
    recorded.close()
    assert lines == [] and recorded.written == COUNT
    with AnyReader([tmp_path / "walk" / "walk_0"]) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
    assert counts["/odom"] == COUNT and counts["/proximity/0"] == counts["/proximity/1"] == COUNT - 3


def test_a_fisheyes_recording_names_its_lens_as_ros_does(drive: Drive, tmp_path):
    fisheye = Equidistant(115.0, 115.5, 158.7, 120.9, (-0.02, 0.004, -0.003, 0.0005))
    ideal = fisheye.ideal(320, 240, drive.camera.mount_height)
    record(replace(drive, camera=ideal), tmp_path / "walk", True, fisheye)
    with AnyReader([tmp_path / "walk" / "walk_0"]) as reader:
        (topic,) = (c for c in reader.connections if c.topic.endswith("camera_info"))
        _, _, data = next(reader.messages([topic]))
        message: Any = reader.deserialize(data, topic.msgtype)
    assert message.distortion_model == "equidistant"
    assert message.k.tolist() == [115.0, 0, 158.7, 0, 115.5, 120.9, 0, 0, 1]
    assert tuple(message.d) == fisheye.k
    described = Replay(tmp_path / "walk").describe()
    assert (described.camera, described.distortion) == (ideal, NO_DISTORTION)


def test_a_recording_holds_standard_messages(drive: Drive, tmp_path):
    """Read by rosbags with the definitions in the file itself."""
    record(drive, tmp_path / "walk", lossless=False)
    with AnyReader([tmp_path / "walk" / "walk_0"]) as reader:
        kinds = {c.topic: (c.msgtype, c.msgcount) for c in reader.connections}
        assert kinds == {
            "/tf_static": ("tf2_msgs/msg/TFMessage", 1),
            "/camera/image/compressed": ("sensor_msgs/msg/CompressedImage", COUNT),
            "/camera/camera_info": ("sensor_msgs/msg/CameraInfo", COUNT),
            "/odom": ("nav_msgs/msg/Odometry", COUNT),
            "/tf": ("tf2_msgs/msg/TFMessage", COUNT),
            "/cmd_vel": ("geometry_msgs/msg/TwistStamped", COUNT),
            "/kidnap_status": ("irobot_create_msgs/msg/KidnapStatus", 4),
            "/proximity/0": ("sensor_msgs/msg/Range", COUNT),
            "/proximity/1": ("sensor_msgs/msg/Range", COUNT),
        }
        for connection, stamp, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            if connection.topic == "/cmd_vel":
                assert message.twist.linear.x == (0.0 if stamp == BEGUN_NS else 0.3)
            if connection.topic == "/tf_static":
                mount, ahead, left = message.transforms
                assert mount.transform.translation.z == 0.3 and mount.header.frame_id == "base_footprint"
                assert [ahead.child_frame_id, left.child_frame_id] == ["proximity_0", "proximity_1"]
                at, turn = left.transform.translation, left.transform.rotation
                assert (at.x, at.y) == pytest.approx((0.16 * np.cos(0.5), 0.16 * np.sin(0.5)))
                assert (turn.z, turn.w) == pytest.approx((np.sin(0.25), np.cos(0.25)))
            if connection.topic == "/tf":
                (moved,) = message.transforms
                assert (moved.header.frame_id, moved.child_frame_id) == ("odom", "base_footprint")
        kept = {c.topic for c in reader.connections if c.ext.offered_qos_profiles}  # type: ignore[union-attr]
        assert kept == {"/tf_static", "/kidnap_status"}
        (profile,) = next(c for c in reader.connections if c.topic == "/tf_static").ext.offered_qos_profiles  # type: ignore[union-attr]
        assert profile.durability.name == "TRANSIENT_LOCAL" and profile.reliability.name == "RELIABLE"


def test_a_long_recording_is_a_row_of_files(drive: Drive, tmp_path):
    gap = round((PART_S + 1.0) * 1e9 / 4)
    slow = Drive(drive.images, [BEGUN_NS + k * gap for k in range(COUNT)], drive.poses, drive.camera)
    record(slow, tmp_path / "walk")
    assert sorted(p.name for p in (tmp_path / "walk").iterdir()) == ["walk_0", "walk_1", "walk_2"]
    assert [o.stamp_ns for o in iter(Replay(tmp_path / "walk").sense, None)] == slow.stamps_ns
    # The last folder of a robot whose battery failed has no index.
    (tmp_path / "walk" / "walk_2" / "metadata.yaml").unlink()
    assert len(Replay(tmp_path / "walk")) == COUNT
    file = tmp_path / "walk" / "walk_2" / "walk_2.mcap"
    file.write_bytes(file.read_bytes()[:-100])
    replay = Replay(tmp_path / "walk")
    assert len(replay) == COUNT and "walk_2.mcap: damaged or cut off" in replay.damage[0]
    assert [k for k, seen in enumerate(iter(replay.sense, None)) if seen.kidnapped] == [*LIFTED]
    file.write_bytes(b"")
    assert len(Replay(tmp_path / "walk")) == 8


def test_a_recording_overwrites_nothing(drive: Drive, tmp_path):
    (tmp_path / "walk").mkdir()
    (tmp_path / "walk" / "notes.txt").write_text("mine")
    with pytest.raises(DeviceError, match="not empty; a recording overwrites nothing"):
        RecordedRobot(Driven(drive), tmp_path / "walk")


def test_what_cannot_be_written_ends_the_recording_with_one_line(drive: Drive, tmp_path):
    """No number in the place of a reading. What came before is kept, and the robot goes on."""
    lines: list[str] = []
    robot = Driven(drive)
    recorded = RecordedRobot(robot, tmp_path / "walk", print_line=lines.append)
    recorded.describe()
    whole = robot.sense

    def sense() -> Observation | None:
        observation = whole()
        if observation is None or observation.stamp_ns <= drive.stamps_ns[4]:
            return observation
        return replace(observation, proximity=np.array([None, 1.0]))

    robot.sense = sense  # type: ignore[method-assign]
    assert len(list(iter(recorded.sense, None))) == COUNT
    recorded.close()
    (line,) = lines
    assert line.startswith(f"{tmp_path / 'walk'}: the recording ends here, ") and "\n" not in line
    assert len(Replay(tmp_path / "walk")) >= 5


@pytest.mark.parametrize(("height", "pitch", "line"), [
    (0.3, 0.6, "34 deg down by tf"), (0.3, -0.2, "11 deg up by tf"), (0.0, 0.0, ""), (-0.3, 0.0, ""),
])  # fmt: skip
def test_a_mount_that_cannot_be_right_or_is_not_level_is_named(
    drive: Drive, height: float, pitch: float, line: str, tmp_path, monkeypatch
):
    """A camera at the floor or below it was a traceback; one that looks down was mapped as if level."""
    mount = making.mount

    def mounted(*of: Any) -> Any:
        made = mount(*of)
        turn = made.transform.rotation
        # About the camera's x axis, to the right.
        x, w = -math.sin(pitch / 2), math.cos(pitch / 2)
        q = turn.x, turn.y, turn.z, turn.w
        turn.x, turn.y = q[3] * x + q[0] * w, q[1] * w + q[2] * x
        turn.z, turn.w = q[2] * w - q[1] * x, q[3] * w - q[0] * x
        made.transform.translation.z = height
        return made

    monkeypatch.setattr(making, "mount", mounted)
    record(drive, tmp_path / "walk")
    if height > 0.0:
        notes = Replay(tmp_path / "walk").recording.notes
        assert [line in note for note in notes].count(True) == 1
        return
    with pytest.raises(DeviceError, match="does not say how high the camera is; give --camera-height"):
        Replay(tmp_path / "walk")
    assert len(Replay(tmp_path / "walk", options=RecordingOptions(camera_height=0.3))) == COUNT


def test_a_robot_whose_camera_is_at_the_floor_is_refused_in_one_line():
    camera = replace(DESCRIPTION.camera, mount_height=0.0)
    with pytest.raises(InvalidValue, match=r"^camera: height_m is 0; a robot needs its height"):
        Pipeline(MapId("r0", 1), replace(DESCRIPTION, camera=camera))


class Large:
    """A robot with a camera of more pixels than agents work on."""

    def __init__(self, lens: Distortion) -> None:
        self._at, noise = 0, np.random.default_rng(5).integers(0, 255, (3, 30, 40), np.uint8)
        self.images = [cv2.resize(one, (1280, 960), interpolation=cv2.INTER_CUBIC) for one in noise]
        camera = Camera(1280, 960, 700.0, 702.0, 641.0, 478.0, mount_height=0.3)
        self._lens = lens
        if isinstance(lens, Equidistant):
            camera = lens.ideal(1280, 960, 0.3)
        self.description = RobotDescription(camera, lens, max_forward=0.3, max_turn=1.0)

    def describe(self) -> RobotDescription:
        return self.description

    def sense(self) -> Observation | None:
        if self._at == len(self.images):
            return None
        self._at += 1
        return Observation(BEGUN_NS + self._at * 10**8, Odometry(0.01, 0.0), self.images[self._at - 1])

    def act(self, command: Command) -> Command:
        return command

    def close(self) -> None:
        pass


@pytest.mark.parametrize(
    "lens", [(-0.1, 0.02, 0.001, 0.0, 0.0), Equidistant(500.0, 501.0, 640.5, 481.0, (-0.02, 0.0, 0.0, 0.0))]
)
def test_a_large_camera_is_replayed_as_the_robot_has_worked_on_it(lens: Distortion, tmp_path):
    """Robots were not reduced and recordings were: a replay could not give the robot's map."""
    robot = CheckedRobot(Large(lens))
    recorded = RecordedRobot(robot, tmp_path / "walk", lossless=True)
    described = recorded.describe()
    assert described.camera.width * described.camera.height <= MOST_PIXELS
    seen = list(iter(recorded.sense, None))
    recorded.close()
    assert len(seen) == 3
    replay = Replay(tmp_path / "walk")
    assert replay.describe().camera == described.camera
    lens_there = Lens(described.camera, described.distortion)
    for there in seen:
        here = replay.sense()
        assert here is not None and here.image is not None and there.image is not None
        assert there.image.shape == (described.camera.height, described.camera.width)
        # A recording's fisheye is rectified when it is read, a robot's where features are sought.
        assert np.array_equal(here.image, lens_there.rectified(there.image))

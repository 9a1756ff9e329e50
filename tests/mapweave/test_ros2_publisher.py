"""What an agent publishes for rviz and Nav2, read by a second implementation of the wire format."""

import argparse
import math
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from mapweave import MissionKind, NodeId, Pose2
from mapweave.agent.drivers.checked import CheckedRobot
from mapweave.agent.mission import Carried
from mapweave.commands.agent import open_robot, ros2_link
from mapweave.processes import ros2_publisher
from mapweave.processes.agent import AgentOptions
from mapweave.processes.agent_process import run_agent
from mapweave.processes.ros2_publisher import Ros2Publisher
from mapweave.settings import load_settings
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.pose_messages import MergedPose
from mapweave.wire.ros2.messages import type_hash
from mapweave.wire.ros2.settings import Ros2Link
from mapweave.wire.zenoh_bus import ZenohBus
from tests import ros2_peer as peer
from tests.agent.conftest import PhotoWalls
from tests.agent.drivers.ros2_robot import Ros2Robot
from tests.agent.ranged_body import on
from tests.ros2_peer import Reader, RosPeer
from tests.waiting import eventually
from tests.wire.fleets import ZenohFleet

KINDS = {
    "/tf": "tf2_msgs/msg/TFMessage", "/mapweave/r0/path": "nav_msgs/msg/Path",
    "/mapweave/r0/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/mapweave/r0/map": "visualization_msgs/msg/MarkerArray",
}  # fmt: skip
TF_HASH = "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
"""As `ros2 topic info -v /tf` prints it."""


@pytest.fixture(scope="module")
def walls() -> PhotoWalls:
    return PhotoWalls()


@dataclass
class Placed:
    """Is what the server says of the nodes."""

    poses: dict[NodeId, MergedPose] = field(default_factory=dict)

    def of(self, node: NodeId) -> MergedPose | None:
        return self.poses.get(node)


@pytest.fixture
def ros() -> Iterator[tuple[RosPeer, Ros2Publisher]]:
    router = ZenohFleet()
    one = RosPeer(router.endpoints[0])
    publisher = Ros2Publisher(Ros2Link(router.endpoints[0], domain=0), "r0")
    yield one, publisher
    publisher.close()
    one.close()
    assert not one.failures
    router.close()


def read_pose(reader: Reader) -> Pose2:
    x, y, _ = reader.several("d", 3)
    _, _, z, w = reader.several("d", 4)
    return Pose2(x, y, 2 * math.atan2(z, w))


def read_transforms(data: bytes) -> dict[tuple[str, str], tuple[int, Pose2]]:
    reader, out = Reader(data), {}
    for _ in range(reader.get("I")):
        stamp_ns, parent = reader.header()
        child = reader.text()
        out[parent, child] = stamp_ns, read_pose(reader)
    return out


def read_markers(data: bytes) -> dict[str, list[tuple[float, float]]]:
    reader, out = Reader(data), {}
    for _ in range(reader.get("I")):
        assert reader.header() == (0, "map")
        name = reader.text()
        _, form, action = reader.several("i", 3)
        assert form in (5, 7)
        reader.several("d", 7 + 3)
        assert reader.several("f", 4)[3] == 1.0
        reader.several("i", 1)
        reader.several("I", 1)
        reader.get("B")
        points = [tuple(reader.several("d", 3)) for _ in range(reader.get("I"))]
        assert (action == 0) == bool(points)
        out[name] = [(x, y) for x, y, _ in points]
        assert reader.get("I") == 0  # colours
        assert reader.text() == ""
        reader.header()
        assert reader.text() == ""
        assert reader.get("I") == 0  # the texture
        assert reader.get("I") == 0  # its coordinates
        assert reader.text() == reader.text() == reader.text() == ""
        assert reader.get("I") == 0  # the mesh
        assert reader.get("B") == 0
    assert reader.at == len(reader.data)
    return out


def test_pose_tf_path_and_map(ros: tuple[RosPeer, Ros2Publisher], walls: PhotoWalls, monkeypatch):
    monkeypatch.setattr(ros2_publisher, "SLOWLY", 0.05)
    robot, publisher = ros
    pipeline, placed = on(Carried()), Placed()
    odom = robot.publisher("/tf", KINDS["/tf"], type_hash=TF_HASH)
    eventually(lambda: sum("/MP/" in token for token in robot.tokens()) == 5)
    announced = [token.split("/") for token in robot.tokens() if "/MP/" in token and robot.zid not in token]
    hashes = {parts[9].replace("%", "/"): parts[11] for parts in announced}
    assert set(hashes) == set(KINDS)
    assert hashes["/tf"] == TF_HASH
    transforms = robot.subscriber("/tf", KINDS["/tf"], hashes["/tf"])
    before = Pose2(-1.0)
    turned = Pose2(5.0, 1.0, 1.2)
    for tick, x in enumerate(np.arange(-1.0, -0.3, 0.025)):
        seen = walls.observe(before, before := Pose2(float(x)), tick + 1)
        observation = replace(seen, stamp_ns=time.time_ns())
        # The robot's odometry frame is elsewhere than the map's.
        there = turned @ Pose2(float(x) + 1.0)
        quaternion = (0.0, 0.0, math.sin(there.heading / 2), math.cos(there.heading / 2))
        pose = (observation.stamp_ns, "odom", "base_link", (there.x, there.y, 0.0), quaternion)
        odom.publish(peer.transforms(pose))
        if tick == 0:
            eventually(lambda: publisher._odometry.name == "odom")
        step = pipeline.step(observation)
        publisher.step(observation, bool(step.changes), pipeline, placed)  # type: ignore[arg-type]
        # On a busy machine it may leave out ticks; here it shall not.
        eventually(lambda: publisher._newest is None)
    assert pipeline.map.nodes
    expected = pipeline.map_from_robot
    assert expected is not None
    late = {
        topic: robot.subscriber(topic, kind, hashes[topic], latched=True)
        for topic, kind in KINDS.items()
        if topic != "/tf"
    }

    def again() -> None:
        publisher.step(observation, False, pipeline, placed)  # type: ignore[arg-type]

    def arrived() -> bool:
        again()
        if not (all(late.values()) and transforms):
            return False
        seen = Reader(late["/mapweave/r0/pose"][-1])
        found = read_transforms(transforms[-1])
        assert seen.header()[1] == "map"
        assert list(found) == [("map", "odom")]
        at = read_pose(seen)
        whole = found["map", "odom"][1] @ there
        return at.distance(expected.mean) < 1e-9 and whole.distance(at) < 1e-6

    eventually(arrived)
    reader = Reader(late["/mapweave/r0/pose"][-1])
    reader.header()
    at = read_pose(reader)
    covariance = np.array(reader.several("d", 36)).reshape(6, 6)
    # Its own covariance is along the robot's axes; ROS wants those of the frame.
    c, s = math.cos(at.heading), math.sin(at.heading)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    wanted = rotation @ expected.covariance @ rotation.T
    np.testing.assert_allclose(covariance[np.ix_((0, 1, 5), (0, 1, 5))], wanted, atol=1e-12)
    reader = Reader(late["/mapweave/r0/path"][-1])
    reader.header()
    path = []
    for _ in range(reader.get("I")):
        assert reader.header()[1] == "map"
        path.append(read_pose(reader))
    assert 5 <= len(path) <= 9
    assert path[0].distance(Pose2()) < 0.03

    def drawn() -> bool:
        again()
        markers = read_markers(late["/mapweave/r0/map"][-1])
        shown = len(markers["nodes"]), len(markers["mapped"])
        return shown == (len(pipeline.map.nodes), 2 * len(pipeline.map.edges))

    eventually(drawn)

    # The server places the map elsewhere.
    merged_from_map = Pose2(10.0, -3.0, 0.5)
    for node in pipeline.map.nodes.values():
        merged = merged_from_map @ node.map_from_robot.mean
        placed.poses[node.id] = MergedPose(NodeId("r1", 1, 1), merged)

    def moved() -> bool:
        again()
        reader = Reader(late["/mapweave/r0/pose"][-1])
        reader.header()
        return read_pose(reader).distance(merged_from_map @ expected.mean) < 1e-6

    eventually(moved)
    eventually(lambda: again() or min(x for x, _ in read_markers(late["/mapweave/r0/map"][-1])["nodes"]) > 8)


def test_without_an_odometry_frame_of_others_it_publishes_its_own(
    ros: tuple[RosPeer, Ros2Publisher], walls: PhotoWalls, monkeypatch
):
    monkeypatch.setattr(ros2_publisher, "PATIENCE", 0.0)
    robot, publisher = ros
    transforms = robot.subscriber("/tf", KINDS["/tf"], TF_HASH)
    pipeline, before, tick = on(Carried()), Pose2(), 0

    def arrived() -> bool:
        nonlocal before, tick
        tick += 1
        seen = walls.observe(before, before := Pose2(0.01 * tick), tick)
        observation = replace(seen, stamp_ns=time.time_ns())
        step = pipeline.step(observation)
        publisher.step(observation, bool(step.changes), pipeline, Placed())  # type: ignore[arg-type]
        return len(transforms) > 3

    eventually(arrived)
    found = read_transforms(transforms[-1])
    assert set(found) == {("odom", "base_footprint"), ("map", "odom")}
    x = found["odom", "base_footprint"][1].x
    assert 0.0 < x <= 0.01 * tick + 1e-9
    whole = found["map", "odom"][1] @ found["odom", "base_footprint"][1]
    assert whole.x == pytest.approx(x, abs=0.03)


def test_names_of_agents_become_names_of_topics(opened):
    router = opened(ZenohFleet())
    opened(Ros2Publisher(Ros2Link(router.endpoints[0], domain=0, namespace="/a"), "2-kitchen"))
    robot = opened(RosPeer(router.endpoints[0]))
    eventually(lambda: any("%a%mapweave%_2_kitchen%pose" in token for token in robot.tokens()))


def test_an_agent_publishes_where_the_topics_of_its_robot_are(tmp_path):
    emulator = Ros2Robot()
    path = tmp_path / "robot.toml"
    path.write_text(f"""
[robot]
driver = "ros2"
[robot.options]
endpoint = "{emulator.endpoint}"
namespace = "/"
image = "/camera/image_raw"
[robot.geometry]
radius = 0.15
axle = 0.25
""")
    settings = load_settings(path)
    arguments = argparse.Namespace(robot=None, ros2="", lockstep=False, body=None)
    link = ros2_link(arguments, settings.robot)
    assert ros2_link(argparse.Namespace(robot="koala", ros2="tcp/a:1"), settings.robot).endpoint == "tcp/a:1"
    bus, stop = ZenohBus(BusSettings(endpoints=("tcp/127.0.0.1:9",))), threading.Event()
    robot, _ = open_robot(arguments, settings.robot, bus, "f", "r0")
    options = AgentOptions("r0", tmp_path, mission=MissionKind.CARRIED, patience=0.0, ros2=link)
    run = (CheckedRobot(robot), bus, Keys("f"), settings.agent, options, stop)
    agent = threading.Thread(target=run_agent, args=run)
    agent.start()
    try:
        kind = KINDS["/mapweave/r0/map"]
        eventually(lambda: any("%mapweave%r0%map" in token for token in emulator.peer.tokens()))
        maps = emulator.peer.subscriber("/mapweave/r0/map", kind, type_hash(kind), latched=True)
        eventually(lambda: maps)
        assert set(read_markers(maps[-1])) == {"nodes", "mapped", "turned", "driven", "loop", "merged"}
    finally:
        stop.set()
        agent.join()
        bus.close()
        emulator.close()

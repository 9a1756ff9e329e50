"""A whole drive over ROS 2 topics: an agent maps in the simulator, is lifted, and begins a new map."""

import math
import threading
import time
from bisect import bisect_left
from collections.abc import Iterator

import cv2
import pytest

from mapweave import Command, HybridMap, Pose2, read_map_file
from mapweave.scenarios.children import Children
from mapweave.sim.robots import RobotSetup
from mapweave.sim.simulation import Simulation
from mapweave.sim.worlds.catalog import make_world
from mapweave.wire.ros2.messages import type_hash
from tests import ros2_peer as peer
from tests.mapweave.test_ros2_publisher import KINDS, read_markers, read_pose, read_transforms
from tests.ros2_peer import Reader, RosPeer
from tests.waiting import eventually, free_port
from tests.wire.fleets import ZenohFleet

RANGERS = 72
SEED = 11
NODES = 12


class RosInSimulation:
    """Runs one robot of a simulation in real time behind ROS 2 topics; it drives on as it was commanded.

    Attributes:
        endpoint: of the router.
        command: the newest.
        kidnapped: whether it is lifted.
        lifted_ticks: how often it has said so.
        shown: when each image was taken, ns, and where.
    """

    def __init__(self, simulation: Simulation, endpoint: str) -> None:
        self.simulation, self.endpoint, self.peer = simulation, endpoint, RosPeer(endpoint)
        self.command, self.kidnapped, self.lifted_ticks = Command(), False, 0
        self.shown: list[tuple[int, Pose2]] = []
        self.world = threading.RLock()
        self._description = simulation.describe("r0")
        self._commands = self.peer.subscriber("/cmd_vel", "geometry_msgs/msg/Twist")
        kinds = {
            "/image/compressed": "sensor_msgs/msg/CompressedImage",
            "/camera_info": "sensor_msgs/msg/CameraInfo",
            "/odom": "nav_msgs/msg/Odometry", "/scan": "sensor_msgs/msg/LaserScan", "/tf": KINDS["/tf"],
            "/kidnap_status": "irobot_create_msgs/msg/KidnapStatus",
        }  # fmt: skip
        self._topics = {name: self.peer.publisher(name, kind) for name, kind in kinds.items()}
        self._closing = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def truth_at(self, stamp_ns: int) -> Pose2:
        """`world_from_robot` when an image was taken."""
        k = bisect_left(self.shown, stamp_ns, key=lambda one: one[0])
        return self.shown[min(k, len(self.shown) - 1)][1]

    def close(self) -> None:
        self._closing = True
        self._thread.join()
        self.peer.close()

    def _run(self) -> None:
        d = self._description
        c, odom, due = d.camera, Pose2(), time.monotonic()
        while not self._closing:
            while self._commands:
                self.command = Command(*peer.twist(self._commands.pop(0), False))
            with self.world:
                self.simulation.advance({"r0": self.command})
                seen, truth = self.simulation.observe("r0"), self.simulation.truth("r0")
            due += d.tick
            time.sleep(max(due - time.monotonic(), 0.0))
            due = max(due, time.monotonic() - d.tick)
            odom = odom @ seen.odometry.motion()
            now, topics = time.time_ns(), self._topics
            turn = (0.0, 0.0, math.sin(odom.heading / 2), math.cos(odom.heading / 2))
            topics["/odom"].publish(peer.odometry(now, odom.x, odom.y, odom.heading))
            topics["/tf"].publish(peer.transforms((now, "odom", "base_link", (odom.x, odom.y, 0.0), turn)))
            # Of a scanner on the axle; what is out of reach is infinite.
            walls = [math.inf if r >= d.ranger_reach else r + d.radius for r in seen.proximity.tolist()]
            reach = d.ranger_reach + d.radius
            topics["/scan"].publish(peer.scan(now, "laser", 0.0, math.tau / RANGERS, 0.05, reach, walls))
            lifted = self.kidnapped
            topics["/kidnap_status"].publish(peer.kidnap_status(now, lifted))
            self.lifted_ticks += lifted
            info = peer.camera_info(now, c.width, c.height, c.fx, centre=(c.cx, c.cy))
            topics["/camera_info"].publish(info)
            if seen.image is not None:
                jpeg = cv2.imencode(".jpg", seen.image, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()
                self.shown.append((now, truth))
                topics["/image/compressed"].publish(peer.compressed(now, "jpeg", jpeg))


@pytest.fixture
def robot() -> Iterator[RosInSimulation]:
    router = ZenohFleet()
    setup = RobotSetup("r0", rangers=RANGERS, ranger_reach=2.5)
    with Simulation(make_world("office", SEED), [setup], seed=SEED) as simulation:
        robot = RosInSimulation(simulation, router.endpoints[0])
        yield robot
        robot.close()
        assert not robot.peer.failures
    router.close()


@pytest.mark.slow
@pytest.mark.waits
@pytest.mark.timeout(400)
def test_a_ros2_robot_maps_is_lifted_and_begins_a_new_map(robot: RosInSimulation, tmp_path):
    d = robot.simulation.describe("r0")
    path = tmp_path / "robot.toml"
    path.write_text(f"""
[robot]
driver = "ros2"
[robot.options]
endpoint = "{robot.endpoint}"
domain = 0
image = "image/compressed"
camera_info = "camera_info"
height_m = {d.camera.mount_height}
forward_m = {d.camera.mount_forward}
ranges = ["scan"]
[robot.geometry]
radius = {d.radius}
axle = {d.axle}
wheel_noise = {d.wheel_noise}
ranger_bearings_deg = {[round(math.degrees(bearing), 6) for bearing in d.ranger_bearings]}
ranger_reach = {d.ranger_reach}
""")
    start = robot.simulation.truth("r0")
    got = {
        topic: robot.peer.subscriber(topic, kind, type_hash(kind), latched="mapweave" in topic)
        for topic, kind in KINDS.items()
    }

    def nodes() -> int:
        maps = got["/mapweave/r0/map"]
        return len(read_markers(maps[-1])["nodes"]) if maps else 0

    with Children(tmp_path / "logs") as children:
        arguments = ["--settings", str(path), "--data", str(tmp_path), "--epoch", "1", "--ros2"]
        nowhere = f"tcp/127.0.0.1:{free_port()}"
        children.start("r0", ["agent", "r0", *arguments, "--connect", nowhere])

        def wait_for(condition, seconds: float) -> None:
            end = time.monotonic() + seconds
            while not condition():
                children.check()
                assert time.monotonic() < end, (tmp_path / "logs" / "r0.log").read_text()[-2000:]
                time.sleep(0.1)

        wait_for(lambda: nodes() >= NODES, 150)
        reader = Reader(got["/mapweave/r0/pose"][-1])
        stamp_ns, _ = reader.header()
        there, true = read_pose(reader), start.inverse() @ robot.truth_at(stamp_ns)
        map_from_odom = read_transforms(got["/tf"][-1])["map", "odom"][1]
        print(f"{nodes()} nodes, {there.distance(true):.3f} m off; odom {map_from_odom}")
        assert there.distance(true) < 0.15
        assert robot.simulation.collisions("r0") == 0

        # A person lifts it and puts it down where it began, turned around.
        robot.kidnapped = True
        wait_for(lambda: robot.lifted_ticks >= 10 and robot.command == Command(), 10)
        mapped = nodes()
        with robot.world:
            robot.simulation.kidnap("r0", start @ Pose2(0.0, 0.0, 2.0))
        robot.kidnapped = False
        wait_for(lambda: (tmp_path / "r0.1.mapweave").exists() and 1 <= nodes() < mapped, 60)
        old = HybridMap(read_map_file(tmp_path / "r0.1.mapweave").changes)
        assert len(old.nodes) >= NODES
        # A robot whose agent is killed does not drive on.
        wait_for(lambda: robot.command != Command(), 20)
        children.kill("r0")
        eventually(lambda: robot.command == Command(), 0.6)

"""Publishes an agent's pose, path and map as ROS 2 topics, for rviz and Nav2.

Below the link's namespace, in the frame `map`: the merged map once the server has placed the robot, its own
map before that.

    tf                      map to odom (and odom to base_footprint, if no other node publishes that)
    mapweave/<agent>/pose   PoseWithCovarianceStamped
    mapweave/<agent>/path   Path
    mapweave/<agent>/map    MarkerArray: nodes, and edges by their kind
"""

import logging
import threading
import time
from bisect import bisect
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from mapweave.agent.drivers.clock import RemoteClock, of_monotonic_ns
from mapweave.agent.observation import Observation
from mapweave.agent.pipeline import Pipeline
from mapweave.agent.replication.merged_poses import MergedPoses
from mapweave.agent.ros_messages import making
from mapweave.agent.ros_messages.values import BASES, FOOTPRINT, TF_TYPE, heading_of, stamp_of
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Edge, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian, wrap_angle
from mapweave.processes.markers import MAP, map_markers
from mapweave.wire.pose_messages import MergedPose
from mapweave.wire.ros2.messages import decode, make
from mapweave.wire.ros2.node import Arrival, Ros2Node
from mapweave.wire.ros2.settings import Ros2Link

log = logging.getLogger(__name__)

ODOM = "odom"
AHEAD_NS = 300_000_000
"""The transform of map to odom is dated ahead by this much, for those who look it up a moment later."""
PATIENCE = 2.0
"""s that another node's odometry frame is waited for."""
SLOWLY = 1.0
"""s between two paths or maps."""
STEP, TURN = 0.1, 0.2
"""m and rad between two poses of the path."""
LONGEST_PATH = 2000
"""Poses; the oldest are left out."""
KEPT = 256
"""Odometry transforms; four seconds of the quickest robots."""


@dataclass(frozen=True)
class PublishedTick:
    """What is published of one tick.

    Attributes:
        stamp_ns: of the image.
        map_from_robot: None if the robot does not know where it is.
        odom_from_robot: by the wheels since the start.
        nodes: of the robot's own map.
        edges: likewise.
        map_number: counts the maps that the agent has begun.
        revision: counts the changes of these maps.
    """

    stamp_ns: int
    map_from_robot: PoseGaussian | None
    odom_from_robot: Pose2
    nodes: tuple[Node, ...]
    edges: tuple[Edge, ...]
    map_number: int
    revision: int


class OdometryFrame:
    """Where the robot is in its odometry frame, as another node publishes it."""

    def __init__(self, node: Ros2Node, clock: RemoteClock) -> None:
        """Subscribe."""
        self._clock = clock
        self._poses: deque[tuple[int, Pose2]] = deque(maxlen=KEPT)
        self._lock = threading.Lock()
        self.name = ""
        node.subscribe(node.link.topic("tf"), (TF_TYPE,), self._take)

    def at(self, stamp_ns: int) -> Pose2 | None:
        """`odom_from_robot` at a time; None if no node publishes it."""
        with self._lock:
            poses = list(self._poses)
        k = bisect(poses, stamp_ns, key=lambda one: one[0])
        if k in (0, len(poses)):
            return poses[max(k - 1, 0)][1] if poses else None
        (before_ns, before), (after_ns, after) = poses[k - 1], poses[k]
        share = (stamp_ns - before_ns) / max(after_ns - before_ns, 1)
        turn = share * wrap_angle(after.heading - before.heading)
        x, y = (a + share * (b - a) for a, b in ((before.x, after.x), (before.y, after.y)))
        return Pose2(x, y, before.heading + turn)

    def _take(self, arrival: Arrival) -> None:
        for one in decode(arrival.kind, arrival.data).transforms:
            parent, child = one.header.frame_id.lstrip("/"), one.child_frame_id
            if parent.rpartition("/")[2] != ODOM or child.rpartition("/")[2] not in BASES:
                continue
            stamp_ns = self._clock.local(stamp_of(one), of_monotonic_ns(arrival.arrived_ns))
            at, q = one.transform.translation, one.transform.rotation
            with self._lock:
                if not self._poses or stamp_ns > self._poses[-1][0]:
                    self._poses.append((stamp_ns, Pose2(at.x, at.y, heading_of(q.x, q.y, q.z, q.w))))
                self.name = parent


class Ros2Publisher:
    """Publishes in a thread of its own; the agent's loop only hands over."""

    def __init__(self, link: Ros2Link, agent: str) -> None:
        """Join the ROS 2 graph.

        Args:
            link: where.
            agent: name of the agent.
        """
        name = agent.replace("-", "_")
        name = f"_{name}" if name[0].isdigit() else name
        self._node = node = Ros2Node(link, f"mapweave_{name}")
        self._clock = RemoteClock()
        self._odometry = OdometryFrame(node, self._clock)
        topic = f"mapweave/{name}"
        self._tf = node.publisher(link.topic("tf"), TF_TYPE)
        self._pose = node.publisher(
            link.topic(f"{topic}/pose"), "geometry_msgs/msg/PoseWithCovarianceStamped", latched=True
        )
        self._path = node.publisher(link.topic(f"{topic}/path"), "nav_msgs/msg/Path", latched=True)
        self._map = node.publisher(
            link.topic(f"{topic}/map"), "visualization_msgs/msg/MarkerArray", latched=True
        )
        self._began = time.monotonic()
        self._odom_from_robot = Pose2()
        self._pipeline: Pipeline | None = None
        self._maps = self._revision = 0
        self._nodes: tuple[Node, ...] = ()
        self._edges: tuple[Edge, ...] = ()
        self._changed = threading.Condition()
        self._newest: tuple[PublishedTick, MergedPoses] | None = None
        self._closing = False
        self._thread = threading.Thread(target=self._serve, name="ros2-publisher", daemon=True)
        self._thread.start()

    def step(
        self, observation: Observation, changed: bool, pipeline: Pipeline, merged_poses: MergedPoses
    ) -> None:
        """Take in a tick; never waits.

        Args:
            observation: of the tick.
            changed: whether it changed the map.
            pipeline: after the tick.
            merged_poses: of its nodes.
        """
        self._odom_from_robot = self._odom_from_robot @ observation.odometry.motion()
        if pipeline is not self._pipeline:
            self._pipeline, self._maps, changed = pipeline, self._maps + 1, True
        if changed:
            self._revision += 1
            self._nodes, self._edges = tuple(pipeline.map.nodes.values()), tuple(pipeline.map.edges.values())
        moment = PublishedTick(
            observation.stamp_ns, pipeline.map_from_robot, self._odom_from_robot, self._nodes, self._edges,
            self._maps, self._revision,
        )  # fmt: skip
        with self._changed:
            self._newest = moment, merged_poses
            self._changed.notify()

    def close(self) -> None:
        """Leave the graph."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join(2.0)
        self._node.close()

    # In the publisher's thread.

    def _serve(self) -> None:
        path: deque[tuple[int, Pose2]] = deque(maxlen=LONGEST_PATH)
        number, due, shown = 0, 0.0, object()
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closing or self._newest is not None)
                if self._closing or self._newest is None:
                    return
                (moment, merged), self._newest = self._newest, None
            if moment.map_number != number:
                number = moment.map_number
                path.clear()
            merged_from_map = _merged_from_map(moment, merged)
            if moment.map_from_robot is not None:
                pose = moment.map_from_robot.mean
                if not path or _apart(path[-1][1], pose):
                    path.append((moment.stamp_ns, pose))
                self._publish_pose(moment, merged_from_map)
            if time.monotonic() < due:
                continue
            due = time.monotonic() + SLOWLY
            places = {node.id: merged.of(node.id) for node in moment.nodes}
            state = moment.revision, merged_from_map, path[-1] if path else None, places
            if state != shown:
                shown = state
                self._publish_path(path, merged_from_map)
                self._map.publish(_markers(moment, places, merged_from_map))

    def _publish_pose(self, moment: PublishedTick, merged_from_map: Pose2) -> None:
        assert moment.map_from_robot is not None
        at = PoseGaussian(merged_from_map @ moment.map_from_robot.mean, moment.map_from_robot.covariance)
        stamp_ns = self._clock.remote(moment.stamp_ns)
        head = making.header(stamp_ns, MAP)
        pose = making.pose_with_covariance(at)
        self._pose.publish(make(self._pose.kind, header=head, pose=pose))
        odom_from_robot, name = self._odometry.at(moment.stamp_ns), self._odometry.name
        transforms = []
        if odom_from_robot is None:
            if time.monotonic() - self._began < PATIENCE:
                return
            odom_from_robot, name = moment.odom_from_robot, ODOM
            transforms.append(making.transform(stamp_ns, ODOM, FOOTPRINT, odom_from_robot))
        map_from_odom = at.mean @ odom_from_robot.inverse()
        transforms.append(making.transform(stamp_ns + AHEAD_NS, MAP, name, map_from_odom))
        self._tf.publish(make(TF_TYPE, transforms=transforms))

    def _publish_path(self, path: Iterable[tuple[int, Pose2]], merged_from_map: Pose2) -> None:
        stamped = [
            make(
                "geometry_msgs/msg/PoseStamped",
                header=making.header(self._clock.remote(stamp_ns), MAP),
                pose=making.pose(merged_from_map @ pose),
            )
            for stamp_ns, pose in path
        ]
        head = making.header(0, MAP)
        self._path.publish(make(self._path.kind, header=head, poses=stamped))


def _apart(a: Pose2, b: Pose2) -> bool:
    return a.distance(b) > STEP or abs(wrap_angle(b.heading - a.heading)) > TURN


def _merged_from_map(moment: PublishedTick, merged: MergedPoses) -> Pose2:
    """Where the robot's own map lies in the merged map, by the nearest of its nodes that is placed there."""
    robot = Pose2() if moment.map_from_robot is None else moment.map_from_robot.mean
    placed = [(node, at) for node in moment.nodes if (at := merged.of(node.id)) is not None]
    if not placed:
        return Pose2()
    node, at = min(placed, key=lambda pair: pair[0].map_from_robot.mean.distance(robot))
    return at.merged_from_node @ node.map_from_robot.mean.inverse()


def _markers(
    moment: PublishedTick, places: Mapping[NodeId, MergedPose | None], merged_from_map: Pose2
) -> Any:
    """Nodes where the merged map has them, else where the robot's own map has them; and edges in between."""
    points = {}
    for node in moment.nodes:
        placed = places[node.id]
        points[node.id] = (
            merged_from_map @ node.map_from_robot.mean if placed is None else placed.merged_from_node
        )
    return map_markers(points, moment.edges)

"""Where other robots stand in the image: what is seen there moves, and is no landmark.

The fleet is asked where they are, and the robot does not wait for answers. Without a server, or where the
maps are not joined, nothing is known of them, and the whole image is used.
"""

import heapq
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mapweave.agent.ekf.landmark_estimates import LandmarkEstimates
from mapweave.agent.mission import ServerAnswer, WhoIsNear
from mapweave.agent.observation import Observation, RobotDescription
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.nearby import NearbyAnswer, NearbyRobot
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from mapweave.vision.sift import TEXTURE_BLOCK_PX

NUMBER = -2
"""Number of every question: only the newest answer counts."""
EVERY = (0.5, 5.0)
"""Least and largest time between two questions, s."""
REACH = 5.0
"""Robots farther than this are no concern yet, m: they are about as narrow as a tracked patch."""
OVERDUE = 3.0
"""A question without an answer for so long is lost, s."""
OLDEST = 3.0
"""A place that is older is no longer used, s."""
SIGMAS = 2.0
"""A robot is expected within so many standard deviations of its position."""
CARRIED = 1.0
"""Speed of a robot that takes no commands, m/s: a person walks with it."""
ABOVE = 0.05
"""What a body has above its camera, m: no robot says how high it is."""
MOST_SHARE = 0.25
"""A region is not left out if by uncertainty alone it covers more of the image: the rest must do to map."""
MOST_TOGETHER = 0.5
"""Share of the image that all regions together may cover: the rest is used, however many robots a server says
there are."""
BESIDE = 1.0
"""Nearer than this another robot is beside this one, m between their edges: in a corridor without room
to pass robots come to stand 0.7 m before each other."""
IN_FRONT = 3
"""So many landmarks of a region that are nearer than the robot, and most of it, show that something hides
the robot."""
STARTS = 4
"""Nodes by which the server may know where the robot is: the newest are not merged yet."""


class RobotBeside(NamedTuple):
    """Another robot next to this one.

    Attributes:
        off: m, between their edges.
        robot: its name.
        x: m, in the frame of this robot.
        y: m, likewise.
        radius: of its footprint, m.
    """

    off: float
    robot: str
    x: float
    y: float
    radius: float

    @property
    def words(self) -> str:
        """Who it is, and how far off."""
        return f"{self.robot} is {self.off:.1f} m off"


class RobotsInView:
    """Asks who is near, and predicts where in the image they are.

    Attributes:
        description: of this robot.
        aside: the node where this robot is in no other's way, if it stands in one by the newest answer.
    """

    def __init__(self, description: RobotDescription) -> None:
        """Know of no other robot; the description is that of this one."""
        self.description = description
        self.aside: NodeId | None = None
        self._odom_from_robot = Pose2()
        self._now = 0.0
        self._stamp_ns: int | None = None
        self._asked: tuple[float, Pose2] | None = None
        self._due = 0.0
        self._seen: tuple[float, Pose2, tuple[NearbyRobot, ...]] | None = None

    def mark(
        self,
        observation: Observation,
        answers: Sequence[ServerAnswer],
        landmarks: Callable[[], LandmarkEstimates],
    ) -> Observation:
        """Begin a tick: the observation with the regions of its image in which others may stand.

        Args:
            observation: of this tick.
            answers: that have come.
            landmarks: in view; those in front of a robot show that it is hidden.
        """
        if self._stamp_ns is not None:
            self._now += max(observation.stamp_ns - self._stamp_ns, 0) * 1e-9
        self._stamp_ns = observation.stamp_ns
        self._odom_from_robot = self._odom_from_robot @ observation.odometry.motion()
        for answer in answers:
            if answer.number == NUMBER and self._asked is not None:
                self._take(answer, *self._asked)
                self._asked = None
        if self._asked is not None and self._now - self._asked[0] > OVERDUE:
            self._asked, self._due = None, self._now + EVERY[1]
        regions = self._regions(landmarks)
        return replace(observation, left_out=regions) if len(regions) else observation

    @property
    def beside(self) -> RobotBeside | None:
        """The nearest robot; None if none is beside this one."""
        if self._seen is None:
            return None
        at, odom_then, robots = self._seen
        robot_from_then = self._odom_from_robot.inverse() @ odom_then
        around: list[RobotBeside] = []
        for one in robots:
            pose = robot_from_then @ one.robot_from_other
            off = math.hypot(pose.x, pose.y) - self.description.radius - one.radius
            if off < BESIDE and one.age + self._now - at < OLDEST:
                around.append(RobotBeside(max(off, 0.0), one.robot, pose.x, pose.y, one.radius))
        return min(around, default=None)

    @property
    def due(self) -> bool:
        """Whether it is time for a question."""
        return self._asked is None and self._now >= self._due

    def question(self, starts: tuple[tuple[NodeId, Pose2], ...], here: PoseGaussian) -> WhoIsNear:
        """What to ask.

        Args:
            starts: nodes around the robot, the best first, each with `node_from_robot`.
            here: how well that is known.
        """
        d = self.description
        sigma = math.sqrt(max(here.covariance[0, 0], here.covariance[1, 1]))
        turn = math.sqrt(here.covariance[2, 2])
        self._asked = self._now, self._odom_from_robot
        height, speed = d.camera.mount_height + ABOVE, d.max_forward or CARRIED
        return WhoIsNear(NUMBER, starts, min(sigma, 100.0), min(turn, 4.0), d.radius, height, speed)

    def _take(self, answer: ServerAnswer, at: float, odom_then: Pose2) -> None:
        self.aside = answer.content.aside if isinstance(answer.content, NearbyAnswer) else None
        if not isinstance(answer.content, NearbyAnswer):
            self._due = self._now + EVERY[1]
            return
        robots = answer.content.robots
        self._seen = at, odom_then, robots
        # Until then the nearest cannot have come within reach.
        waits = [
            (math.hypot(one.robot_from_other.x, one.robot_from_other.y) - REACH)
            / max(one.speed + (self.description.max_forward or CARRIED), 0.1)
            - one.age
            for one in robots
        ]
        self._due = at + min(max(min(waits, default=EVERY[1]), EVERY[0]), EVERY[1])

    def _regions(self, landmarks: Callable[[], LandmarkEstimates]) -> Array:
        """(K, 4) px in the ideal image: left, top, right, bottom."""
        if self._seen is None:
            return np.zeros((0, 4))
        at, odom_then, robots = self._seen
        robot_from_then = self._odom_from_robot.inverse() @ odom_then
        room = MOST_TOGETHER * self.description.camera.width * self.description.camera.height
        boxes: list[Array] = []
        for one in robots:
            box = self._region(robot_from_then, one, self._now - at, landmarks)
            if box is not None and (room := room - float(np.prod(box[2:] - box[:2]))) > 0.0:
                boxes.append(box)
        return np.array(boxes).reshape(-1, 4)

    def _region(
        self,
        robot_from_then: Pose2,
        other: NearbyRobot,
        since: float,
        landmarks: Callable[[], LandmarkEstimates],
    ) -> Array | None:
        age = other.age + since
        if age > OLDEST:
            return None
        camera, pose = self.description.camera, robot_from_then @ other.robot_from_other
        ahead, left = pose.x - camera.mount_forward, pose.y
        bare = self._box(ahead, left, other.radius, other.height)
        if bare is None or bare[2] - bare[0] < TEXTURE_BLOCK_PX:
            return None
        reach = other.radius + SIGMAS * other.sigma + age * other.speed
        grown = self._box(ahead, left, reach, other.height)
        if grown is None:
            return None
        inside = np.clip(np.array([bare, grown]), 0.0, [camera.width, camera.height] * 2)
        bare_px, grown_px = (inside[:, 2:] - inside[:, :2]).prod(axis=1).tolist()
        if grown_px <= 0.0 or grown_px - bare_px > MOST_SHARE * camera.width * camera.height:
            return None
        if self._hidden(inside[1], math.hypot(ahead, left) - reach, landmarks()):
            return None
        return np.asarray(inside[1])

    def _box(self, ahead: float, left: float, reach: float, height: float) -> Array | None:
        """[left, top, right, bottom] px of a cylinder on the floor; None if it reaches the camera."""
        camera, distance = self.description.camera, math.hypot(ahead, left)
        near = ahead - reach
        if near <= 0.0:
            return None
        middle, half = math.atan2(left, ahead), math.asin(reach / distance)
        top = height - camera.mount_height
        depth = near if top > 0.0 else ahead + reach
        return np.array([
            camera.cx - camera.fx * math.tan(middle + half),
            camera.cy - camera.fy * top / depth,
            camera.cx - camera.fx * math.tan(middle - half),
            camera.cy + camera.fy * camera.mount_height / near,
        ])  # fmt: skip

    def _hidden(self, box: Array, distance: float, landmarks: LandmarkEstimates) -> bool:
        """Whether landmarks in the box show something in front of where the robot begins."""
        with np.errstate(invalid="ignore"):
            pixels = self.description.camera.project(landmarks.points_in_robot)
            inside = ((pixels >= box[:2]) & (pixels <= box[2:])).all(axis=1)
            nearer = inside & (landmarks.depths + SIGMAS * landmarks.depth_sigmas < distance)
        return bool(nearer.sum() >= max(IN_FRONT, 0.5 * inside.sum()))


def nodes_around(own_map: HybridMap, map_from_robot: Pose2) -> tuple[tuple[NodeId, Pose2], ...]:
    """The nearest nodes of the own map, each with `node_from_robot`."""
    poses = {node.id: node.map_from_robot.mean for node in own_map.nodes.values()}
    nearest = heapq.nsmallest(STARTS, poses, key=lambda node: (map_from_robot.distance(poses[node]), node))
    return tuple((node, poses[node].inverse() @ map_from_robot) for node in nearest)

"""Following one route: servo to visible nodes, drive to the others, park at the last."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from mapweave.agent.localization.fix import Fix, joined, position_sigma
from mapweave.agent.localization.node_detector import Expected, NodeDetector
from mapweave.agent.localization.node_localizer import NodeLocalizer
from mapweave.agent.navigation.local_planner import LocalPlanner
from mapweave.agent.observation import Command, Observation, RobotDescription
from mapweave.agent.servo.odometry_drive import OdometryDrive
from mapweave.agent.servo.proximity import ranger_points
from mapweave.agent.servo.servo_step import State
from mapweave.agent.servo.supervisor import Servo
from mapweave.agent.settings import AgentSettings
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Pose2, PoseGaussian, averaged, wrap_angle
from mapweave.hybridmap.query import RouteLeg
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Sift


@dataclass
class ProgressMonitor:
    """The least distance to the target, and its age.

    Attributes:
        step: m, nearer by this counts.
        best: m, the nearest so far.
        stood: s since the distance last decreased.
    """

    step: float = 0.03
    best: float = math.inf
    stood: float = 0.0

    def take(self, distance: float, tick: float) -> None:
        """Another tick (s) at a distance (m)."""
        self.stood += tick
        if distance < self.best - self.step:
            self.best, self.stood = distance, 0.0


MOST_CANDIDATES = 8
"""Nodes tried in one image: a route may put any number of them into one place."""


class RouteProgress(StrEnum):
    """State of a follower."""

    DRIVING = "driving along the route"
    PARKING = "parking at the goal"
    ARRIVED = "parked at the goal"
    UNSURE = "no landmark visible for a while"
    BLOCKED = "no progress"


NEAR = 0.35
"""Within this distance of the goal the last, blind turns are made if it is not in sight, m."""
PASSED = 0.22
"""An intermediate node is passed within this distance, m."""
DETECTION_TURN = 0.6
"""A node is searched for in the image when the robot's heading is within this of the node's, rad."""
DETECTION_REACH = 1.4
"""A node's landmarks are looked for when the robot is within this distance of it, m."""
DETECT_EVERY = 4
"""Ticks between two detections of the next nodes."""
SKIP = 2
"""Nodes further along the route that are searched for as well."""
GOAL_VIEWS = 4
"""Detections at the goal, averaged, that decide whether the robot is there."""
WITHIN = 0.01
"""A robot within this of the goal has parked, m."""
SIGMAS = 2.0
"""A robot whose distance from the goal and so many of its standard deviations are together within that has
arrived; else it drives the rest."""
CORRECTIONS = 2
"""How often it does so. Where what is in view says too little, it is then as near as it gets."""
HIDDEN = 2.0
"""After this time at the goal without its landmarks visible, or recognised, the robot is not there, s."""
PATIENCE = 6.0
"""Time without getting on before an edge counts as blocked, s."""
PARKING_PATIENCE = 30.0
"""Time without getting nearer to the goal's pose after which the robot starts again, and after which the
second time the goal is blocked, s (docs/decisions/routes.md). Chosen: parking goes back and forth, so it
takes longer than an edge."""
STALLED = 3.0
"""Time that the servo may take without getting nearer before the robot drives around, s."""
STALLED_PARKING = 10.0
"""The same on the way to the goal's pose, which may take a manoeuvre, s."""
BARRED = 5.0
"""How long the robot then drives around without the servo, s."""


class RouteFollower:
    """Drives one route.

    All poses are relative to the *reference*, the leg whose node the robot's fix is on; the route's
    relative poses lead from there to the target.

    Attributes:
        progress: how far it is.
        detail: in words.
        fix: where the robot is.
        leg: index of the leg that is driven to.
    """

    def __init__(
        self,
        description: RobotDescription,
        lens: Lens,
        sift: Sift,
        route: tuple[RouteLeg, ...],
        fix: Fix,
        detour: LocalPlanner,
        settings: AgentSettings,
        rng: np.random.Generator,
    ) -> None:
        """Start on a route.

        Args:
            description: of the robot.
            lens: of its camera.
            sift: finds features.
            route: legs; the pose of the first is relative to the node of the fix.
            fix: where the robot is.
            detour: drives between nodes.
            settings: how.
            rng: for verification.
        """
        self.progress = RouteProgress.DRIVING
        self.detail = ""
        self.fix = fix
        self._description = description
        self._detector = NodeDetector(description, lens, sift, rng, settings)
        self._route = route
        self._start_from_leg = [Pose2()]
        for hop in route[1:]:
            self._start_from_leg.append(self._start_from_leg[-1] @ hop.previous_from_node.mean)
        self._local_planner = detour
        self._settings = settings.navigation
        self._servo = Servo(description)
        self._servoing = -1
        self._blind_drive = OdometryDrive(description)
        self._start = fix.node
        self._last = len(route) - 1
        self._reference = 0
        if fix.node != route[0].node.id:
            pose = route[0].previous_from_node.inverse() @ fix.node_from_robot
            self.fix = Fix(route[0].node.id, pose, None, fix.blind)
        # The route may begin at a node away from the robot: then that node is the first to reach.
        self.leg = min(1 if self._off_reference() < PASSED else 0, self._last)
        self._tick = 0
        self._progressed = ProgressMonitor()
        self._headway = ProgressMonitor()
        self._servo_barred = 0.0
        self._approaching = False
        self._hidden = 0.0
        self._confirmed = False
        self._goal_poses: list[PoseGaussian] = []
        self._corrections = 0

    @property
    def blocked(self) -> tuple[NodeId, NodeId]:
        """The pair of nodes between which the robot is, or is stuck."""
        before = self._route[self.leg - 1].node.id if self.leg else self._start
        return before, self._route[self.leg].node.id

    @property
    def robot_from_target(self) -> Pose2:
        """Where the node is that it drives to."""
        return self._target().inverse()

    @property
    def to_goal(self) -> float:
        """How far the robot is from the last node, m."""
        return self.distance(self._last)

    @property
    def off_goal(self) -> str:
        """How far the robot is from the last node by its own estimate, with the standard deviation."""
        goal_from_robot = self.fix.node_from_robot
        for hop in self._route[self._reference + 1 :]:
            goal_from_robot = hop.previous_from_node.inverse() @ goal_from_robot
        distance = math.hypot(goal_from_robot.mean.x, goal_from_robot.mean.y)
        return f"{1e3 * distance:.0f} +- {1e3 * position_sigma(goal_from_robot):.0f} mm off"

    def distance(self, leg: int) -> float:
        """Distance of the robot from a leg's node, m."""
        leg_from_robot = self._from_reference(leg) @ self.fix.node_from_robot.mean
        return math.hypot(leg_from_robot.x, leg_from_robot.y)

    def step(self, observation: Observation) -> Command:
        """One tick; `progress` says whether it is the last one."""
        s = self._settings
        self._tick += 1
        self.fix.follow(observation, self._description)
        if self._tick % DETECT_EVERY == 0:
            self._detect(self._ahead(), observation)
        self._pass_nodes()
        target = self._target()
        distance = math.hypot(target.x, target.y)
        node = self._route[self.leg].node.id
        parking = self.leg == self._last
        self.detail = f"{distance:.2f} m to node {node}"
        if not parking:
            self.detail += f", {self._last - self.leg} further"
        self.progress = RouteProgress.DRIVING
        if self.fix.blind > s.blind_distance and not (parking and distance < NEAR):
            self.progress = RouteProgress.UNSURE
            return Command()
        self._progressed.take(distance, self._description.tick)
        if self._progressed.stood > (PARKING_PATIENCE if parking else PATIENCE):
            self.progress = RouteProgress.BLOCKED
            return Command()
        return self._drive(target, distance, parking, observation)

    # Driving

    def _drive(self, target: Pose2, distance: float, parking: bool, observation: Observation) -> Command:
        """Servo if the target's landmarks are visible, else drive to its position, at the goal blindly."""
        obstacles = ranger_points(observation.proximity, self._description)
        localizer = self.fix.localizer
        if localizer is not None and self._may_servo(target, distance, parking):
            points = localizer.node.points_in_robot
            if self._servoing != self.leg:
                self._headway, self._servoing = ProgressMonitor(), self.leg
                self._servo.start(target, points)
            visible = np.zeros(len(points), np.bool_)
            visible[localizer.visible] = True
            step = self._servo.command(target, points, visible, obstacles)
            if parking:
                self.progress = RouteProgress.PARKING
                self.detail = f"{step.reason}, {self.off_goal}"
                self._confirm(step.state, observation)
            if step.state != "stuck":
                self._approaching = False
                return step.command
        self._servoing = -1
        if not parking or distance > NEAR:
            self._approaching = False
            command = self._local_planner.toward(target.inverse())
            if self._local_planner.around:
                self.detail += ", around an obstacle"
            return command
        if not self._approaching:
            self._blind_drive.start(target)
            self._approaching = True
        step = self._blind_drive.command(target, obstacles)
        self._hidden = self._hidden + self._description.tick if step.state == "arrived" else 0.0
        if self._hidden > HIDDEN:
            self.progress = RouteProgress.UNSURE
        return step.command

    def _detect_goal(self, observation: Observation) -> NodeLocalizer | None:
        if observation.image is None:
            return None
        detection = self._detector.find(
            observation.image, [self._expected(self._last)], left_out=observation.left_out
        )
        return None if detection is None else detection[1]

    def _may_servo(self, target: Pose2, distance: float, parking: bool) -> bool:
        """Whether the servo may drive: where it gets no nearer, it cannot pass what is in its way."""
        tick = self._description.tick
        self._servo_barred = max(self._servo_barred - tick, 0.0)
        if self._servo_barred or self._reference != self.leg or not (parking or _lies_ahead(target)):
            return False
        if self._servoing == self.leg and not (parking and distance <= NEAR):
            self._headway.take(distance, tick)
            if self._headway.stood > (STALLED_PARKING if parking else STALLED):
                self._servo_barred = BARRED
        return self._servo_barred == 0.0

    def _confirm(self, state: State, observation: Observation) -> None:
        """Detect the goal again on arrival.

        Tracks have drifted a little on the way, all in the same direction.

        A view from the node's own pose shows its features at their own scale, so in most places this is the
        most precise measurement of the pose. Several are averaged, and joined with what the tracks say: where
        the goal's landmarks lie close together, the whole way shows more than a look at its end.

        The robot has arrived if it is then still at the goal, and surely near enough: the servo ends ways at
        several millimetres, which is right while the pose is known no better.
        """
        if state != "arrived":
            self._confirmed, self._hidden, self._goal_poses = False, 0.0, []
        elif self._confirmed:
            self.progress = RouteProgress.ARRIVED
        elif (localizer := self._detect_goal(observation)) is not None:
            self._goal_poses.append(localizer.pose)
            if len(self._goal_poses) == GOAL_VIEWS:
                localizer.restart(joined(averaged(self._goal_poses), self.fix.node_from_robot))
                self._goal_poses, self.fix = [], Fix.of(localizer)
                self._confirmed = not self._drives_the_rest()
        else:
            self._hidden += self._description.tick
            if self._hidden > HIDDEN:
                self.progress = RouteProgress.UNSURE

    def _drives_the_rest(self) -> bool:
        """Whether the robot, measured at rest by the goal itself, may be too far off and drives on."""
        near = self._off_reference() + SIGMAS * position_sigma(self.fix.node_from_robot) <= WITHIN
        if near or self._corrections == CORRECTIONS:
            return False
        if not self._servo.come_nearer(self.fix.node_from_robot.mean):
            return False
        self._corrections += 1
        return True

    # Nodes ahead

    def _pass_nodes(self) -> None:
        """Go on to the next node where one is passed, or a later one is visible already."""
        before = self.leg
        if self._reference > self.leg:
            self.leg = self._reference
        if self._reference == self.leg < self._last and self._off_reference() < 2 * PASSED:
            self.leg += 1
        while self.leg < self._last and self.distance(self.leg) < PASSED:
            self.leg += 1
        if self.leg != before:
            self._progressed = ProgressMonitor()

    def _detect(self, wanted: Sequence[Expected], observation: Observation) -> bool:
        """Search the image for nodes, furthest first; returns whether the fix is now on one of them."""
        if observation.image is None or not wanted:
            return False
        detection = self._detector.find(observation.image, wanted, left_out=observation.left_out)
        if detection is not None:
            self._reference, localizer = detection
            self.fix = Fix.of(localizer)
        return detection is not None

    def _ahead(self) -> list[Expected]:
        """Nodes whose landmarks may be in view, furthest first."""
        first = self._reference + 1 if self.fix.in_sight else 0
        wanted: list[Expected] = []
        for index in range(min(self.leg + SKIP, self._last), first - 1, -1):
            if len(wanted) == MOST_CANDIDATES:
                break
            expected = self._expected(index)
            pose = expected.node_from_robot
            if (
                math.hypot(pose.x, pose.y) < DETECTION_REACH
                and abs(wrap_angle(pose.heading)) < DETECTION_TURN
            ):
                wanted.append(expected)
        # At the goal more of its landmarks are in view: a new detection improves the last millimetres.
        if self._reference == self._last and self.fix.in_sight and self._tick % (3 * DETECT_EVERY) == 0:
            tracked = len(self.fix.localizer.visible) if self.fix.localizer is not None else 0
            wanted.append(self._expected(self._last)._replace(tracked=tracked))
        return wanted

    def _expected(self, index: int) -> Expected:
        """A leg's node, with where the robot should be from it."""
        node_from_robot = self._from_reference(index) @ self.fix.node_from_robot.mean
        return Expected(index, self._route[index].node, node_from_robot, 1.0 + self.fix.blind)

    def _target(self) -> Pose2:
        """`target_from_robot`."""
        return self._from_reference(self.leg) @ self.fix.node_from_robot.mean

    def _from_reference(self, target: int) -> Pose2:
        """`target_from_reference` along the route's relative poses."""
        return self._start_from_leg[target].inverse() @ self._start_from_leg[self._reference]

    def _off_reference(self) -> float:
        return math.hypot(self.fix.node_from_robot.mean.x, self.fix.node_from_robot.mean.y)


def _lies_ahead(target_from_robot: Pose2) -> bool:
    """Whether a pose can be servoed to without a manoeuvre: ahead, and with a similar heading."""
    robot_from_target = target_from_robot.inverse()
    return (
        abs(target_from_robot.heading) < 0.5
        and robot_from_target.x > 0.1
        and abs(robot_from_target.y) < 0.6 * robot_from_target.x
    )

"""Navigation in the large: find out where the robot is, get a route, servo from node to node, park."""

from __future__ import annotations

import math
from collections.abc import Generator
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from agent.floor import Floor
from agent.localizer import Localizer, LocalizerSettings
from agent.mission import Answer, Question, WhereAmI, WhichWay
from agent.observation import Command, Observation, RobotDescription
from agent.recall import recall
from agent.servo.blind import BlindDrive
from agent.servo.proximity import ranger_points
from agent.servo.supervisor import Servo
from agent.vision.lens import Lens
from agent.vision.sift import Sift
from hybridmap.hybrid_map import HybridMap
from hybridmap.node import Node, NodeId
from hybridmap.pose import Array, Pose2, PoseGaussian, wrap_angle
from hybridmap.query import Certainty, RelocalizeAnswer, RouteAnswer, RouteLeg
from hybridmap.recognition import recognise


@dataclass(frozen=True)
class NavigatorSettings:
    """How the robot navigates.

    Attributes:
        localizer: tracking and filtering of a node's landmarks.
        look_turn: between two looks of a lost robot, rad.
        turn_rate: on the spot, rad/s.
        speed: between nodes, m/s.
        passed: an intermediate node is passed within this distance, m.
        sight_turn: a node's landmarks are looked for when the robot's heading is within this of it, rad.
        sight_reach: and the robot within this distance of it, m.
        look_every: ticks between two looks for the next nodes' landmarks.
        skip: nodes further along the route that are looked for as well.
        sure: standard deviations up to which a lost robot believes a recognition, m and rad.
        plausible: a recognition this far from where the robot believes to be is not believed, m.
        blind: way without any landmark in sight before the robot stops and asks where it is, m.
        patience: seconds without getting on before an edge counts as blocked.
        replan_every: ticks between two plans around obstacles.
        answer_patience: ticks that an answer may take before the question counts as lost.
    """

    localizer: LocalizerSettings = field(default_factory=LocalizerSettings)
    look_turn: float = 0.5
    turn_rate: float = 0.6
    speed: float = 0.26
    passed: float = 0.22
    sight_turn: float = 0.6
    sight_reach: float = 1.4
    look_every: int = 4
    skip: int = 2
    sure: tuple[float, float] = (0.06, 0.03)
    plausible: float = 0.5
    blind: float = 1.2
    patience: float = 5.0
    answer_patience: int = 100
    replan_every: int = 15


class Stage(StrEnum):
    """What the navigator is doing, in words for the status line."""

    LOST = "looking around to find out where it is"
    ASKING = "asking for a route"
    DRIVING = "driving along the route"
    PARKING = "parking at the goal"
    ARRIVED = "parked at the goal"


class Outcome(StrEnum):
    """How a drive along a route ended."""

    ARRIVED = "arrived"
    REROUTE = "somewhere else on the map"
    LOST = "lost"


Behaviour = Generator[Command, None, None]


def _ahead(target_from_robot: Pose2) -> bool:
    """Whether a posture can be servoed to without a manoeuvre: ahead, and facing alike."""
    there = target_from_robot.inverse()
    return abs(target_from_robot.heading) < 0.5 and there.x > 0.1 and abs(there.y) < 0.6 * there.x


@dataclass(eq=False)
class Fix:
    """Where the robot is with respect to a node: kept up by odometry, and by the node's landmarks in sight.

    Attributes:
        node: the node's id.
        node_from_robot: posture.
        localizer: follows the node's landmarks, or None if they are not known or not in sight.
        blind: way since landmarks were last in sight, m.
    """

    node: NodeId
    node_from_robot: PoseGaussian
    localizer: Localizer | None = None
    blind: float = 0.0


class Navigator:
    """Brings the robot to a goal node. The kidnapped robot of the paper is the same path: it starts lost.

    Attributes:
        stage: what it is doing.
        detail: why, in words.
        driven: pairs of nodes that were driven, with the measured `a_from_b`.
        fix: where the robot is, or None while lost.
        route: legs of the current route.
        leg: index of the leg that is driven to.
        legs: how many the first route had.
    """

    def __init__(
        self,
        description: RobotDescription,
        lens: Lens,
        sift: Sift,
        own_map: HybridMap,
        goal: NodeId,
        settings: NavigatorSettings | None = None,
        seed: int = 0,
    ) -> None:
        """Start lost, with a goal."""
        self.stage = Stage.LOST
        self.detail = ""
        self.driven: list[tuple[NodeId, NodeId, PoseGaussian]] = []
        self.fix: Fix | None = None
        self.route: tuple[RouteLeg, ...] = ()
        self.leg = 0
        self.legs = 0
        self.goal = goal
        self._description = description
        self._lens = lens
        self._sift = sift
        self._own_map = own_map
        self._settings = settings or NavigatorSettings()
        self._rng = np.random.default_rng(seed)
        self._servo = Servo(description)
        self._blind_drive = BlindDrive(description)
        self._observation: Observation | None = None
        self._answers: dict[int, Answer] = {}
        self._questions: list[Question] = []
        self._next_question = 1
        self._blocked: list[tuple[NodeId, NodeId]] = []
        self._tick = 0
        # What the rangers have seen since the start, in the wheels' frame: it has to last a few metres only.
        self._floor = Floor(description)
        self._odom_from_robot = Pose2()
        self._detour: list[Array] = []
        self._replan = 0
        self._behaviour = self._go()

    def step(self, observation: Observation, answers: tuple[Answer, ...]) -> tuple[Command, list[Question]]:
        """One tick: returns what the wheels shall do and what to ask the fleet's map."""
        self._observation = observation
        self._tick += 1
        self._answers.update({a.number: a for a in answers})
        self._questions = []
        self._odom_from_robot = self._odom_from_robot @ observation.odometry.motion()
        self._floor.see(self._odom_from_robot, observation.proximity)
        self._keep_fix(observation)
        return next(self._behaviour), self._questions

    @property
    def arrived(self) -> bool:
        """Whether the robot is parked at the goal."""
        return self.stage is Stage.ARRIVED

    # Behaviours

    def _go(self) -> Behaviour:
        while True:
            if self.fix is None:
                yield from self._look_around()
            assert self.fix is not None
            yield from self._get_route(self.fix.node)
            if not self.route:
                # What was in the way may have gone; otherwise the robot would stand here for ever.
                self._blocked.clear()
                self.fix = None
                yield from self._wait(2.0)
                continue
            outcome = yield from self._follow_route()
            if outcome is Outcome.ARRIVED:
                break
            if outcome is Outcome.LOST:
                self.fix = None
        self.stage = Stage.ARRIVED
        while True:
            yield Command()

    def _look_around(self) -> Behaviour:
        """Look, ask, turn a little, until somebody knows the view."""
        self.stage, self.detail = Stage.LOST, "looking"
        while True:
            yield from self._wait(0.2)
            if (yield from self._relocalize()):
                return
            yield from self._turn(self._settings.look_turn)

    def _relocalize(self) -> Generator[Command, None, bool]:
        """Recognise the current view on the own map, else ask the fleet's; sets `fix` if it is known."""
        if self._now.image is None:
            return False
        features = self._sift.extract(self._now.image)
        if len(features) < 8:
            self.detail = f"only {len(features)} features in view"
            return False
        view = features.view(self._description.camera)
        own = recall(self._own_map, view, self._rng)
        if own is not None and self._sure(own[1].node_from_robot):
            self._hold(own[0], Localizer(
                self._description, self._lens, own[0], self._now.image, features, own[1],
                self._settings.localizer,
            ))  # fmt: skip
            self.detail = f"own map: node {own[0].id}, {own[1].inliers} landmarks agree"
            return True
        answer = yield from self._ask(WhereAmI(self._number(), view))
        if not isinstance(answer.content, RelocalizeAnswer):
            self.detail = answer.error or "no answer"
            return False
        self.detail = answer.content.reason
        if answer.content.certainty is not Certainty.FOUND:
            return False
        best = answer.content.candidates[0]
        if not self._sure(best.node_from_robot):
            self.detail = f"{answer.content.reason}, but not exactly enough"
            return False
        # The robot has stood still while the answer was on its way.
        self.fix = Fix(best.node, best.node_from_robot)
        return True

    def _sure(self, posture: PoseGaussian) -> bool:
        """Whether a recognition is exact enough to drive by; else another look, elsewhere, costs little."""
        s, sigma = self._settings, np.sqrt(np.diag(posture.covariance))
        return bool(max(sigma[0], sigma[1]) <= s.sure[0] and sigma[2] <= s.sure[1])

    def _get_route(self, start: NodeId) -> Behaviour:
        self.stage, self.route, self.leg = Stage.ASKING, (), 0
        assert self.fix is not None
        here = self.fix.node_from_robot.mean
        answer = yield from self._ask(WhichWay(self._number(), start, self.goal, here, tuple(self._blocked)))
        if isinstance(answer.content, RouteAnswer):
            self.route = answer.content.legs
            self.legs = self.legs or len(self.route)
            self.detail = answer.content.reason
        else:
            self.detail = answer.error or "no answer"

    def _rebase(self, leg: RouteLeg) -> None:
        """Express where the robot is in the frame of the route's first node."""
        fix = self.fix
        assert fix is not None
        if fix.node != leg.node.id:
            posture = leg.previous_from_node.inverse() @ fix.node_from_robot
            self.fix = Fix(leg.node.id, posture, None, fix.blind)

    def _follow_route(self) -> Generator[Command, None, Outcome]:
        s = self._settings
        self.stage = Stage.DRIVING
        reference, start = 0, self.fix.node
        self._rebase(self.route[0])
        # The route may begin at a node that the robot does not stand at: then that is the first to reach.
        here = self.fix.node_from_robot.mean
        self.leg = min(1 if math.hypot(here.x, here.y) < s.passed else 0, len(self.route) - 1)
        servoing, approaching = -1, False
        best, since_best = math.inf, 0.0
        while True:
            fix = self.fix
            assert fix is not None
            last = len(self.route) - 1
            if self._tick % s.look_every == 0:
                reference = self._look_ahead(reference)
                fix = self.fix
                if reference > self.leg or (reference == self.leg < last and self._passed(reference)):
                    self.leg = min(max(reference, self.leg + 1), last)
                    best, since_best = math.inf, 0.0
            target_from_robot = self._target_from_reference(reference, self.leg) @ fix.node_from_robot.mean
            distance = math.hypot(target_from_robot.x, target_from_robot.y)
            if self.leg < last and distance < s.passed:
                self.leg += 1
                best, since_best = math.inf, 0.0
                continue
            self.detail = (
                f"{distance:.2f} m to node {self.route[self.leg].node.id}, {last - self.leg} further"
            )
            if fix.blind > s.blind and not (self.leg == last and distance < 0.3):
                yield from self._wait(0.2)
                if (yield from self._relocalize()):
                    return Outcome.REROUTE
                if fix.blind > 2 * s.blind:
                    return Outcome.LOST
            if distance < best - 0.03:
                best, since_best = distance, 0.0
            since_best += self._description.tick
            parking = self.leg == last
            if since_best > (6 * s.patience if parking else s.patience):
                before = self.route[self.leg - 1].node.id if self.leg else start
                self._blocked.append((before, self.route[self.leg].node.id))
                return Outcome.LOST
            in_sight = fix.localizer is not None and fix.localizer.in_sight and reference == self.leg
            if in_sight and (parking or _ahead(target_from_robot)):
                if servoing != self.leg:
                    self._servo.start(target_from_robot, self.route[self.leg].node.points_in_robot)
                    servoing = self.leg
                assert fix.localizer is not None
                step = self._servo.command(
                    target_from_robot, self.route[self.leg].node.points_in_robot,
                    self._visible(fix.localizer), ranger_points(self._now.proximity, self._description),
                )  # fmt: skip
                if parking:
                    self.stage = Stage.PARKING
                    self.detail = f"{step.reason}, {distance * 1000:.0f} mm off"
                    if step.state == "arrived":
                        return Outcome.ARRIVED
                if step.state != "stuck":
                    approaching = False
                    yield step.command
                    continue
            servoing = -1
            if parking:
                if not approaching:
                    self._blind_drive.start(target_from_robot)
                    approaching = True
                step = self._blind_drive.command(
                    target_from_robot, ranger_points(self._now.proximity, self._description)
                )
                yield step.command
            else:
                yield self._toward(target_from_robot)

    # Landmarks ahead

    def _look_ahead(self, reference: int) -> int:
        """Look for the landmarks of the nodes ahead, furthest first; returns the new reference leg."""
        s, fix = self._settings, self.fix
        assert fix is not None
        if self._now.image is None:
            return reference
        last = len(self.route) - 1
        first = reference + 1 if fix.localizer is not None and fix.localizer.in_sight else 0
        wanted = []
        for index in range(min(self.leg + s.skip, last), first - 1, -1):
            expected = self._target_from_reference(reference, index) @ fix.node_from_robot.mean
            near = math.hypot(expected.x, expected.y) < s.sight_reach
            if near and abs(wrap_angle(expected.heading)) < s.sight_turn:
                wanted.append((index, expected))
        refresh = reference == last and fix.localizer is not None and self._tick % (3 * s.look_every) == 0
        if refresh:
            wanted.append((last, fix.node_from_robot.mean))
        if not wanted:
            return reference
        features = self._sift.extract(self._now.image)
        view = features.view(self._description.camera)
        for index, expected in wanted:
            node = self.route[index].node
            found = recognise(node, view, None, self._rng)
            if found is None or found.node_from_robot.mean.distance(expected) > s.plausible + 0.2 * fix.blind:
                continue
            if (
                index == reference
                and fix.localizer is not None
                and found.inliers <= len(fix.localizer.visible)
            ):
                continue
            localizer = Localizer(
                self._description, self._lens, node, self._now.image, features, found, s.localizer
            )
            if index != reference:
                measured = fix.node_from_robot @ found.node_from_robot.inverse()
                self.driven.append((fix.node, node.id, measured))
            self._hold(node, localizer)
            return index
        return reference

    def _hold(self, node: Node, localizer: Localizer) -> None:
        self.fix = Fix(node.id, localizer.pose, localizer)

    def _keep_fix(self, observation: Observation) -> None:
        """Follow the landmarks in sight, else the wheels."""
        fix = self.fix
        if fix is None:
            return
        motion = observation.odometry
        if fix.localizer is not None:
            fix.localizer.step(observation)
            if fix.localizer.in_sight:
                fix.node_from_robot, fix.blind = fix.localizer.pose, 0.0
                return
            fix.localizer = None
        way = self._description.wheel_noise * (
            abs(motion.forward) + abs(motion.turn) * self._description.axle
        )
        step = PoseGaussian.from_sigmas(motion.motion(), way + 1e-5, way / self._description.axle + 1e-5)
        fix.node_from_robot = fix.node_from_robot @ step
        fix.blind += abs(motion.forward) + 0.3 * abs(motion.turn)

    def _target_from_reference(self, reference: int, target: int) -> Pose2:
        """`target_from_reference` along the route's measured edges."""
        pose = Pose2()
        if target >= reference:
            for leg in self.route[reference + 1 : target + 1]:
                pose = pose @ leg.previous_from_node.mean
            return pose.inverse()
        for leg in self.route[target + 1 : reference + 1]:
            pose = pose @ leg.previous_from_node.mean
        return pose

    def _passed(self, index: int) -> bool:
        fix = self.fix
        assert fix is not None
        return math.hypot(fix.node_from_robot.mean.x, fix.node_from_robot.mean.y) < 2 * self._settings.passed

    # Small things

    def _toward(self, target_from_robot: Pose2) -> Command:
        """Turn toward a position, then drive straight to it; around what the rangers have seen in between."""
        s = self._settings
        there = target_from_robot.inverse()
        here = self._odom_from_robot
        start, goal = np.array([here.x, here.y]), here.apply(np.array([there.x, there.y]))
        while self._detour and np.linalg.norm(self._detour[0] - start) < 0.08:
            self._detour.pop(0)
        if self._tick >= self._replan or (self._detour and not self._floor.clear(start, self._detour[0])):
            self._replan = self._tick + s.replan_every
            reach = 2.0 * math.hypot(there.x, there.y) + 1.0
            straight = self._floor.clear(start, goal)
            self._detour = [] if straight else self._floor.corners(start, goal, reach)
        if self._detour:
            self.detail += ", around an obstacle"
            corner = here.inverse().apply(self._detour[0])
            there = Pose2(float(corner[0]), float(corner[1]))
        error = math.atan2(there.y, there.x)
        speed = min(s.speed, 0.8 * math.hypot(there.x, there.y)) * max(0.0, 1.0 - abs(error) / 0.4)
        return Command(speed, float(np.clip(1.8 * error, -s.turn_rate, s.turn_rate)))

    def _visible(self, localizer: Localizer) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        mask = np.zeros(len(localizer.node.landmarks), bool)
        mask[localizer.visible] = True
        return mask

    def _ask(self, question: Question) -> Generator[Command, None, Answer]:
        self._questions.append(question)
        for _ in range(self._settings.answer_patience):
            yield Command()
            if question.number in self._answers:
                return self._answers.pop(question.number)
        return Answer(question.number, None, "nobody answered: is the map server up?")

    def _number(self) -> int:
        self._next_question += 1
        return self._next_question - 1

    def _wait(self, seconds: float) -> Behaviour:
        for _ in range(max(1, round(seconds / self._description.tick))):
            yield Command()

    def _turn(self, angle: float) -> Behaviour:
        turned, rate = 0.0, math.copysign(self._settings.turn_rate, angle)
        while abs(turned) < abs(angle):
            yield Command(0.0, rate)
            turned += self._now.odometry.turn

    @property
    def _now(self) -> Observation:
        assert self._observation is not None
        return self._observation

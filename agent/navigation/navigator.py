"""Navigation: localize, get a route, follow it, and again if the robot gets lost."""

from collections.abc import Callable, Generator
from dataclasses import replace
from enum import StrEnum
from functools import partial

import numpy as np

from mapweave.agent.edge_measurement.landmark_refinement import LandmarkRefinement
from mapweave.agent.edge_measurement.traverse import Traverse, TraverseRecorder
from mapweave.agent.localization.fix import Fix
from mapweave.agent.mission import GoTo, Question, ServerAnswer
from mapweave.agent.motion_primitives import Behaviour, MotionPrimitives
from mapweave.agent.navigation.answer_trial import AnswerTrial
from mapweave.agent.navigation.blocks import Blocks
from mapweave.agent.navigation.goal_patience import GoalPatience
from mapweave.agent.navigation.local_planner import LocalPlanner
from mapweave.agent.navigation.obstruction import obstruction
from mapweave.agent.navigation.portal_crossing import PortalCrossing
from mapweave.agent.navigation.positioning import Positioning
from mapweave.agent.navigation.right_of_way import Passage, RightOfWay
from mapweave.agent.navigation.route_follower import NEAR, RouteFollower, RouteProgress
from mapweave.agent.navigation.route_source import RouteSource
from mapweave.agent.observation import Command, Observation, RobotDescription
from mapweave.agent.robots_in_view import RobotBeside
from mapweave.agent.settings import AgentSettings
from mapweave.hybridmap.drive_statistics import DriveStatistics
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.portal import PortalStop
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import RouteAnswer, RouteLeg
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Sift


class NavigationStage(StrEnum):
    """What navigation is doing, in words for people."""

    LOST = "turning to localize"
    ASKING = "asking for a route"
    BLOCKED = "waiting at an obstacle"
    WAITING = "waiting for a route"
    YIELDING = "waiting for another robot"
    ASIDE = "stepping aside for another robot"
    PORTAL = "waiting at a portal"
    ARRIVED = "parked at the goal"
    GIVEN_UP = "gave up its goal"


HIDDEN = ", twice by what is seen of nodes nearby; of its own landmarks not enough is recognised"
UNDERWAY = (RouteProgress.DRIVING, RouteProgress.PARKING)

ANSWER_PATIENCE = 100
"""Ticks that an answer may take before the question counts as lost."""
PAUSE = 2.0
"""How long it waits before what is in its way, and before it asks again for a route, s."""
THERE = 0.05
"""It has stepped aside within this distance of the node, m: others pass with a margin of 0.1 m."""
TRUSTED = 1.0
"""After a block it still knows where it is if it has driven less than this blindly, m."""


class Navigator:
    """Brings the robot to a goal node. The kidnapped robot of the paper is the same case: it starts lost.

    Attributes:
        stage: what it is doing, in words.
        detail: why.
        fix: where the robot is, or None while lost.
        goal: the node to reach.
        crossing: where it stands with the portals on its way.
        passed: nodes to pass before that it has passed.
        legs: nodes on the first route that was given.
        progress: share of the present route that is driven.
        statistics: of the drive so far.
        losses: how often it did not see where it is for so long that it took itself for lost.
        traverse: from one node to another, if the last step has ended one.
        refined: a node of the own map that was refined by the last step, if any.
    """

    def __init__(
        self,
        description: RobotDescription,
        lens: Lens,
        sift: Sift,
        own_map: HybridMap,
        goal: NodeId,
        settings: AgentSettings | None = None,
        seed: int = 0,
        via: tuple[NodeId, ...] = (),
        crossing: PortalCrossing | None = None,
        near: NodeId | None = None,
        beside: Callable[[], RobotBeside | None] = lambda: None,
        first: int = 1,
    ) -> None:
        """Start lost, or at a portal, with a goal and nodes to pass before, in order.

        The robot is on the floor of the node `near`, if that is known. `beside` is the robot next to it,
        if there is one. Its questions are numbered from `first`.
        """
        self.stage: str = NavigationStage.LOST
        self.detail = ""
        self.fix: Fix | None = None
        self.goal = goal
        self.crossing = crossing or PortalCrossing()
        self.passed = 0
        self._via = list(via)
        self.legs = 0
        self.progress = 0.0
        self.statistics = DriveStatistics()
        self.losses = 0
        self.traverse: Traverse | None = None
        self.refined: Node | None = None
        self._description = description
        self._settings = s = settings or AgentSettings()
        rng = np.random.default_rng(seed)
        self._planner = planner = LocalPlanner(description, s.navigation)
        self._follower = partial(RouteFollower, description, lens, sift, detour=planner, settings=s, rng=rng)
        self._motion = MotionPrimitives(description, ANSWER_PATIENCE, first)
        self._routes = RouteSource(self._motion, own_map, description)
        self._positioning = Positioning(description, lens, sift, own_map, self._motion, s, rng, near)
        self._trial = AnswerTrial(self._motion, self._positioning.refuted)
        self._blocks = Blocks(s.navigation)
        self._patience = GoalPatience(s.navigation.patience)
        self._beside = beside
        self._traverse_recorder = TraverseRecorder(description)
        self._refinement = LandmarkRefinement(own_map)
        self._expected: Pose2 | None = None
        self._goal_hidden = False
        self._following = self._parking_retried = False
        self._touched = self._detour = ""
        self._portal: PortalStop | None = None
        self._aside: tuple[NodeId, str] | None = None  # where to, and for which robot
        self._behaviour = self._go()

    @property
    def refuted(self) -> int:
        """Answers of the fleet that the robot's view did not bear out, on this mission."""
        return self._positioning.refuted.count

    @property
    def next_number(self) -> int:
        """That none of its questions has."""
        return self._motion.next_number

    @property
    def arrived(self) -> bool:
        """Whether the robot is parked at the goal."""
        return self.stage == NavigationStage.ARRIVED

    def taken_up(self, mission: GoTo) -> GoTo:
        """Its mission, from where it is with it now."""
        wait = None if self.given_up else self.crossing.wait
        return replace(mission, passed=mission.passed + self.passed, portal=wait)

    @property
    def given_up(self) -> bool:
        """Whether the robot stands, since the goal cannot be reached; `detail` is the reason."""
        return self.stage == NavigationStage.GIVEN_UP

    def step(
        self, observation: Observation, answers: tuple[ServerAnswer, ...], standing: bool = False
    ) -> tuple[Command, list[Question]]:
        """One tick: returns what the wheels shall do and what to ask the fleet's map.

        Args:
            observation: what the robot senses now.
            answers: that have come.
            standing: the robot must not move; the behaviour waits, and the fix is updated.
        """
        self._motion.take_in(observation, answers)
        self._planner.see(observation)
        at_portal = self.crossing.wait is not None
        if self.fix is not None and not at_portal and (standing or not self._following):
            self.fix.follow(observation, self._description)
        if standing or at_portal:
            self._patience.pause(self._description.tick)
        elif not self.arrived:
            reason = self._patience.ended(self._beside(), self._motion.now) or self._trial.ended
            if reason:
                self._give_up(reason)
        command = Command() if standing else next(self._behaviour)
        fix = None if self._positioning.search or self.crossing.wait else self.fix
        if fix is not None:
            self._positioning.keep(fix)
        self.traverse = self._traverse_recorder.see(fix, observation)
        self.refined = self._refinement.see(None if self.arrived else fix)
        if self._positioning.search:
            self.detail = self._positioning.detail
        return command, self._motion.questions()

    def touch(self, what: str) -> None:
        """Something was touched, in words: the present edge is blocked."""
        self._touched = what

    # Behaviours: each yields a command a tick, so the order of actions reads from top to bottom.

    def _go(self) -> Behaviour:
        while not (self.arrived or self.given_up):
            if self.crossing.wait is not None:
                yield from self._cross()
                continue
            if self.fix is None:
                yield from self._find()
            assert self.fix is not None, "the search ends with a fix"
            answer = yield from self._get_route(self.fix, self._via[0] if self._via else self.goal)
            route, self._portal = answer.legs, answer.portal
            self.crossing.check(self._portal)
            if (undriven := self._routes.undriven(route)) is not None:
                yield from self._avoid(*undriven)
            elif route:
                self._patience.refused_since = None
                yield from self._follow(route, self.fix)
                if self._aside is not None and self.fix is not None:
                    yield from self._step_aside(self.fix, *self._aside)
            else:
                yield from self._wait_for_a_way()
        yield from self._stand()

    def _stand(self) -> Behaviour:
        while True:
            yield Command()

    def _give_up(self, reason: str) -> None:
        """Stand, and say why."""
        if not self.given_up:
            self.stage, self.detail = NavigationStage.GIVEN_UP, reason
            self._positioning.search, self._following = None, False
            self._behaviour = self._stand()

    def _cross(self) -> Behaviour:
        """Ask to be taken through a portal; then look where it is."""
        crossing = self.crossing
        while crossing.wait is not None and not crossing.wait.done:
            if late := crossing.late(self._motion.now):
                self._give_up(late)
                return
            self.stage, self.detail = NavigationStage.PORTAL, crossing.request
            yield Command()
        if crossing.wait is None:
            return
        self.stage, self.fix = NavigationStage.LOST, None
        self._start_from((yield from self._positioning.find_beyond(crossing)))
        crossing.looked(self.fix is not None)

    def _find(self) -> Behaviour:
        self.stage, self._goal_hidden = NavigationStage.LOST, False
        self._patience.trouble = "it does not know where it is"
        expected, self._expected = self._expected, None
        self._start_from((yield from self._positioning.find(expected)))

    def _start_from(self, fix: Fix | None) -> None:
        """Go on from where the robot was found, if it was."""
        self.detail, self.fix = self._positioning.detail, fix
        self._trial.found(self._positioning.place)
        if fix is not None:
            self.statistics = self.statistics.found()

    def _get_route(self, fix: Fix, goal: NodeId) -> Generator[Command, None, RouteAnswer]:
        """Ask for a way."""
        self.stage = NavigationStage.ASKING
        answer = yield from self._routes.route(fix, goal, self._blocks)
        self.detail, self._detour = answer.reason, answer.detour
        if not answer.legs:
            self._patience.trouble = self.detail
        self.legs = self.legs or len(answer.legs)
        return answer

    def _avoid(self, a: NodeId, b: NodeId) -> Behaviour:
        """Leave out a leg that is not driven without rangers. A fleet that insists on it is asked seldom."""
        named = (min(a, b), max(a, b)) in self._blocks.pairs(self._motion.now)
        self._blocks.add(a, b, self._motion.now)
        self._patience.trouble = f"no robot has driven between {a} and {b}, and this one has no rangers"
        if named:
            self.stage, self.detail = NavigationStage.WAITING, self._patience.trouble
            yield from self._motion.stand(PAUSE)

    def _wait_for_a_way(self) -> Behaviour:
        """Without a route: obstacles may go away, or a server come back; or the robot's pose is wrong."""
        self.stage, now, patience = NavigationStage.WAITING, self._motion.now, self._patience
        if not (self._blocks.pairs(now) or self._blocks.obstacles(now)) and patience.refused_since is None:
            self.fix, patience.refused_since = None, now
        elif reason := patience.refused(self._routes.refusing, now):
            self._give_up(reason)
        yield from self._motion.stand(PAUSE)

    def _follow(self, route: tuple[RouteLeg, ...], fix: Fix) -> Behaviour:
        """Follow a route until it is driven, or blocked, or the robot is lost."""
        if self._trial.node is not None:
            fix = self._positioning.compared(route, fix)
        follower = self._follower(route=route, fix=fix)
        self._trial.took(route, fix)
        right_of_way = RightOfWay(self._motion, [leg.node.id for leg in route])
        self._touched = ""
        while True:
            if not (yield from self._let_pass(right_of_way, follower)):
                return
            leg = follower.leg
            self._patience.drive(follower.blocked, self._beside(), self._motion.now)
            command = follower.step(self._motion.observation)
            self.fix, self.stage = follower.fix, follower.progress
            self.detail = "; ".join(filter(None, (follower.detail, self._detour)))
            self.progress = follower.leg / len(route)
            self.statistics = self.statistics.passed([follower.distance(k) for k in range(leg, follower.leg)])
            if follower.fix.in_sight:
                self._positioning.failed_views = 0
                self._trial.saw(follower.fix.node)
            if self._via and self._portal is None and follower.to_goal <= THERE:
                del self._via[0]
                self.passed += 1
                self._following = False
                self._reach_stop()
                return
            if self._touched:
                follower.progress = RouteProgress.BLOCKED
            if follower.progress not in UNDERWAY:
                break
            yield command
        self._following = False
        # By landmarks seen a moment ago; a look that showed nothing is no such sight.
        blind, allowed = follower.fix.blind, self._settings.navigation.blind_distance
        known = blind < allowed and not self._positioning.failed_views
        match follower.progress:
            case RouteProgress.ARRIVED:
                self._reach()
            case RouteProgress.BLOCKED:
                yield from self._report_block(follower)
            case RouteProgress.UNSURE if (
                self._goal_hidden
                and self._trial.node is None
                and not (self._via and self._portal is None)
                and known
            ):
                self.stage = NavigationStage.ARRIVED
                self.detail = f"at the goal, {follower.off_goal}{HIDDEN}"
                self._reach()
            case RouteProgress.UNSURE:
                # It is at the goal by what it knows, yet it sees none of the goal's landmarks.
                self._goal_hidden |= known
                if self._trial.node is not None or not (self._trial.borne_out or blind < allowed):
                    self._trial.refute(blind)
                yield from self._relocalize()

    def _reach(self) -> None:
        """The robot is where the route ends: at the goal, or at a portal on the way there."""
        self.statistics = self.statistics.passed([0.0])
        if self._portal is not None:
            self._reach_stop()
            self.stage = NavigationStage.PORTAL
            self.crossing.begin(self._portal)

    def _reach_stop(self) -> None:
        """What was driven until here says nothing of the way on."""
        self._trial, self._goal_hidden = AnswerTrial(self._motion, self._positioning.refuted), False
        self._patience.reach(self._motion.now)

    def _let_pass(self, right_of_way: RightOfWay, follower: RouteFollower) -> Generator[Command, None, bool]:
        """Stand while another robot holds the way ahead; returns whether to go on then.

        Where the way ahead is closed by a person, another one is asked for at once.
        """
        passage = right_of_way.passage(follower.leg, follower.fix)
        if self._following and passage is not Passage.FREE:
            # It stops only now: the wheels have turned until here.
            follower.fix.follow(self._motion.observation, self._description)
        self._following = False
        while passage is Passage.HELD:
            if right_of_way.holder:
                self.stage, self.detail = NavigationStage.YIELDING, right_of_way.reason
                self._patience.trouble = f"{right_of_way.holder} is in the way"
            yield Command()
            passage = right_of_way.passage(follower.leg, follower.fix)
        self._following = passage is Passage.FREE
        aside = right_of_way.aside if passage is Passage.ASIDE else None
        self._aside = None if aside is None else (aside, right_of_way.holder)
        if passage is Passage.CLOSED:
            self._patience.trouble = self.detail = right_of_way.reason
        elif passage is Passage.STUCK:
            if right_of_way.occupied and follower.blocked[1] in (self.goal, *self._via[:1]):
                self._give_up(right_of_way.reason)
            else:
                # It is stuck, or stands there: another way may be free.
                self._blocks.add(*follower.blocked, self._motion.now)
        return self._following

    def _step_aside(self, fix: Fix, node: NodeId, other: str) -> Behaviour:
        """Drive to a node off another robot's way; then the way to the goal is asked for again."""
        self._aside = None
        route = (yield from self._get_route(fix, node)).legs
        if not route:
            yield from self._motion.stand(PAUSE)
            return
        follower = self._follower(route=route, fix=fix)
        right_of_way = RightOfWay(self._motion, [leg.node.id for leg in route])
        while follower.to_goal > THERE and (yield from self._let_pass(right_of_way, follower)):
            command = follower.step(self._motion.observation)
            self.fix, self.stage = follower.fix, NavigationStage.ASIDE
            self.detail = f"{other} is to pass; {follower.detail}"
            if follower.to_goal <= THERE or follower.progress not in UNDERWAY:
                break
            yield command
        self._following = False

    def _report_block(self, follower: RouteFollower) -> Behaviour:
        """Something is in the way: report it, wait, then plan another route."""
        (a, b), now = follower.blocked, self._motion.now
        words, obstacle = obstruction(
            self._description, self._motion.observation, follower.fix, follower.robot_from_target,
            follower.to_goal, self._touched, self._beside(),
        )  # fmt: skip
        if obstacle is None and follower.to_goal <= NEAR and not self._parking_retried:
            # Nothing keeps it from its goal but its own precision: that blocks no other robot.
            self.detail, self._parking_retried = "parking did not end: trying once more", True
            return
        self._trial.blocked()
        self._blocks.add(a, b, now, obstacle)
        self.statistics = self.statistics.blocked()
        where = f"between {a} and {b}" if a != b else f"on the way to {b}"
        self._patience.block(where, obstacle.robot if obstacle else "", now)
        self.stage, self.detail = NavigationStage.BLOCKED, f"{where}: {words}"
        self._patience.trouble = self.detail
        yield from self._motion.stand(PAUSE)
        lost = self.fix is not None and not self.fix.in_sight and self.fix.blind > TRUSTED
        # Parking did not end twice: localize again, so that it begins from another heading.
        if lost or self._parking_retried:
            self._parking_retried = False
            self._lose()

    def _lose(self) -> None:
        """It no longer knows where it is, but about where it should be."""
        self.fix, self._expected = None, self._positioning.on_own_map(self.fix)

    def _relocalize(self) -> Behaviour:
        """No landmark was visible for a while: try one view, else drive on by odometry a little."""
        before = self.fix
        fix = yield from self._positioning.look(before, self.detail)
        if fix is not None and self._positioning.place is None:
            self.fix = fix
            return
        if fix is None:
            self.losses += 1
            self._expected = self._positioning.on_own_map(before)
        self._start_from(fix)

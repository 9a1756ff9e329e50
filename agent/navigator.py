"""Navigation in the large: find out where the robot is, get a route, follow it, and again if it is lost."""

from __future__ import annotations

import math
from collections.abc import Generator
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from agent.detour import Detour, DetourSettings
from agent.fix import Fix
from agent.follower import Follower, FollowerSettings, Progress
from agent.localizer import Localizer
from agent.mission import Answer, Question, WhereAmI, WhichWay
from agent.observation import Command, Observation, RobotDescription
from agent.recall import exact_enough, recall
from agent.vision.lens import Lens
from agent.vision.sift import Sift
from hybridmap.hybrid_map import HybridMap
from hybridmap.node import NodeId
from hybridmap.pose import PoseGaussian
from hybridmap.query import Certainty, RelocalizeAnswer, RouteAnswer, RouteLeg


@dataclass(frozen=True)
class NavigatorSettings:
    """How the robot navigates.

    Attributes:
        follower: along a route.
        detour: between nodes.
        look_turn: between two looks of a lost robot, rad.
        turn_rate: of that turn, rad/s.
        least_features: a view with fewer is not worth a question.
        sure: standard deviations up to which a lost robot believes a recognition at once, m and rad; the
            longer it has looked around, the less it asks for: twice as much after a whole turn.
        answer_patience: ticks that an answer may take before the question counts as lost.
        pause: seconds before a lost robot without a route asks again.
    """

    follower: FollowerSettings = field(default_factory=FollowerSettings)
    detour: DetourSettings = field(default_factory=DetourSettings)
    look_turn: float = 0.5
    turn_rate: float = 0.6
    least_features: int = 8
    sure: tuple[float, float] = (0.03, 0.018)
    answer_patience: int = 100
    pause: float = 2.0


class Stage(StrEnum):
    """What the navigator is doing while it follows no route."""

    LOST = "looking around to find out where it is"
    ASKING = "asking for a route"
    ARRIVED = "parked at the goal"


Behaviour = Generator[Command, None, None]


class Navigator:
    """Brings the robot to a goal node. The kidnapped robot of the paper is the same path: it starts lost.

    Attributes:
        stage: what it is doing, in words.
        detail: why.
        fix: where the robot is, or None while lost.
        goal: where it shall be.
        legs: nodes on the first route that was given.
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
        self.stage: str = Stage.LOST
        self.detail = ""
        self.fix: Fix | None = None
        self.goal = goal
        self.legs = 0
        self._description = description
        self._lens = lens
        self._sift = sift
        self._own_map = own_map
        self._settings = settings or NavigatorSettings()
        self._rng = np.random.default_rng(seed)
        self._detour = Detour(description, self._settings.detour)
        self._observation: Observation | None = None
        self._answers: dict[int, Answer] = {}
        self._questions: list[Question] = []
        self._next_question = 1
        self._blocked: list[tuple[NodeId, NodeId]] = []
        self._following = False
        self._looked = 0.0
        self._behaviour = self._go()

    @property
    def arrived(self) -> bool:
        """Whether the robot is parked at the goal."""
        return self.stage == Stage.ARRIVED

    def step(self, observation: Observation, answers: tuple[Answer, ...]) -> tuple[Command, list[Question]]:
        """One tick: returns what the wheels shall do and what to ask the fleet's map."""
        self._observation = observation
        self._answers.update({answer.number: answer for answer in answers})
        self._questions = []
        self._detour.see(observation)
        if self.fix is not None and not self._following:
            self.fix.follow(observation, self._description)
        return next(self._behaviour), self._questions

    # Behaviours: each yields a command a tick, so the order of actions reads from top to bottom.

    def _go(self) -> Behaviour:
        while not self.arrived:
            if self.fix is None:
                yield from self._look_around()
                continue
            route = yield from self._get_route(self.fix)
            if route:
                yield from self._follow(route, self.fix)
            else:
                # What was in the way may have gone; otherwise the robot would stand here for ever.
                self._blocked.clear()
                self.fix = None
                yield from self._wait(self._settings.pause)
        while True:
            yield Command()

    def _look_around(self) -> Behaviour:
        """Look, ask, turn a little, until somebody knows the view."""
        self.stage, self.detail = Stage.LOST, "looking"
        self._looked = 0.0
        while True:
            yield from self._wait(0.2)
            if (yield from self._relocalize()):
                return
            yield from self._turn(self._settings.look_turn)
            self._looked += self._settings.look_turn

    def _relocalize(self) -> Generator[Command, None, bool]:
        """Recognise the current view on the own map, else ask the fleet's; sets `fix` if it is known."""
        image = self._now.image
        if image is None:
            self.detail = "no image from the camera"
            return False
        features = self._sift.extract(image)
        if len(features) < self._settings.least_features:
            self.detail = f"only {len(features)} features in view"
            return False
        view = features.view(self._description.camera)
        own = recall(self._own_map, view, self._rng)
        if own is not None and self._sure(own[1].node_from_robot):
            node, recognition = own
            settings = self._settings.follower.localizer
            localizer = Localizer(self._description, self._lens, node, image, features, recognition, settings)
            self.fix = Fix.of(localizer)
            self.detail = f"own map: node {node.id}, {recognition.inliers} landmarks agree"
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
            self.detail += ", but not exactly enough"
            return False
        # The robot has stood still while the answer was on its way.
        self.fix = Fix(best.node, best.node_from_robot)
        return True

    def _get_route(self, fix: Fix) -> Generator[Command, None, tuple[RouteLeg, ...]]:
        self.stage = Stage.ASKING
        here = fix.node_from_robot.mean
        question = WhichWay(self._number(), fix.node, self.goal, here, tuple(self._blocked))
        answer = yield from self._ask(question)
        if not isinstance(answer.content, RouteAnswer):
            self.detail = answer.error or "no answer"
            return ()
        self.detail = answer.content.reason
        self.legs = self.legs or len(answer.content.legs)
        return answer.content.legs

    def _follow(self, route: tuple[RouteLeg, ...], fix: Fix) -> Behaviour:
        """Follow a route until it is driven, or the robot is lost, or knows itself somewhere else."""
        follower = Follower(
            self._description, self._lens, self._sift, route, fix, self._detour, self._settings.follower,
            self._rng,
        )  # fmt: skip
        self._following = True
        while True:
            command = follower.step(self._now)
            self.fix, self.stage, self.detail = follower.fix, follower.progress, follower.detail
            match follower.progress:
                case Progress.ARRIVED:
                    break
                case Progress.BLOCKED:
                    self._blocked.append(follower.blocked)
                    self.fix = None
                    break
                case Progress.UNSURE:
                    self._following = False
                    yield from self._wait(0.2)
                    if not (yield from self._relocalize()):
                        self.fix = None
                    break
            yield command
        self._following = False

    # Small things

    def _sure(self, posture: PoseGaussian) -> bool:
        """Whether a recognition is exact enough to drive by; else another look, elsewhere, costs little."""
        return exact_enough(posture, self._settings.sure, 1.0 + self._looked / math.tau)

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

"""A navigator, eyes that see known landmarks, and a fleet whose answers are scripted."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mapweave import HybridMap, Landmarks, MapId, Node, NodeId, Pose2, PoseGaussian
from mapweave.agent.mission import MayIDrive, Question, ServerAnswer, WhereAmI, WhichWay
from mapweave.agent.motion_primitives import NO_ANSWER
from mapweave.agent.navigation.navigator import Navigator
from mapweave.agent.observation import Command, Observation, Odometry, RobotDescription
from mapweave.agent.robots_in_view import RobotBeside
from mapweave.agent.settings import AgentSettings, NavigatorSettings
from mapweave.hybridmap.query import Certainty, RelocalizeAnswer, RouteAnswer, RouteLeg, Whereabouts
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Features
from synthetic.maps import changes_of
from synthetic.world import CAMERA, World, room, take_map, take_view

BEARINGS = tuple(np.linspace(-math.pi, math.pi, 16, endpoint=False).tolist())
BODY = RobotDescription(CAMERA, ranger_bearings=BEARINGS, ranger_reach=3.0)
FREE = np.full(len(BEARINGS), 3.0)
WALL_AHEAD = np.where(np.cos(BEARINGS) > 0.8, 0.06, 3.0)
EXACT = np.diag([1e-4, 1e-4, 1e-5])
IMAGE = np.zeros((240, 320), np.uint8)
TOUR = [Pose2(1.0 + 1.2 * k, 2.0) for k in range(3)]
Fleet = Callable[[Question], ServerAnswer]


def home_world() -> World:
    """A room."""
    return room(0, 0, 5, 4, 900, np.random.default_rng(0))


def home_map(home: World) -> HybridMap:
    """Three nodes in a row, 1.2 m apart."""
    return HybridMap(
        changes_of(*take_map(home, MapId("r0", 1), TOUR, np.random.default_rng(2), sigma_xy=0.002))
    )


class Eyes:
    """Sees features of a world from where the robot is; takes the place of Sift."""

    def __init__(self, world: World, pose: Pose2) -> None:
        self.world, self.pose = world, pose
        self.rng = np.random.default_rng(3)

    def extract(self, image: np.ndarray, left_out: object = None) -> Features:
        view, _ = take_view(self.world, self.pose, self.rng)
        pixels = view.pixels.astype(np.float64)
        return Features(pixels, pixels, view.codes, np.ones(len(view)))


class Trial:
    """A navigator, a base that executes its commands unless it is held, and a scripted fleet."""

    def __init__(
        self, navigator: Navigator, eyes: Eyes, fleet: Fleet, proximity: np.ndarray = FREE, held: bool = False
    ) -> None:
        self.navigator, self.eyes, self.fleet = navigator, eyes, fleet
        self.proximity, self.held = proximity, held
        self.asked: list[Question] = []
        self.commands: list[Command] = []
        self.said: list[tuple[str, str]] = []
        self.traffic: Fleet = lambda question: ServerAnswer(question.number, None, "no map server answered")
        self._moved = Odometry(0.0, 0.0)
        self._answers: tuple[ServerAnswer, ...] = ()

    @property
    def ways(self) -> list[WhichWay]:
        """The ways that it has asked for."""
        return [question for question in self.asked if isinstance(question, WhichWay)]

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        for tick in range(round(seconds / BODY.tick)):
            observation = Observation(tick * 100_000_000, self._moved, IMAGE, self.proximity)
            command, questions = self.navigator.step(observation, self._answers)
            self.commands.append(command)
            saying = (str(self.navigator.stage), self.navigator.detail)
            if not self.said or self.said[-1] != saying:
                self.said.append(saying)
            traffic = [question for question in questions if isinstance(question, MayIDrive)]
            others = [question for question in questions if not isinstance(question, MayIDrive)]
            self.asked += others
            self._answers = (*map(self.fleet, others), *map(self.traffic, traffic))
            share = 0.0 if self.held else BODY.tick
            self._moved = Odometry(command.forward * share, command.turn * share)
            self.eyes.pose = self.eyes.pose @ self._moved.motion()
            if until():
                return


def navigator(
    eyes: Eyes,
    own: HybridMap,
    goal: NodeId,
    settings: NavigatorSettings | None = None,
    body: RobotDescription = BODY,
    via: tuple[NodeId, ...] = (),
    beside: Callable[[], RobotBeside | None] = lambda: None,
) -> Navigator:
    every = AgentSettings(navigation=settings or NavigatorSettings())
    return Navigator(body, Lens(BODY.camera, BODY.distortion), eyes, own, goal, every, via=via, beside=beside)  # type: ignore[arg-type]


def here(node: NodeId, node_from_robot: Pose2) -> Whereabouts:
    return Whereabouts(node, PoseGaussian(node_from_robot, EXACT), None, 0, 30, 0.99)


def at(*places: Whereabouts) -> RelocalizeAnswer:
    """One place is found; several are ambiguous; none is unknown."""
    certainty = (Certainty.UNKNOWN, Certainty.FOUND)[len(places)] if len(places) < 2 else Certainty.AMBIGUOUS
    return RelocalizeAnswer(certainty, places, "it may be a or b")


def found(question: Question, *places: Whereabouts) -> ServerAnswer:
    return ServerAnswer(question.number, at(*places))


def bare(node_id: NodeId) -> Node:
    """A node that shows nothing."""
    rng = np.random.default_rng(0)
    nodes, _ = take_map(room(0, 0, 5, 4, 1, rng), node_id.map, [Pose2()], rng)
    some = nodes[0].landmarks
    landmarks = Landmarks(some.pixels[:0], some.codes[:0], some.depths[:0], some.depth_sigmas[:0])
    return replace(nodes[0], id=node_id, landmarks=landmarks)


A, B, C = (NodeId("s", 1, number) for number in (1, 3, 5))
NOWHERE = HybridMap()


def straight(start: Node, *others: Node, step: float = 1.5) -> tuple[RouteLeg, ...]:
    """A route whose nodes stand one behind the other, straight ahead."""
    legs = [RouteLeg(start, PoseGaussian(Pose2(), np.zeros((3, 3))), None)]
    return (*legs, *(RouteLeg(node, PoseGaussian(Pose2(step), EXACT), None) for node in others))


def a_way(*nodes: Node | NodeId, step: float = 1.5) -> RouteAnswer:
    """A route straight ahead; of a node that is given by its id nothing is to be seen."""
    seen = [node if isinstance(node, Node) else bare(node) for node in nodes]
    return RouteAnswer(straight(*seen, step=step), "a way")


def only_a_to_b(question: WhichWay) -> RouteAnswer:
    """The one way there is."""
    blocked = {A, B} in map(set, question.blocked)
    return RouteAnswer((), "every way is blocked") if blocked else a_way(A, B)


def answering(
    way: Callable[[WhichWay], RouteAnswer | None],
    where: Callable[[], RelocalizeAnswer] = lambda: at(here(A, Pose2())),
) -> Fleet:
    """A fleet that answers each question; the robot is at A where no place is given."""

    def fleet(question: Question) -> ServerAnswer:
        if isinstance(question, WhereAmI):
            return ServerAnswer(question.number, where())
        assert isinstance(question, WhichWay)
        route = way(question)
        return ServerAnswer(question.number, route, "" if route else NO_ANSWER)

    return fleet

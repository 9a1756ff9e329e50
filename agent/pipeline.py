r"""One robot's whole pipeline: observation in, command and map changes out. Read this first.

    image, odometry, proximity -> mapper (tracks, EKF, nodes) -> changes
                               -> floor                        \
    mission ------------------> explorer | passenger | navigator -> guard -> command

It knows no network, no disk and no clock: live robots, recordings, simulation and tests run this very code.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from agent.explorer import Explorer, ExplorerSettings
from agent.floor import Floor, FloorSettings
from agent.mapper import Mapper, MapperSettings
from agent.mission import Answer, Carried, Explore, GoTo, Idle, Mission, Question
from agent.navigator import Navigator, NavigatorSettings
from agent.observation import Command, Observation, RobotDescription
from agent.passenger import Passenger, PassengerSettings
from agent.servo.proximity import guard
from agent.vision.lens import Lens
from agent.vision.sift import Sift
from hybridmap.change import ChangeBody
from hybridmap.hybrid_map import HybridMap
from hybridmap.node import MapId, NodeId
from hybridmap.pose import Pose2

IDENTITY = Pose2()


@dataclass(frozen=True)
class PipelineSettings:
    """Settings of the parts."""

    mapper: MapperSettings = field(default_factory=MapperSettings)
    explorer: ExplorerSettings = field(default_factory=ExplorerSettings)
    passenger: PassengerSettings = field(default_factory=PassengerSettings)
    navigator: NavigatorSettings = field(default_factory=NavigatorSettings)
    floor: FloorSettings = field(default_factory=FloorSettings)
    seed: int = 0


@dataclass(frozen=True)
class Status:
    """What the robot is doing, for people.

    Attributes:
        doing: in words.
        detail: why, or how far.
        nodes: nodes of the own map.
        tracked: features tracked in the image.
        map_from_robot: where the robot believes to be in its own map while mapping.
        finished: whether the mission is complete.
        mission: its name.
        fix_node: the node that the robot knows itself by while navigating.
        node_from_robot: posture in that node's frame.
        legs: nodes on the first route of the drive, beginning and goal included.
    """

    doing: str
    detail: str
    nodes: int
    tracked: int
    map_from_robot: Pose2
    finished: bool
    mission: str = "idle"
    fix_node: NodeId | None = None
    node_from_robot: Pose2 = IDENTITY
    legs: int = 0


@dataclass(frozen=True)
class Step:
    """What one tick gives.

    Attributes:
        command: for the wheels; already safe by the proximity sensors.
        changes: to the map, in order.
        questions: for the fleet's map; answers come with a later observation.
        status: for people.
    """

    command: Command
    changes: tuple[ChangeBody, ...]
    questions: tuple[Question, ...]
    status: Status


class Pipeline:
    """The robot's mind."""

    def __init__(
        self, map_id: MapId, description: RobotDescription, settings: PipelineSettings | None = None
    ) -> None:
        """Start with an empty map and nothing to do."""
        self._settings = settings or PipelineSettings()
        self._description = description
        lens = Lens(description)
        self._lens = lens
        self._sift = Sift(lens, self._settings.mapper.sift)
        self._mapper = Mapper(map_id, description, self._settings.mapper)
        self._floor = Floor(description, self._settings.floor)
        self._mission: Mission = Idle()
        self._explorer: Explorer | None = None
        self._passenger: Passenger | None = None
        self._navigator: Navigator | None = None
        self._refusal = ""
        self._direction = 1.0

    @property
    def map(self) -> HybridMap:
        """The robot's own map so far."""
        return self._mapper.map

    @property
    def mission(self) -> Mission:
        """What the robot shall do."""
        return self._mission

    def set_mission(self, mission: Mission) -> None:
        """Begin another mission. Exploration that was interrupted goes on where it was.

        A robot that has navigated does not map on: it may have been carried anywhere in between, and the
        next edge would be false. It stands still and says so.
        """
        self._refusal = ""
        if self._navigator is not None and isinstance(mission, Explore | Carried):
            self._refusal = "it has navigated since it mapped: start the agent anew to map on, in a new map"
            mission = Idle()
        self._mission = mission
        match mission:
            case Explore() if self._explorer is None:
                self._explorer = Explorer(
                    self._description, self._mapper, self._floor, self._settings.explorer, self._settings.seed
                )
            case Carried() if self._passenger is None:
                self._passenger = Passenger(self._mapper, self._settings.passenger)
            case GoTo(goal):
                self._navigator = Navigator(
                    self._description, self._lens, self._sift, self.map, goal, self._settings.navigator,
                    self._settings.seed,
                )  # fmt: skip

    def step(self, observation: Observation, answers: tuple[Answer, ...] = ()) -> Step:
        """Take one observation and decide.

        Args:
            observation: what the robot senses now.
            answers: to questions of earlier steps.
        """
        command, changes, questions = Command(), list[ChangeBody](), list[Question]()
        match self._mission:
            case Idle() if self._mapper.started:
                # Whoever goes on mapping later needs to know what the wheels did meanwhile.
                self._mapper.step(observation)
            case Explore() if self._explorer is not None:
                self._mapper.step(observation)
                self._floor.see(self._mapper.map_from_robot.mean, observation.proximity)
                command, changes = self._explorer.step(observation)
            case Carried() if self._passenger is not None:
                self._mapper.step(observation)
                changes = self._passenger.step(observation)
            case GoTo() if self._navigator is not None:
                command, questions = self._navigator.step(observation, answers)
        safe, warning = guard(command, observation.proximity, self._description)
        if observation.bumped and safe.forward * self._direction > 0:
            safe, warning = Command(0.0, safe.turn), "stopped: the bumper is pressed"
        elif not observation.bumped and safe.forward:
            self._direction = math.copysign(1.0, safe.forward)
        return Step(safe, tuple(changes), tuple(questions), self._status(warning))

    def _status(self, warning: str) -> Status:
        doing, detail, finished = "idle", self._refusal or "no mission", False
        match self._mission:
            case Explore() if self._explorer is not None:
                doing, detail = str(self._explorer.phase), self._explorer.detail
                finished = self._explorer.finished
            case Carried() if self._passenger is not None:
                doing, detail = "mapping while carried", self._passenger.detail
            case GoTo() if self._navigator is not None:
                doing, detail = str(self._navigator.stage), self._navigator.detail
                finished = self._navigator.arrived
        if warning:
            detail = f"{detail}; {warning}" if detail else warning
        nodes = len(self.map.nodes)
        if not nodes and isinstance(self._mission, Explore | Carried):
            detail = f"no nodes yet: {detail or f'{self._mapper.tracked} features in view'}"
        fix = self._navigator.fix if self._navigator is not None else None
        return Status(
            doing=doing,
            detail=detail,
            nodes=nodes,
            tracked=self._mapper.tracked,
            map_from_robot=self._mapper.map_from_robot.mean,
            finished=finished,
            mission=type(self._mission).__name__.lower(),
            fix_node=None if fix is None else fix.node,
            node_from_robot=IDENTITY if fix is None else fix.node_from_robot.mean,
            legs=0 if self._navigator is None else self._navigator.legs,
        )

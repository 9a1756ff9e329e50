r"""One robot's whole pipeline: observation in, command and map changes out. Read this first.

    image, odometry, proximity -> mapper (tracks, EKF, nodes) -> changes
                               -> floor                        \
    lost on the own map ------> global localization -> mapper   |
    mission ------------------> explorer | carried   | navigator -> guard -> command
    a person's command --------------------------------------------/

It knows no network, no disk and no clock: live robots, recordings, simulation and tests run this very code.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.calibration.online import OnlineCalibration
from mapweave.agent.camera_occupancy import CameraOccupancyGrid
from mapweave.agent.cautious_driving import CautiousDriving, lacks_rangers
from mapweave.agent.command_guard import CommandGuard
from mapweave.agent.exploration.carried_mapping import CarriedMapping
from mapweave.agent.exploration.explorer import Explorer
from mapweave.agent.exploration.new_explorer import new_explorer
from mapweave.agent.global_localization.resumption import Resumption
from mapweave.agent.localization.fix import Fix
from mapweave.agent.mapping.episode import EpisodeRequest
from mapweave.agent.mapping.mapper import Mapper
from mapweave.agent.mission import Answer, Carried, Driven, Explore, GoTo, Idle, Mission, Question
from mapweave.agent.navigation.navigator import Navigator
from mapweave.agent.navigation.portal_crossing import PortalCrossing
from mapweave.agent.observation import Command, Observation, RobotDescription
from mapweave.agent.occupancy_grid import OccupancyGrid
from mapweave.agent.ranger_monitor import not_exploring
from mapweave.agent.robots_in_view import RobotsInView, nodes_around
from mapweave.agent.sensor_health.sensor_monitor import Fault, SensorMonitor
from mapweave.agent.settings import AgentSettings
from mapweave.hybridmap import jit
from mapweave.hybridmap.agent_status import IDENTITY, NOTHING_DRIVEN, Status
from mapweave.hybridmap.change import ChangeBody, NodePut
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.node import MapId
from mapweave.hybridmap.pose import PoseGaussian
from mapweave.vision.lens import NO_DISTORTION, Lens
from mapweave.vision.sift import Sift


@dataclass(frozen=True)
class Step:
    """What one tick gives.

    Attributes:
        command: for the wheels; already safe by the proximity sensors.
        changes: to the map, in order.
        questions: for the fleet's map; answers come with a later observation.
        status: for people.
        fault: the sensor that cannot be believed now, if any.
    """

    command: Command
    changes: tuple[ChangeBody, ...]
    questions: tuple[Question, ...]
    status: Status
    fault: Fault | None = None


class Pipeline:
    """One robot's pipeline."""

    def __init__(
        self,
        map_id: MapId,
        description: RobotDescription,
        settings: AgentSettings | None = None,
        contents: Sequence[ChangeBody] = (),
        next_number: int = 1,
        calibration: OnlineCalibration | None = None,
    ) -> None:
        """Start with nothing to do, and with an empty map or one that was begun.

        With a map that was begun the robot may be anywhere: it maps on once it has recognised a place of it.

        Args:
            map_id: of the map.
            description: of the robot.
            settings: of the parts.
            contents: of the map, as `Journal.resume` gives it.
            next_number: the first that no node or edge of the map has ever had.
            calibration: what this robot has learnt of its geometry on an earlier map.
        """
        jit.load()  # a robot that drives must not wait for a compiler
        self._fisheye = Lens(description.camera, description.distortion)
        if self._fisheye.rectifies:
            description = replace(description, distortion=NO_DISTORTION)
        self._map_id = map_id
        self._settings = settings or AgentSettings()
        self.calibration = calibration or OnlineCalibration(description)
        self.calibration.switched()
        description, lens = self.calibration.description, self.calibration.lens
        self._description = description
        self._lens = lens
        self._sift = Sift(lens, self._settings.sift)
        self._mapper = Mapper(map_id, description, self._settings, contents, next_number, lens)
        self._caution = CautiousDriving(description) if lacks_rangers(description) else None
        self._floor = self._new_floor()
        self._changes: list[ChangeBody] = []
        self._driven: Driven | None = None
        self._sensors = SensorMonitor(description)
        self._others = RobotsInView(description)
        self._command: Command | None = None
        self._mission: Mission = Idle()
        self._explorer: Explorer | None = None
        self._passenger = CarriedMapping(self._mapper)
        self._navigator: Navigator | None = None
        self._resumption: Resumption | None = None
        self._guard = CommandGuard(self._caution)
        self._lifted = self._put_elsewhere = self._made_room = False
        self._image: NDArray[np.uint8] | None = None

    @property
    def map(self) -> HybridMap:
        """The robot's own map so far."""
        return self._mapper.map

    @property
    def map_from_robot(self) -> PoseGaussian | None:
        """Where the robot is on its own map; None if it does not know."""
        fix = self.fix
        match self._mission:
            case Explore() | Carried() if self._located:
                return self._mapper.map_from_robot
            case GoTo() if fix is not None and fix.node in self.map.nodes:
                return self.map.nodes[fix.node].map_from_robot @ fix.node_from_robot
        return None

    # What displays read

    @property
    def image(self) -> NDArray[np.uint8] | None:
        """(H, W) grey, the last image as it is used: of a fisheye the rectified one."""
        return self._image

    @property
    def lens(self) -> Lens:
        """Of that image."""
        return self._lens

    @property
    def mapper(self) -> Mapper:
        """Maps; only the pipeline changes it."""
        return self._mapper

    @property
    def fix(self) -> Fix | None:
        """By which node the robot drives to a goal, or stands after it was stopped; None without one."""
        navigator = self._navigator if isinstance(self._mission, GoTo | Idle) else None
        return None if navigator is None else navigator.fix

    @property
    def floor(self) -> OccupancyGrid:
        """The floor around the robot."""
        return self._floor

    @property
    def _located(self) -> bool:
        """Whether the mapper knows where the robot is."""
        return self._mapper.started and not (self._mapper.astray or self._mapper.doubtful)

    @property
    def mission(self) -> Mission:
        """What the robot shall do; of a drive to a goal, from where it is with it."""
        mission, navigator = self._mission, self._navigator
        return navigator.taken_up(mission) if isinstance(mission, GoTo) and navigator else mission

    @property
    def lost(self) -> bool:
        """Whether the robot shall map and has given up localizing on its own map, or was lifted.

        It stands still then. The caller may begin a new map, in a new pipeline; another `set_mission`
        lets it try again.
        """
        return self._put_elsewhere or (self._resumption is not None and self._resumption.lost)

    @property
    def put_elsewhere(self) -> bool:
        """Whether it is lost because its base has noticed that it was lifted."""
        return self._put_elsewhere

    def set_mission(self, mission: Mission) -> None:
        """Begin another mission. Exploration that was interrupted goes on where it was.

        A robot that has navigated may have been anywhere in between: to map on it must first recognise a
        place of its own map.
        """
        self._mission = mission
        self._resumption, self._put_elsewhere, self._made_room = None, False, False
        if isinstance(mission, Explore | Carried):
            self._forget_fix()
        match mission:
            case Explore() if self._explorer is None and self._explores:
                self._explorer = self._new_explorer()
            case GoTo(goal, via, passed, portal):
                fix = None if self._navigator is None else self._navigator.fix
                near = None if fix is None else fix.node
                near = min(self.map.nodes, default=near) if self._located else near
                self._mapper.lose()
                self._restart()
                crossing = PortalCrossing(self._map_id, self._settings.portals.patience, portal)
                self._navigator = Navigator(
                    self._description, self._lens, self._sift, self.map, goal, self._settings,
                    self._settings.seed, via[passed:], crossing, near, lambda: self._others.beside,
                )  # fmt: skip

    def taken_through(self) -> None:
        """A person says that the robot was taken through the portal at which it waits."""
        if self._navigator is not None:
            self._navigator.crossing.taken_through()

    def step(
        self, observation: Observation, answers: tuple[Answer, ...] = (), driven: Driven | None = None
    ) -> Step:
        """Take one observation and decide.

        Args:
            observation: what the robot senses now.
            answers: to questions of earlier steps.
            driven: a person's command, which comes before the mission's; None if no one drives.
        """
        command, questions = Command(), list[Question]()
        if self._fisheye.rectifies and observation.image is not None:
            # From here on the camera is a pinhole.
            observation = replace(observation, image=self._fisheye.rectified(observation.image))
        self._image = observation.image
        observation = self.calibration.correct(observation)
        observation = self._sensors.see(observation, self._command)
        if self._sensors.clock_jumped:
            self._mapper.forget_clock()
        if self._sensors.pose_lost:
            self._lose_pose()
        self._take_over(driven)
        self._feel(observation)
        observation = self._others.mark(observation, answers, lambda: self._mapper.landmarks)
        match self._mission:
            case _ if self._in_the_air(observation) or self._put_elsewhere:
                pass
            case Idle() if self._mapper.started:
                # Mapping that goes on later needs the motion of the wheels until then.
                self._keep_up(observation)
            case Idle() if self.fix is not None:
                self.fix.follow_wheels(observation, self._description)
            case Explore() | Carried() if self._mapper.astray:
                command = self._resume(observation)
            case Explore() | Carried():
                command, questions = self._map(observation, answers)
            case GoTo() if self._navigator is not None:
                self._make_room(self._navigator)
                command, questions = self._navigator.step(observation, answers, self._held)
                self._mapper.drove(self._navigator.traverse, self._navigator.refined)
        questions = [*questions, *self._who_is_near()]
        if self._blind and not self._lifted:
            command = self._sensors.trial
        safe, warning = self._safe(command if driven is None or self._lifted else driven.command, observation)
        self._see_changes()
        changes, self._changes = tuple(self._changes), []
        own = isinstance(self._mission, Explore | GoTo) and driven is None and not self._lifted
        self._command = safe if own else None
        return Step(safe, changes, tuple(questions), self._status(warning), self._fault)

    def _make_room(self, navigator: Navigator) -> None:
        """Drive out of the way of another robot, if this one has nothing else to do, and may."""
        aside, self._others.aside = self._others.aside, None
        if aside is not None and navigator.arrived and self._settings.navigation.make_room and not self._held:
            self.set_mission(GoTo(aside))
            self._made_room = True

    def _who_is_near(self) -> list[Question]:
        """Ask for the robots around this one, if it is time and it knows where it is."""
        if not self._others.due:
            return []
        fix = self.fix
        match self._mission:
            case Explore() | Carried() | Idle() if self._located and self.map.nodes:
                starts = nodes_around(self.map, self._mapper.map_from_robot.mean)
                return [self._others.question(starts, self._mapper.since_anchor)]
            case GoTo() | Idle() if fix is not None:
                starts = ((fix.node, fix.node_from_robot.mean),)
                return [self._others.question(starts, fix.node_from_robot)]
        return []

    @property
    def _explores(self) -> bool:
        """Whether it may explore by itself."""
        return self._caution is None or self._settings.exploration.without_rangers

    @property
    def _held(self) -> bool:
        """Whether the mission must not move the robot now."""
        backing_off = self._caution is not None and self._caution.backing_off
        return bool(self._blind) or self._driven is not None or backing_off

    @property
    def _blind(self) -> str:
        """Why its sensors forbid an autonomous robot to drive; empty if it may."""
        fault = self._fault
        return fault.words if fault is not None and isinstance(self._mission, Explore | GoTo) else ""

    @property
    def _fault(self) -> Fault | None:
        """The sensor that cannot be believed. Who is moved by a person needs no rangers."""
        fault = self._sensors.fault
        if fault is not None and fault.sensor == "rangers" and not isinstance(self._mission, Explore | GoTo):
            return None
        return fault

    def _lose_pose(self) -> None:
        """The encoders have failed, or are back: what was measured since is void, nodes made before stay."""
        if isinstance(self._mission, GoTo):
            self.set_mission(self._mission)
            return
        self._resumption = None
        self._forget_fix()
        self._mapper.lose()
        self._restart()

    def _forget_fix(self) -> None:
        """Where a drive to a goal has ended says no longer where the robot is."""
        if self._navigator is not None:
            self._navigator.fix = None

    def _in_the_air(self, observation: Observation) -> bool:
        """Whether the base says that it is lifted. Put down again, the robot is at an unknown place."""
        if observation.kidnapped and not self._lifted:
            self._mapper.lose()
            if not isinstance(self._mission, GoTo):
                self._forget_fix()
        elif self._lifted and not observation.kidnapped:
            if isinstance(self._mission, GoTo):
                self.set_mission(self.mission)
            else:
                self._put_elsewhere = bool(self.map.nodes) and not isinstance(self._mission, Idle)
                self._restart()
        self._lifted = observation.kidnapped
        return self._lifted

    def _new_floor(self) -> OccupancyGrid:
        settings = self._settings.occupancy_grid
        if self._caution is None:
            return OccupancyGrid(self._description, settings)
        floor = CameraOccupancyGrid(self._description, settings)
        for node in self.map.nodes.values():
            floor.see_node(node)
        return floor

    def _new_explorer(self) -> Explorer:
        return new_explorer(self._map_id, self._description, self._mapper, self._floor, self._settings)

    def _take_over(self, driven: Driven | None) -> None:
        """A person takes the wheels, or gives them back: the mission goes on from where the robot is then."""
        changed = (driven is None) != (self._driven is None)
        self._driven = driven
        if changed:
            self._resumption = None
        if changed and driven is None and self._explorer is not None:
            self._explorer.restart()

    def _feel(self, observation: Observation) -> None:
        """Whether a robot without rangers has touched something: it is entered, and a route is given up."""
        if self._caution is None:
            return
        mapping = isinstance(self._mission, Explore | Carried) and self._mapper.started
        pose = self._mapper.map_from_robot.mean
        self._caution.see(observation, pose if mapping else None)
        if not self._caution.touched:
            return
        if mapping and isinstance(self._floor, CameraOccupancyGrid):
            self._floor.touch(pose, self._caution.heading)
        if self._navigator is not None:
            self._navigator.touch(self._caution.touched)

    def _safe(self, command: Command, observation: Observation) -> tuple[Command, str]:
        """The command as far as it is safe, and why it is not the one that was wanted."""
        floor = self._floor if isinstance(self._mission, Explore) else None
        pose, driven = self._mapper.map_from_robot.mean, self._driven is not None
        return self._guard.safe(command, observation, self._description, driven, floor, pose)

    def _see_changes(self) -> None:
        """Take what was changed in the map; nodes show a robot without rangers where the floor is free."""
        new = self._mapper.take_changes()
        self._changes += new
        if isinstance(self._floor, CameraOccupancyGrid):
            for change in new:
                if isinstance(change, NodePut):
                    self._floor.see_node(change.node)

    def _keep_up(self, observation: Observation) -> None:
        """Pass the observation to the mapper; it may detect that the robot was carried off."""
        started = self._mapper.started
        self._mapper.step(observation)
        if started and not self._mapper.started:
            self._restart()

    def _map(self, observation: Observation, answers: tuple[Answer, ...]) -> tuple[Command, list[Question]]:
        self._keep_up(observation)
        if self._mapper.doubtful or self._mapper.astray or self._blind:
            self.calibration.pause()
            return Command(), []
        if observation.image is not None and self._mapper.started:
            self._calibrate(observation.image)
        pose = self._mapper.map_from_robot.mean
        if isinstance(self._floor, CameraOccupancyGrid):
            self._floor.drive(pose)
            self._floor.see_landmarks(pose, self._mapper.landmarks)
            observation = replace(observation, proximity=self._floor.readings(pose))
        else:
            self._floor.see(pose, observation.proximity)
        if self._explorer is None or isinstance(self._mission, Carried) or self._driven:
            return self._act(self._passenger, observation), []
        if self._held:
            return Command(), []
        self._explorer.see(observation, answers)
        return self._act(self._explorer, observation), self._explorer.questions

    def _act(self, behaviour: Explorer | CarriedMapping, observation: Observation) -> Command:
        """The behaviour's command for this tick; what it asks of the mapper before that is done at once.

        Only here do the views of an episode become nodes. They leave with the step's changes.
        """
        while isinstance(move := behaviour.next_move(), EpisodeRequest):
            self._mapper.meet(move, observation)
            self._see_changes()
        return move

    def _calibrate(self, image: NDArray[np.uint8]) -> None:
        """Hold the tracks against the wheels; what they show is used from the next node on."""
        calibration = self.calibration
        if calibration.pending is not None and self._mapper.description is calibration.pending[0]:
            calibration.switched()
            self._description, self._lens = calibration.description, calibration.lens
            self._sift = Sift(self._lens, self._settings.sift)
            self._others.description = self._description
        calibration.watch(image, *self._mapper.tracks)
        if calibration.pending is not None:
            self._mapper.recalibrate(*calibration.pending)

    def _resume(self, observation: Observation) -> Command:
        """Find the robot on its own map; then map on from there."""
        if self._resumption is None:
            drives, settings = isinstance(self._mission, Explore) and not self._driven, self._settings
            self._resumption = Resumption(self._description, self._sift, self.map, drives, settings.seed)
        command = self._resumption.step(observation, bool(self._blind))
        recognized, odom_from_robot = self._resumption.found, self._resumption.odom_from_robot
        if recognized is None:
            return command
        self._mapper.resume(observation, recognized.features, recognized.node, recognized.recognition)
        map_from_odom = self._mapper.map_from_robot.mean @ odom_from_robot.inverse()
        for odom_from_then, proximity in self._resumption.seen:
            self._floor.see(map_from_odom @ odom_from_then, proximity)
        self._resumption = None
        return Command()

    def _restart(self) -> None:
        """The mapper has lost the robot's pose."""
        if self.map.nodes:
            if self._explorer is not None:
                self._explorer.restart()
            return
        # The map may begin anywhere, and all that was found out on the way to it is void.
        self._floor = self._new_floor()
        if self._explorer is not None:
            self._explorer = self._new_explorer()

    def _status(self, warning: str) -> Status:
        doing, detail, finished, given_up, progress = "idle", "no mission", False, False, 0.0
        match self._mission:
            case Explore() | Carried() if self._mapper.astray:
                doing = "lost" if self.lost else "looking for a place of its own map"
                detail = "" if self._resumption is None else self._resumption.detail
            case Explore() | Carried() if self._mapper.doubtful:
                doing, detail = "standing still", self._mapper.doubt
            case Explore() if self._explorer is not None and not self._driven:
                doing, detail = str(self._explorer.phase), self._explorer.detail
                finished = self._explorer.finished
            case Explore() if not self._driven:
                doing, detail = "standing still", not_exploring(self._map_id.agent)
            case Carried() | Explore():
                doing, detail = "mapping while carried", self._passenger.detail
            case GoTo() if self._navigator is not None:
                doing, detail = str(self._navigator.stage), self._navigator.detail
                finished, given_up = self._navigator.arrived, self._navigator.given_up
                progress = self._navigator.progress
                detail += "; it makes room for another robot" if self._made_room else ""
        if self._blind:
            doing, detail = "standing still", self._blind
        if self._driven is not None:
            silence = self._driven.silence
            doing = "driven by a person" if not silence else "standing: nothing is heard of who drives it"
        if self._lifted or self._put_elsewhere:
            doing, detail = "lifted", "the robot begins a new map once it is on the floor"
        mapping = isinstance(self._mission, Explore | Carried) and not self._mapper.doubtful
        if self._fault is not None and not self._blind:
            warning = "; ".join(part for part in (self._fault.words, warning) if part)
        for more in (self._mapper.health if mapping else "", warning):
            detail = "; ".join(part for part in (detail, more) if part)
        nodes = len(self.map.nodes)
        if not nodes and isinstance(self._mission, Explore | Carried):
            detail = f"no nodes yet: {detail or self._mapper.track_report}"
        fix = self._navigator.fix if self._navigator is not None else None
        drive = mission if isinstance(mission := self.mission, GoTo) else None
        c = (self._mapper.map_from_robot if fix is None else fix.node_from_robot).covariance
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
            lost=self.lost,
            astray=self._resumption is not None,
            given_up=given_up,
            progress=progress,
            located=mapping and self._located,
            tally=NOTHING_DRIVEN if self._navigator is None else self._navigator.tally,
            passed=0 if drive is None else drive.passed,
            portal=None if drive is None else drive.portal,
            covariance=(float(c[0, 0]), float(c[0, 1]), float(c[1, 1]), float(c[2, 2])),
        )

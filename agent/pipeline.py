r"""One robot's whole pipeline: observation in, command and map changes out. Read this first.

    image, odometry, proximity -> mapper (tracks, EKF, nodes) -> changes
                               -> floor                        \
    lost on the own map ------> global localization -> mapper   |
    mission ------------------> explorer | carried   | navigator -> guard -> command
    a person's command --------------------------------------------/

It knows no network, no disk and no clock: live robots, recordings, simulation and tests run this very code.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.calibration.online import OnlineCalibration
from mapweave.agent.cautious_driving import CautiousDriving, lacks_rangers
from mapweave.agent.command_guard import CommandGuard
from mapweave.agent.localization.fix import Fix
from mapweave.agent.map_making import MapMaking
from mapweave.agent.mapping.mapper import Mapper
from mapweave.agent.mapping.node_retirement import Released, alone
from mapweave.agent.mapping.view import RawImage
from mapweave.agent.mapping.way_correction import WayCorrection
from mapweave.agent.mission import Carried, Driven, Explore, GoTo, Idle, Mission, Question, ServerAnswer
from mapweave.agent.navigation.navigator import Navigator
from mapweave.agent.navigation.portal_crossing import PortalCrossing
from mapweave.agent.observation import Command, Observation, RobotDescription
from mapweave.agent.occupancy_grid import OccupancyGrid
from mapweave.agent.robots_in_view import RobotsInView, nodes_around
from mapweave.agent.sensor_health.sensor_monitor import SensorFault
from mapweave.agent.sensor_input import SensorInput, as_pinhole
from mapweave.agent.settings import AgentSettings
from mapweave.hybridmap import jit
from mapweave.hybridmap.agent_status import IDENTITY, NOTHING_DRIVEN, Status
from mapweave.hybridmap.change import ChangeBody
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.pose import PoseGaussian
from mapweave.vision.lens import Lens

MOST_ROOM = 3
"""So often a robot makes room before it gets a mission again: neither a server nor a robot behind it makes it
drive for ever."""


@dataclass(frozen=True)
class TickResult:
    """The result of one tick.

    Attributes:
        command: for the wheels; already safe by the proximity sensors.
        changes: to the map, in order.
        questions: for the fleet's map; answers come with a later observation.
        status: for people.
        fault: the sensor that cannot be believed now, if any.
        images: of the nodes that were made.
        way_moved: by this `status.map_from_robot` of all ticks before this one of the same map become one
            way with those from now on: the geometry was corrected. None if it was not. See
            `Mapper.take_way_moved`.
    """

    command: Command
    changes: tuple[ChangeBody, ...]
    questions: tuple[Question, ...]
    status: Status
    fault: SensorFault | None = None
    images: tuple[tuple[NodeId, RawImage], ...] = ()
    way_moved: WayCorrection | None = None


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
        released: Released = alone,
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
            released: what the fleet says of superseded nodes of the map; it must not wait for anything.
        """
        jit.load()  # a robot that drives must not wait for a compiler
        self._map_id = map_id
        self._settings = settings or AgentSettings()
        calibration = calibration or OnlineCalibration(as_pinhole(description))
        self._map_making = MapMaking(map_id, calibration, self._settings, contents, next_number, released)
        declared, description = description, self._map_making.description
        self._input = SensorInput(declared, description)
        self._caution = CautiousDriving(description) if lacks_rangers(description) else None
        self._driven: Driven | None = None
        self._others = RobotsInView(description)
        self._command: Command | None = None
        self._mission: Mission = Idle()
        self._navigator: Navigator | None = None
        self._guard = CommandGuard(self._caution)
        self._lifted = self._put_elsewhere = False
        self._room_made = 0

    def step(
        self, observation: Observation, answers: tuple[ServerAnswer, ...] = (), driven: Driven | None = None
    ) -> TickResult:
        """Take one observation and decide.

        Args:
            observation: what the robot senses now.
            answers: to questions of earlier steps.
            driven: a person's command, which comes before the mission's; None if no one drives.
        """
        observation = self._believed(observation)
        self._take_over(driven)
        self._feel(observation)
        observation = self._others.mark(observation, answers, lambda: self.mapper.landmarks)
        command, questions = Command(), list[Question]()
        if not (self._in_the_air(observation) or self._put_elsewhere):
            self._make_room()
            command, questions = self._by_mission(observation, answers)
        questions = [*questions, *self._who_is_near()]
        if self._blind and not self._lifted:
            command = self._input.monitor.trial
        if not isinstance(self._mission, GoTo):
            self.mapper.retire_superseded(observation.stamp_ns)
        safe, warning = self._safe(command if driven is None or self._lifted else driven.command, observation)
        changes = self._map_making.take_changes()
        own = isinstance(self._mission, Explore | GoTo) and driven is None and not self._lifted
        self._command = safe if own else None
        images = self.mapper.take_images()
        return TickResult(
            safe, changes, tuple(questions), self._status(warning), self._fault, images,
            self.mapper.take_way_moved(),
        )  # fmt: skip

    def _believed(self, observation: Observation) -> Observation:
        """What of the observation is used; what the robot knows of itself follows."""
        observation = self._input.believed(observation, self._command, self.calibration)
        if self._input.monitor.clock_jumped:
            self.mapper.forget_clock()
        if self._input.monitor.pose_lost:
            self._lose_pose()
        return observation

    def _take_over(self, driven: Driven | None) -> None:
        """A person takes the wheels, or gives them back: the mission goes on from where the robot is then."""
        changed = (driven is None) != (self._driven is None)
        self._driven = driven
        if changed:
            self._map_making.end_search()
        if changed and driven is None:
            self._map_making.go_on()

    def _feel(self, observation: Observation) -> None:
        """Whether a robot without rangers has touched something: it is entered, and a route is given up."""
        if self._caution is None:
            return
        mapping = isinstance(self._mission, Explore | Carried) and self.mapper.started
        self._caution.see(observation, self.mapper.map_from_robot.mean if mapping else None)
        if not self._caution.touched:
            return
        if mapping:
            self._map_making.touch(self._caution.heading)
        if self._navigator is not None:
            self._navigator.touch(self._caution.touched)

    def _in_the_air(self, observation: Observation) -> bool:
        """Whether the base says that it is lifted. Put down again, the robot is at an unknown place."""
        if observation.kidnapped and not self._lifted:
            self.mapper.lose()
            if not isinstance(self._mission, GoTo):
                self._forget_fix()
        elif self._lifted and not observation.kidnapped:
            if isinstance(self._mission, GoTo):
                self._seek_goal_again()
            else:
                self._put_elsewhere = bool(self.map.nodes) and not isinstance(self._mission, Idle)
                self._map_making.restart()
        self._lifted = observation.kidnapped
        return self._lifted

    def _make_room(self) -> None:
        """Drive out of the way of another robot, if this one has done its mission, and may."""
        aside, self._others.aside = self._others.aside, None
        match self._mission:
            case Explore():
                done = self._map_making.explored
            case GoTo() if self._navigator is not None:
                done = self._navigator.arrived
            case _:
                done = False
        may = self._settings.navigation.make_room and self._room_made < MOST_ROOM and not self._held
        if aside is not None and done and may:
            made = self._room_made + 1
            self.set_mission(GoTo(aside))
            self._room_made = made

    def _by_mission(
        self, observation: Observation, answers: tuple[ServerAnswer, ...]
    ) -> tuple[Command, list[Question]]:
        """What the mission wants of the wheels, and to ask the fleet; what it maps goes to the mapper."""
        command, questions, lost = Command(), list[Question](), self._times_lost
        match self._mission:
            case Idle() if self.mapper.started:
                # Mapping that goes on later needs the motion of the wheels until then.
                self._map_making.keep_up(observation)
            case Idle() if self.fix is not None:
                self.fix.follow_wheels(observation, self._map_making.description)
            case Explore() | Carried():
                command, questions = self._map_making.step(
                    observation, answers, self._exploring, bool(self._blind), self._held
                )
                self._others.description = self._map_making.description
            case GoTo() if self._navigator is not None:
                command, questions = self._navigator.step(observation, answers, self._held)
                self.mapper.drove(self._navigator.traverse, self._navigator.refined)
        if self._times_lost > lost:
            # It may have been carried: what the wheels say of things around it is void.
            self._input.forget_ranges()
        return command, questions

    def _who_is_near(self) -> list[Question]:
        """Ask for the robots around this one, if it is time and it knows where it is."""
        if not self._others.due:
            return []
        fix = self.fix
        match self._mission:
            case Explore() | Carried() | Idle() if self._map_making.located and self.map.nodes:
                starts = nodes_around(self.map, self.mapper.map_from_robot.mean)
                return [self._others.question(starts, self.mapper.since_anchor)]
            case GoTo() | Idle() if fix is not None:
                starts = ((fix.node, fix.node_from_robot.mean),)
                return [self._others.question(starts, fix.node_from_robot)]
        return []

    def _safe(self, command: Command, observation: Observation) -> tuple[Command, str]:
        """The command as far as it is safe, and why it is not the one that was wanted."""
        floor = self.floor if isinstance(self._mission, Explore) else None
        pose, driven = self.mapper.map_from_robot.mean, self._driven is not None
        return self._guard.safe(command, observation, self._map_making.description, driven, floor, pose)

    def _account(self, warning: str) -> tuple[str, str, bool]:
        """What the robot does, details of it, and whether the mission is done."""
        doing, detail, finished = "idle", "no mission", False
        match self._mission:
            case Explore() | Carried():
                doing, detail, finished = self._map_making.account(self._exploring)
            case GoTo() if self._navigator is not None:
                doing, detail = str(self._navigator.stage), self._navigator.detail
                finished = self._navigator.arrived
                detail += "; it makes room for another robot" if self._room_made else ""
        if self._blind:
            doing, detail = "standing still", self._blind
        if self._driven is not None:
            silence = self._driven.silence
            doing = "driven by a person" if not silence else "standing: nothing is heard of who drives it"
        if self._lifted or self._put_elsewhere:
            doing, detail = "lifted", "the robot begins a new map once it is on the floor"
        mapping = isinstance(self._mission, Explore | Carried) and not self.mapper.doubtful
        if self._fault is not None and not self._blind:
            warning = "; ".join(part for part in (self._fault.words, warning) if part)
        for more in (self.mapper.health if mapping else "", warning):
            detail = "; ".join(part for part in (detail, more) if part)
        if not self.map.nodes and isinstance(self._mission, Explore | Carried):
            detail = f"no nodes yet: {detail or self.mapper.track_report}"
        return doing, detail, finished

    def _status(self, warning: str) -> Status:
        doing, detail, finished = self._account(warning)
        navigator = self._navigator if isinstance(self._mission, GoTo) else None
        fix = self._navigator.fix if self._navigator is not None else None
        drive = mission if isinstance(mission := self.mission, GoTo) else None
        c = (self.mapper.map_from_robot if fix is None else fix.node_from_robot).covariance
        return Status(
            doing=doing,
            detail=detail,
            nodes=len(self.map.nodes),
            tracked=self.mapper.tracked,
            map_from_robot=self.mapper.map_from_robot.mean,
            finished=finished,
            mission=type(self._mission).__name__.lower(),
            fix_node=None if fix is None else fix.node,
            node_from_robot=IDENTITY if fix is None else fix.node_from_robot.mean,
            legs=0 if self._navigator is None else self._navigator.legs,
            lost=self.lost,
            relocalizing=self._map_making.resuming,
            given_up=navigator is not None and navigator.given_up,
            progress=0.0 if navigator is None else navigator.progress,
            located=not isinstance(self._mission, GoTo) and self._map_making.located,
            drive=NOTHING_DRIVEN if self._navigator is None else self._navigator.statistics,
            passed=0 if drive is None else drive.passed,
            portal=None if drive is None else drive.portal,
            covariance=(float(c[0, 0]), float(c[0, 1]), float(c[1, 1]), float(c[2, 2])),
        )

    def finish(self) -> tuple[tuple[ChangeBody, ...], tuple[tuple[NodeId, RawImage], ...]]:
        """Make at once what is left of the last mapping episode, before the process ends.

        Returns:
            Changes to the map since the last step, in order, and the images of the nodes that were made.
        """
        return self._map_making.finish(), self.mapper.take_images()

    def set_mission(self, mission: Mission) -> None:
        """Begin another mission. Exploration that was interrupted goes on where it was.

        A robot that has navigated may have been anywhere in between: to map on it must first recognise a
        place of its own map.
        """
        self._mission = mission
        self._put_elsewhere, self._room_made = False, 0
        self._map_making.end_search()
        if isinstance(mission, Explore | Carried):
            self._forget_fix()
        match mission:
            case Explore():
                self._map_making.explore()
            case GoTo(goal, via, passed, portal):
                fix = None if self._navigator is None else self._navigator.fix
                near = None if fix is None else fix.node
                near = min(self.map.nodes, default=near) if self._map_making.located else near
                self._map_making.lose_pose()
                # An answer that an earlier drive did not wait for must answer no question of this one.
                first = 1 if self._navigator is None else self._navigator.next_number
                crossing = PortalCrossing(self._map_id, self._settings.portals.patience, portal)
                self._navigator = Navigator(
                    self._map_making.description, self.lens, self._map_making.sift, self.map, goal,
                    self._settings, self._settings.seed, via[passed:], crossing, near,
                    lambda: self._others.beside, first,
                )  # fmt: skip

    def taken_through(self) -> None:
        """A person says that the robot was taken through the portal at which it waits."""
        if self._navigator is not None:
            self._navigator.crossing.taken_through()

    @property
    def map(self) -> HybridMap:
        """The robot's own map so far."""
        return self.mapper.map

    @property
    def map_from_robot(self) -> PoseGaussian | None:
        """Where the robot is on its own map; None if it does not know."""
        fix = self.fix
        match self._mission:
            case Explore() | Carried() | Idle() if self._map_making.located:
                return self.mapper.map_from_robot
            case GoTo() | Idle() if fix is not None and fix.node in self.map.nodes:
                return self.map.nodes[fix.node].map_from_robot @ fix.node_from_robot
        return None

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
        return self._put_elsewhere or self._map_making.lost

    @property
    def put_elsewhere(self) -> bool:
        """Whether it is lost because its base has noticed that it was lifted."""
        return self._put_elsewhere

    @property
    def refuted(self) -> int:
        """Answers of the fleet that its view did not bear out, on the present mission."""
        return 0 if self._navigator is None else self._navigator.refuted

    @property
    def complaints(self) -> list[str]:
        """What was found to be wrong with the odometry and with the declared geometry, a line each."""
        odometry = [f"the map is wrong: {line}" for line in self._input.complaints]
        return [*odometry, *map(str, self.calibration.causes), *self.calibration.contradicted]

    @property
    def image(self) -> NDArray[np.uint8] | None:
        """(H, W) grey, the last image as it is used: of a fisheye the rectified one."""
        return self._input.image

    @property
    def lens(self) -> Lens:
        """The lens of that image."""
        return self._map_making.lens

    @property
    def mapper(self) -> Mapper:
        """Makes the map; only `map_making.py` and the pipeline change it."""
        return self._map_making.mapper

    @property
    def calibration(self) -> OnlineCalibration:
        """The calibration of the drive, while it maps."""
        return self._map_making.calibration

    @property
    def fix(self) -> Fix | None:
        """The node by which the robot drives to a goal, or stands after it was stopped; None without one."""
        navigator = self._navigator if isinstance(self._mission, GoTo | Idle) else None
        return None if navigator is None else navigator.fix

    @property
    def floor(self) -> OccupancyGrid:
        """The floor around the robot."""
        return self._map_making.floor

    @property
    def _times_lost(self) -> int:
        """How often what it sees has shown that it is not where it took itself to be."""
        return self._map_making.losses + (0 if self._navigator is None else self._navigator.losses)

    @property
    def _exploring(self) -> bool:
        """Whether the robot decides itself what to map."""
        return isinstance(self._mission, Explore) and self._driven is None

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
    def _fault(self) -> SensorFault | None:
        """The sensor that cannot be believed. Who is moved by a person needs no rangers."""
        fault = self._input.monitor.fault
        if fault is not None and fault.sensor == "rangers" and not isinstance(self._mission, Explore | GoTo):
            return None
        return fault

    def _lose_pose(self) -> None:
        """The encoders have failed, or are back: what was measured since is void, nodes made before stay."""
        if isinstance(self._mission, GoTo):
            self._seek_goal_again()
            return
        self._map_making.end_search()
        self._forget_fix()
        self._map_making.lose_pose()

    def _seek_goal_again(self) -> None:
        """Find the way to the goal again after the robot got lost. A goal that was given up stays so."""
        if self._navigator is not None and self._navigator.given_up:
            self._forget_fix()
        else:
            self.set_mission(self.mission)

    def _forget_fix(self) -> None:
        """Where a drive to a goal has ended says no longer where the robot is."""
        if self._navigator is not None:
            self._navigator.fix = None

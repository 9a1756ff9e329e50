"""One agent: pipeline, disk and link to the fleet put together."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from mapweave.agent.base_watch import watching
from mapweave.agent.calibration.correction import declaring, geometry_of
from mapweave.agent.calibration.online import OnlineCalibration
from mapweave.agent.drivers.robot import Robot
from mapweave.agent.fleet_client import FleetClient
from mapweave.agent.mapping_monitor import MappingMonitor
from mapweave.agent.mission_control import MissionControl
from mapweave.agent.observation import Command, Observation, RobotDescription
from mapweave.agent.pipeline import Pipeline, TickResult
from mapweave.agent.ranger_monitor import announcement
from mapweave.agent.recordings.geometry_file import read_geometry
from mapweave.agent.recordings.trajectory_file import TrajectoryFile
from mapweave.agent.replication.epochs import newest_on_server, next_epoch
from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.left_maps import LeftMaps
from mapweave.agent.replication.merged_poses import MergedPoses
from mapweave.agent.replication.replicator import Replicator
from mapweave.agent.replication.retained_map import RetainedMap
from mapweave.agent.replication.view_keeper import ViewKeeper
from mapweave.agent.runner import Runner
from mapweave.agent.settings import AgentSettings
from mapweave.agent.synchronization import FreeRunning, Synchronization
from mapweave.agent.teleoperation import Teleoperation
from mapweave.hybridmap.counted import counted
from mapweave.hybridmap.errors import InvalidFile, Refused
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.mission_order import MissionKind
from mapweave.processes.agent_files import (
    epochs_of_files,
    learned_path,
    map_path,
    trajectory_path,
    views_path,
)
from mapweave.processes.learned_geometry import GeometryKeeper
from mapweave.processes.portal_command import PortalCommand
from mapweave.processes.server_watch import ServerWatch
from mapweave.storage.full_disks import FullDisk, logged
from mapweave.storage.map_file import MapFile, write_map_file
from mapweave.storage.os_errors import DISK_FULL
from mapweave.wire.bus import Bus
from mapweave.wire.keys import Keys
from mapweave.wire.ros2.settings import Ros2Link
from mapweave.wire.traffic_meter import TrafficMeter

if TYPE_CHECKING:
    from mapweave.processes.agent_metrics import AgentSources

FIRST_PATIENCE = 3.0
"""How long a robot that remembers no map asks the server for the number of its next one, s."""
DISK_PAUSE = 1.0
"""s between two attempts to begin a map on a full disk."""
NO_ROOM_FOR_MAP = "stands: it cannot begin a map before there is room for it"
RECORDED = "a recording takes no orders"


@dataclass(frozen=True)
class AgentOptions:
    """How an agent runs.

    Attributes:
        name: in the fleet.
        data: folder for its journal and its map file.
        epoch: least number of the map if one is begun; None asks the server which one is next.
        fresh: begin a new map even if the journal holds one.
        resume: the map of the journal that goes on; None takes the newest.
        mission: given at the start; None goes on with the mission that the journal holds.
        otherwise: the mission without either.
        seed: of the random choices in exploration.
        synchronization: what the loop waits for between ticks.
        server: whose acknowledgement lets changes be forgotten.
        total: observations that will come, if that is known.
        recorded: whether the robot is a recording. It takes no orders, and the pose at each observation goes
            to a file beside the map's; its first map has number 1 if no server has another.
        patience: how long to wait at the end until the server has everything, s.
        calibration: file with what `mapweave calibrate` has measured of this robot, if it exists.
        ros2: where pose and map are published as ROS 2 topics; None if they are not.
        rerun: where all that it senses and estimates goes for the Rerun viewer; None if it does not.
        mcap_log: folder to which the same goes as MCAP, for Foxglove; None if it does not.
        metrics: port of this machine on which it tells Prometheus about itself; None if it does not.
    """

    name: str
    data: Path
    epoch: int | None = None
    fresh: bool = False
    resume: MapId | None = None
    mission: MissionKind | None = None
    otherwise: MissionKind = MissionKind.STOP
    seed: int = 0
    synchronization: Synchronization = field(default_factory=FreeRunning)
    server: str = "s0"
    total: int | None = None
    recorded: bool = False
    patience: float = 5.0
    calibration: Path | None = None
    ros2: Ros2Link | None = None
    rerun: str | None = None
    mcap_log: str | None = None
    metrics: int | None = None


def measured(description: RobotDescription, calibration: Path | None) -> RobotDescription:
    """The robot with the geometry that was measured of it; as it declares itself if there is none.

    Raises:
        DeviceError: the file cannot be right.
    """
    given = read_geometry(calibration) if calibration is not None else {}
    return declaring(description, replace(geometry_of(description), **given)) if given else description


class Agent:
    """Pipeline, disk and link of one robot; the owner of its driver calls `tick` and `exchange`.

    It takes up the newest map of its journal. When the pipeline cannot find itself on that map, a fresh map
    begins in a new epoch; the old one stays. Each map has a file of its own, written when another map begins
    and at the end.
    """

    def __init__(
        self,
        describe: Callable[[], RobotDescription],
        bus: Bus,
        keys: Keys,
        settings: AgentSettings,
        options: AgentOptions,
        on_step: Callable[[Observation, TickResult], None] = lambda observation, step: None,
        print_line: Callable[[str], None] = lambda line: None,
        on_wait: Callable[[], None] = lambda: None,
    ) -> None:
        """Open the journal and join the fleet.

        Args:
            describe: asks the robot for its description, once the disk is known to be usable.
            bus: to the fleet; stays the caller's.
            keys: of the fleet.
            settings: of the pipeline.
            options: how.
            on_step: called after each tick.
            print_line: prints lines for people.
            on_wait: called about every second while the robot stands without ticks, since its disk is full.

        Raises:
            MapweaveError: the journal cannot be used; one line gives the reason.
        """
        self._bus = TrafficMeter(bus)
        self._keys = keys
        self._settings = replace(settings, seed=options.seed)
        refusal = RECORDED if options.recorded else ""
        self._teleoperation = Teleoperation(refusal=refusal)
        self._options = options
        self._on_step, self._on_wait = on_step, on_wait
        self._stamp_ns = 0
        self._complaints = set[str]()
        self._print, self._server_watch = print_line, ServerWatch(options.server)
        options.data.mkdir(parents=True, exist_ok=True)
        self.journal = Journal(options.data / f"{options.name}.sqlite", options.name)
        self._views: ViewKeeper | None = None
        try:
            self.missions = MissionControl(
                options.name, self.journal.missions(), self.journal.keep_missions, settings.without_server,
                lambda save: threading.Thread(target=save, name="missions").start(), refusal,
            )  # fmt: skip
            if options.mission is not None or self.missions.report is None:
                self.missions.begin(options.mission or options.otherwise)
            self.missions.unknown_goal = self._unknown_goal
            self._portal_command = PortalCommand(
                options.name, settings.portals, self.missions.portal_done, self._say
            )
            self._description = measured(describe(), options.calibration)
            # The same recording is the same map, whatever was learned from it before.
            self._geometry: GeometryKeeper | None = None
            calibration = None
            if not options.recorded:
                path = learned_path(options.data, options.name)
                self._geometry = GeometryKeeper(path, self._say)
                calibration = self._geometry.calibration(self._description)
            if settings.keep_views:
                folder = views_path(options.data, options.name)
                self._views = ViewKeeper(self._bus, keys, options.name, folder)
            explores = settings.exploration.without_rangers
            for line in announcement(self._description, options.name, explores):
                print_line(f"{options.name}: {line}")
            maps = self.journal.maps()
            if options.resume is not None or (maps and not options.fresh):
                self._resume(self._chosen(maps), calibration)
            else:
                for left in maps[-1:]:
                    # An agent that was killed has written no file.
                    self._write(left, RetainedMap.of(self.journal, left))
                self._begin(calibration)
        except BaseException:
            if self._views is not None:
                self._views.close()
            self.journal.close()
            raise

    def _begin(self, calibration: OnlineCalibration | None = None) -> None:
        """A fresh map."""
        self._start_fresh(self.journal.open_map(self._next_epoch()), calibration)

    def _next_epoch(self) -> int:
        """A number that no map of this robot has had."""
        options = self._options
        taken = [known_map.epoch for known_map in self.journal.maps()]
        taken += epochs_of_files(options.data, options.name)
        if options.epoch is not None:
            return max([options.epoch, *(used + 1 for used in taken)])
        # A session may take a moment to find its router; a disk that remembers maps needs no server.
        patience = 0.0 if taken else FIRST_PATIENCE
        stored = None
        if options.patience > 0.0:
            stored = newest_on_server(self._bus, self._keys, options.server, options.name, patience)
        if options.recorded:
            # The same recording is the same map, down to its number.
            stored = stored or 0
        return next_epoch(taken, stored)

    def _start_fresh(self, map_id: MapId, calibration: OnlineCalibration | None) -> None:
        pipeline = Pipeline(
            map_id, self._description, self._settings, calibration=calibration, released=self._released
        )
        self._start(map_id, pipeline)

    def _opened(self, epoch: int, stop: threading.Event | None, rest: Callable[[], object]) -> MapId:
        """Begin a map in the journal; until `stop` a full disk is waited for."""
        while True:
            try:
                return self.journal.open_map(epoch)
            except FullDisk as error:
                if stop is None or stop.is_set():
                    raise
                logged(error)
                self._wait(str(error), rest)
                stop.wait(DISK_PAUSE)

    def _wait(self, why: str, rest: Callable[[], object]) -> None:
        """The robot stands without ticks: the wheels, systemd and people hear of it."""
        rest()
        if NO_ROOM_FOR_MAP not in self._complaints:
            self._complaints.add(NO_ROOM_FOR_MAP)
            self._say(NO_ROOM_FOR_MAP)
        self._fleet.stands(why)
        self._on_wait()

    def _resume(self, map_id: MapId, calibration: OnlineCalibration | None) -> None:
        kept = RetainedMap.of(self.journal, map_id)
        pipeline = Pipeline(
            map_id, self._description, self._settings, kept.contents, kept.next_number, calibration,
            self._released,
        )  # fmt: skip
        self.journal.open_map(map_id.epoch)
        nodes = len(pipeline.map.nodes)
        self._say(f"takes up map {map_id} with {counted(nodes, 'node')}")
        if kept.complaint:
            self._say(kept.complaint)
            self._set_aside(map_id)
        if self._views is not None:
            self._views.keep_only(map_id, pipeline.map.nodes)
        self._start(map_id, pipeline)

    def _chosen(self, maps: list[MapId]) -> MapId:
        """The map that goes on."""
        chosen = self._options.resume
        if chosen is None:
            return maps[-1]
        if chosen not in maps:
            held = ", ".join(map(str, maps)) or "none"
            raise Refused(f"the journal of {self._options.name} has no map {chosen}; it has {held}")
        return chosen

    def _start(self, map_id: MapId, pipeline: Pipeline) -> None:
        options = self._options
        self.pipeline = pipeline
        self.replicator = Replicator(self._bus, self._keys, self.journal, map_id, servers=(options.server,))
        self.merged_poses = MergedPoses(self._bus, self._keys, options.name, options.server)
        self._left_maps = LeftMaps(
            self._bus, self._keys, self.journal, self.replicator, options.server, lambda: self._stamp_ns
        )
        self._fleet = FleetClient(
            self._bus, self._keys, map_id, self.missions, options.synchronization.answer_timeout,
            self.replicator.unacknowledged, self._placed, self._teleoperation,
            (self._description.max_forward, self._description.max_turn),
            lambda: self.replicator.status().failure,
        )  # fmt: skip
        path = trajectory_path(options.data, map_id)
        self._trajectory = TrajectoryFile(path) if options.recorded else None
        self.runner = Runner(
            pipeline, self._fleet, self.replicator, self.missions, MappingMonitor(self._description),
            options.synchronization, self._stepped, self._say, recorded=options.recorded,
        )  # fmt: skip

    def _released(self, node: NodeId, successor: NodeId) -> bool:
        """Whether a superseded node may leave the own map: no server knows it, or its server has pruned it.

        A server keeps a node that people have named, and it marginalises a node before it lets it go.
        """
        report = self.missions.report
        if report is not None and node in (report.order.node, *report.order.via):
            return False
        poses = self.merged_poses
        return not self.replicator.shared or (poses.of(node) is None and poses.of(successor) is not None)

    def _say(self, line: str) -> None:
        self._print(f"{self._options.name}: {line}")

    def _stepped(self, observation: Observation, step: TickResult) -> None:
        self._stamp_ns = observation.stamp_ns
        if self._views is not None:
            self._views.keep(step.images, step.changes)
        if self._trajectory is not None:
            pose = step.status.map_from_robot if step.status.located else None
            if step.way_moved is not None:
                self._trajectory.move(step.way_moved)
            self._trajectory.add(observation.stamp_ns, observation.odometry.motion(), pose)
        if self._geometry is not None:
            self._geometry.see(self.pipeline.calibration)
        line = self._server_watch.see(self._fleet.server_in_reach(), time.monotonic())
        if line and self._options.patience > 0.0:
            self._say(line)
        self._on_step(observation, step)
        self._portal_command.see(step.status.portal)
        # A geometry that is found to be declared wrongly is reported once, as are turns in another unit.
        for line in self.pipeline.complaints:
            if line not in self._complaints:
                self._complaints.add(line)
                self._say(line)

    @property
    def server_in_reach(self) -> bool:
        """Whether any map server is known to be reachable."""
        return self._fleet.server_in_reach()

    @property
    def map_id(self) -> MapId:
        """The map that it makes."""
        return self.replicator.map_id

    def begin_new_map(
        self, stop: threading.Event | None = None, rest: Callable[[], object] = lambda: None
    ) -> None:
        """Leave a map on which the robot cannot find itself; the same mission goes on in a fresh one.

        Args:
            stop: until it is set, the robot stands as long as the disk is full: what it has mapped waits in
                memory, and would be lost. None: it does not wait.
            rest: holds the wheels; called about every second while it stands.
        """
        mission, old, calibration = self.pipeline.mission, self.map_id, self.pipeline.calibration
        cause = "was lifted" if self.pipeline.put_elsewhere else f"cannot find itself on map {old}"
        self.finish()
        while stop is not None and not stop.is_set() and not self.replicator.flush(DISK_PAUSE):
            failure = self.replicator.status().failure
            if DISK_FULL not in failure:
                break
            self._wait(failure, rest)
        # The robot stays with its fleet until the disk has taken the new map.
        fresh = self._opened(self._next_epoch(), stop, rest)
        self._complaints.discard(NO_ROOM_FOR_MAP)
        self._leave()
        try:
            self.write_map()
        except InvalidFile as error:
            # The journal has it all.
            if not logged(error):
                self._say(str(error))
        self._start_fresh(fresh, calibration)
        self.pipeline.set_mission(mission)
        self._say(f"{cause}; it begins map {self.map_id}, and the old one stays")

    def tick(self, observation: Observation) -> TickResult:
        """One tick; see Runner.tick. Begins a fresh map where that is needed."""
        step = self.runner.tick(observation)
        if self.pipeline.lost:
            self.begin_new_map()
        return step

    def run(self, robot: Robot, stop: threading.Event) -> None:
        """Loop until the driver has no more observations or `stop` is set."""
        # In lock-step a base waits for other robots, which is no failure.
        live = not self._options.recorded and isinstance(self._options.synchronization, FreeRunning)
        while True:
            with watching(lambda: self.runner.waiting, self._fleet.base_silent) if live else nullcontext():
                self.runner.run(robot, stop)
            if stop.is_set() or not self.pipeline.lost:
                return
            self.begin_new_map(stop, lambda: robot.act(Command(0.0, 0.0)))

    def sources(self) -> AgentSources:
        """What it knows of itself."""
        from mapweave.processes.agent_metrics import AgentSources

        return AgentSources(
            lambda: self._fleet.status(), lambda: self.replicator.status(), lambda: self._fleet.asked,
            lambda: self._fleet.relocalized, lambda: self.pipeline.refuted,
            lambda: self._server_watch.arrivals,
        )  # fmt: skip

    def finish(self) -> None:
        """Map to its end what was begun, and hand it over: no further tick follows. May be called twice."""
        changes, images = self.pipeline.finish()
        if changes:
            self.replicator.submit(changes, self._stamp_ns)
        if self._views is not None:
            self._views.keep(images, changes)

    def write_map(self) -> Path:
        """Write the map that it makes to its map file; returns where."""
        path = map_path(self._options.data, self.map_id)
        write_map_file(path, MapFile("agent", str(self.map_id), tuple(self.pipeline.map.contents())))
        return path

    def _write(self, left: MapId, kept: RetainedMap) -> None:
        """Write a map that is left to its map file, as the journal has it."""
        if kept.complaint:
            self._set_aside(left)
        if kept.contents:
            write_map_file(map_path(self._options.data, left), MapFile("agent", str(left), kept.contents))

    def _set_aside(self, map_id: MapId) -> None:
        """The journal has lost something of a map: its file, which may hold that, is not written over."""
        path = map_path(self._options.data, map_id)
        aside = path.with_name(f"{map_id}.before-damage{path.suffix}")
        if path.exists() and not aside.exists():
            path.rename(aside)
            self._say(f"the map file written before is kept as {aside}")

    def _unknown_goal(self, node: NodeId) -> str:
        known = self.pipeline.map.nodes
        if node.map != self.map_id or node in known:
            return ""
        # A copy, since the loop may add one meanwhile.
        nearest = min(list(known), key=lambda one: abs(one.number - node.number), default=None)
        return f"there is no node {node}" + (f"; the nearest is {nearest}" if nearest is not None else "")

    def _placed(self) -> int:
        return self.merged_poses.count(self.map_id)

    def _leave(self) -> None:
        if self._trajectory is not None:
            try:
                self._trajectory.close()
            except InvalidFile as error:
                self._say(str(error))
        self._fleet.close()
        self._left_maps.close()
        self.merged_poses.close()
        self.replicator.close()

    def close(self) -> None:
        """Commit what was mapped and leave the fleet. The bus stays open."""
        self._portal_command.close()
        if self._geometry is not None:
            self._geometry.close(self.pipeline.calibration)
        self._leave()
        if self._views is not None:
            self._views.close()
        self.missions.save()
        self.journal.close()

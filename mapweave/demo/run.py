"""The demo from beginning to end."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

from agent.fleet import encode_mission
from agent.mission import GoTo, Idle, Mission
from hybridmap.errors import MapweaveError, NotConnected
from hybridmap.hybrid_map import HybridMap
from hybridmap.node import NodeId
from hybridmap.pose import Pose2
from mapweave.demo.kidnapping import Kidnapping, NothingToShow, plan_kidnapping
from mapweave.demo.options import DemoOptions
from mapweave.demo.processes import Children, free_port
from mapweave.demo.report import Report
from mapweave.demo.show import Show
from mapweave.demo.watch import Watch
from mapweave.picture import Drive, MapPicture, draw_map, outline_of
from mapweave.scoring import MapScore, posture_error, score_map, write_tum
from sim.control import SimControl
from wire.bus_settings import BusSettings
from wire.keys import Keys
from wire.mapfile import MapFile, unpack_map_file, write_map_file
from wire.zenoh_bus import ZenohBus

FLEET = "demo"
SERVER = "s0"
REACHED_M = 0.05
REACHED_DEG = 3.0
PARTS = (0.0, 0.05, 0.65, 0.7, 0.97)
"""Shares of the bar at which the stages begin: start, explore, merge, lost, score."""


def run_demo(options: DemoOptions) -> Report:
    """Run everything; leave report, picture and maps in the output folder.

    Returns:
        The report, also when the robot did not arrive: `notes` says what was missed.

    Raises:
        MapweaveError: something could not be started, or ended.
    """
    began = time.monotonic()
    _make_room(options.out)
    robots = tuple(f"r{k}" for k in range(options.robots))
    report = Report(seed=options.seed, agents=list(robots))
    with ExitStack() as stack:
        children = stack.enter_context(Children(options.out / "logs"))
        show = stack.enter_context(Show(robots, options.quiet))
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        bus = stack.enter_context(_bus(endpoint))
        demo = Demo(options, robots, endpoint, bus, children, show, report)
        demo.start()
        demo.explore()
        demo.merge()
        demo.lose_and_find()
        demo.score()
        report.wall_s = time.monotonic() - began
        demo.end()
    report.wall_s = round(time.monotonic() - began, 2)
    report.real_time_factor = round(report.sim_s / report.wall_s, 3)
    (options.out / "report.json").write_text(json.dumps(report.as_dict(), indent=2) + "\n")
    return report


class Demo:
    """The stages, in order; each takes up where the one before left the fleet."""

    def __init__(
        self,
        options: DemoOptions,
        robots: tuple[str, ...],
        endpoint: str,
        bus: ZenohBus,
        children: Children,
        show: Show,
        report: Report,
    ) -> None:
        """Take the means."""
        self._options = options
        self._robots = robots
        self._endpoint = endpoint
        self._bus = bus
        self._keys = Keys(FLEET)
        self._children = children
        self._show = show
        self._report = report
        self._control = SimControl(bus, FLEET)
        self._watch = Watch(bus, self._keys)
        self._merged: MapFile | None = None
        self._truth: dict[NodeId, Pose2] = {}
        self._plot: Kidnapping | None = None
        self._kidnapped_ns = 0
        self._stage = (0.0, "starting")

    # Stages

    def start(self) -> None:
        """Server, simulator, agents."""
        self._enter(0, "starting")
        out, seed = self._options.out, self._options.seed
        network = ["--fleet", FLEET]
        self._children.start(
            "server",
            ["server", "--listen", self._endpoint, "--name", SERVER, "--data", str(out / "server"), *network],
        )
        self._until(lambda: self._bus.connected(), 30.0, "the map server does not come up")
        network += ["--connect", self._endpoint]
        self._children.start(
            "sim",
            [
                "sim",
                "--robots",
                str(len(self._robots)),
                "--rooms",
                str(self._options.rooms),
                "--seed",
                str(seed),
                *network,
            ],
        )
        for k, name in enumerate(self._robots):
            self._children.start(
                name,
                ["agent", name, "--data", str(out), "--epoch", "1", "--seed", str(seed * 16 + k),
                 "--lockstep", "--mission", "explore", *network],
            )  # fmt: skip
        self._until(lambda: len(self._watch.agents()) == len(self._robots), 60.0, "an agent does not come up")

    def explore(self) -> None:
        """Let the robots map until their maps have joined, and a little longer."""
        self._enter(1, "exploring: each robot maps its part")
        joined_at: float | None = None
        while True:
            now = self._seconds()
            server, agents = self._watch.server, self._watch.agents()
            whole = server.components == 1 and server.maps == len(self._robots)
            joined_at = (now if joined_at is None else joined_at) if whole else None
            if joined_at is not None and now >= max(
                joined_at + self._options.settle, self._options.least_explore
            ):
                break
            if now >= self._options.most_explore:
                self._note(f"the maps had not joined after {now:.0f} s: {server.summary}")
                break
            if agents and all(a.status.finished for a in agents.values()):
                break
            self._tick(min(now / self._options.least_explore, 1.0))

    def merge(self) -> None:
        """Everybody stands still; the server takes in the rest."""
        self._enter(2, "merging: the server takes in the rest")
        for name in self._robots:
            self._command(name, Idle())
        self._until(
            lambda: all(a.status.mission == "idle" for a in self._watch.agents().values()),
            20.0,
            "no agent stops",
        )
        self._until(self._settled, 60.0, "the server does not settle")
        reply = next(
            (r for r in self._bus.ask(self._keys.server_map(SERVER), b"", 30.0) if not r.error), None
        )
        if reply is None:
            raise NotConnected("the map server did not hand out the merged map")
        self._merged = unpack_map_file(reply.payload)
        write_map_file(self._options.out / "merged.mapweave", self._merged)
        stamps: dict[str, list[tuple[NodeId, int]]] = {}
        for node in HybridMap(self._merged.changes).nodes.values():
            stamps.setdefault(node.id.agent, []).append((node.id, node.stamp_ns))
        for name, nodes in stamps.items():
            poses = self._control.truth_at(name, [stamp for _, stamp in nodes])
            self._truth.update(zip([node for node, _ in nodes], poses, strict=True))

    def lose_and_find(self) -> None:
        """Kidnap one robot, give it a goal, and wait until it has arrived."""
        self._enter(3, "a robot is kidnapped")
        assert self._merged is not None
        status = self._control.status()
        try:
            plot = plan_kidnapping(
                HybridMap(self._merged.changes),
                {n: c for n, (c, _) in self._merged.postures.items()},
                self._truth,
                self._control.plan(),
                self._robots,
                [r.world_from_robot for r in status.robots.values()],
                self._options.seed,
            )
        except NothingToShow as reason:
            self._note(str(reason))
            return
        self._plot = plot
        self._report.lost_robot, self._report.put_down_in = plot.robot, plot.room
        self._report.goal.node, self._report.goal.mapped_by = str(plot.goal), plot.goal.agent
        self._control.kidnap(plot.robot, plot.world_from_robot)
        self._kidnapped_ns = self._control.status().stamp_ns
        self._command(plot.robot, GoTo(plot.goal))
        began = self._kidnapped_ns / 1e9
        self._enter(3, f"{plot.robot} is lost in {plot.room}; it shall go to {plot.goal}")
        while (now := self._seconds()) < began + self._options.most_drive:
            agent = self._watch.agents().get(plot.robot)
            if agent is not None and agent.status.mission == "goto" and agent.status.finished:
                break
            self._tick((now - began) / self._options.most_drive)
        else:
            self._note(f"{plot.robot} had not arrived after {self._options.most_drive:.0f} s")

    def score(self) -> None:
        """Compare with the truth, draw the picture."""
        self._enter(4, "scoring")
        assert self._merged is not None
        whole = HybridMap(self._merged.changes)
        postures = {n: (c, p.mean) for n, (c, p) in self._merged.postures.items()}
        links = [e for e in whole.edges.values() if e.a.map != e.b.map]
        score = score_map(postures, links, self._truth)
        report, server = self._report, self._watch.server
        for name in self._robots:
            report.nodes[name] = sum(n.agent == name for n in whole.nodes)
        report.bytes_per_node = round(server.payload_bytes / max(server.node_puts, 1), 1)
        report.components, report.links, report.false_links = score.components, score.links, score.false_links
        report.merged_ate_m = round(score.ate, 4) if np.isfinite(score.ate) else None
        status = self._control.status()
        report.collisions = sum(robot.collisions for robot in status.robots.values())
        report.sim_s = round(status.stamp_ns / 1e9, 1)
        for name in self._robots:
            stamps, poses = self._control.trajectory(name)
            write_tum(self._options.out / f"{name}.truth.tum", stamps, poses)
        drive = self._score_drive() if self._plot is not None else None
        self._draw(score, whole, drive)

    def end(self) -> None:
        """Everybody writes its files and goes."""
        self._watch.close()
        for name in (*self._robots, "sim", "server"):
            self._children.end(name)

    # Parts of the stages

    def _score_drive(self) -> Drive:
        plot, report = self._plot, self._report
        assert plot is not None
        stamps, poses = self._control.trajectory(plot.robot)
        first = self._watch.first_fix(plot.robot)
        if first is not None and first.fix_node is not None:
            true = Pose2.from_vector(poses[int(np.searchsorted(stamps, first.stamp_ns))])
            answered = self._truth[first.fix_node] @ first.status.node_from_robot
            distance, angle = posture_error(answered, true)
            found = report.relocalization
            found.found, found.node = True, str(first.fix_node)
            found.error_m, found.error_deg = round(distance, 4), round(float(np.degrees(angle)), 3)
            found.seconds = round((first.stamp_ns - self._kidnapped_ns) / 1e9, 1)
        last = self._watch.agents()[plot.robot]
        final = Pose2.from_vector(poses[-1])
        distance, angle = posture_error(final, self._truth[plot.goal])
        goal = report.goal
        goal.error_m, goal.error_deg = round(distance, 4), round(float(np.degrees(angle)), 3)
        goal.edges = max(last.status.legs - 1, 0)
        goal.seconds = round((last.stamp_ns - self._kidnapped_ns) / 1e9, 1)
        goal.reached = last.status.finished and distance <= REACHED_M and goal.error_deg <= REACHED_DEG
        driven = poses[int(np.searchsorted(stamps, self._kidnapped_ns)) + 1 :, :2]
        return Drive(driven, plot.world_from_robot, self._truth[plot.goal], f"drive of {plot.robot}")

    def _draw(self, score: MapScore, whole: HybridMap, drive: Drive | None) -> None:
        assert self._merged is not None
        places = {
            n: score.world_from_merged @ p.mean for n, (c, p) in self._merged.postures.items() if c == 0
        }
        title = (
            f"seed {self._options.seed}: {len(self._robots)} robots, {len(places)} nodes, "
            f"{score.links} links ({score.false_links} false), ATE {score.ate:.3f} m"
        )
        picture = MapPicture(
            title,
            places,
            list(whole.edges.values()),
            outline_of(self._control.plan()),
            [drive] if drive else [],
        )
        draw_map(picture, self._options.out / "map.png")

    def _settled(self) -> bool:
        mapped = sum(a.status.nodes for a in self._watch.agents().values())
        return self._watch.server.settled and self._watch.server.nodes == mapped

    def _command(self, agent: str, mission: Mission) -> None:
        replies = self._bus.ask(self._keys.mission(agent), encode_mission(mission), 10.0)
        if not replies or replies[0].error:
            why = replies[0].error if replies else "no answer"
            raise NotConnected(f"agent {agent} did not take its mission: {why}")

    def _seconds(self) -> float:
        """Simulated time by the last that any agent said."""
        return max((a.stamp_ns for a in self._watch.agents().values()), default=0) / 1e9

    def _note(self, text: str) -> None:
        self._report.notes.append(text)
        self._show.say(text)

    # Progress

    def _enter(self, number: int, stage: str) -> None:
        self._stage = (PARTS[number], stage)
        self._number = number
        self._tick(0.0, 0.0)

    def _tick(self, share: float, pause: float = 0.2) -> None:
        begin = PARTS[self._number]
        end = PARTS[self._number + 1] if self._number + 1 < len(PARTS) else 1.0
        self._show.update(begin + (end - begin) * min(max(share, 0.0), 1.0), self._stage[1], self._watch)
        self._children.check()
        time.sleep(pause)

    def _until(self, condition: Callable[[], bool], patience: float, complaint: str) -> None:
        began = time.monotonic()
        while not condition():
            waited = time.monotonic() - began
            if waited > patience:
                raise MapweaveError(
                    f"{complaint} (waited {patience:.0f} s; see {self._options.out / 'logs'})"
                )
            self._tick(waited / patience, 0.1)


@contextmanager
def _bus(endpoint: str) -> Iterator[ZenohBus]:
    bus = ZenohBus(BusSettings(mode="client", endpoints=(endpoint,)))
    try:
        yield bus
    finally:
        bus.close()


def _make_room(out: Path) -> None:
    """An empty output folder; only what an earlier demo made is removed."""
    out.mkdir(parents=True, exist_ok=True)
    for pattern in ("*.sqlite*", "*.mapweave", "*.tum", "map.png", "report.json"):
        for old in out.glob(pattern):
            old.unlink()
    for folder in ("server", "logs"):
        shutil.rmtree(out / folder, ignore_errors=True)

"""One robot as a process: body, mind, disk and link put together."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn

from agent.drivers.robot import Robot
from agent.fleet import FleetLink
from agent.journal import Journal
from agent.mission import Idle, Mission
from agent.pipeline import Pipeline, PipelineSettings, Step
from agent.replication import Replicator
from agent.runner import Runner
from wire.keys import Keys
from wire.mapfile import MapFile, write_map_file
from wire.zenoh_bus import ZenohBus


@dataclass(frozen=True)
class AgentOptions:
    """How an agent process runs.

    Attributes:
        name: in the fleet.
        data: folder for its journal and its map file.
        epoch: number of the new map; None takes the clock's seconds, which only grow.
        mission: at the start.
        seed: of the random choices in exploration.
        lockstep: wait for answers between ticks.
        server: whose acknowledgement lets changes be forgotten.
        total: observations that will come, if that is known.
        patience: how long to wait at the end until the server has everything, s.
    """

    name: str
    data: Path
    epoch: int | None = None
    mission: Mission = field(default_factory=Idle)
    seed: int = 0
    lockstep: bool = False
    server: str = "s0"
    total: int | None = None
    patience: float = 5.0


def run_agent(
    robot: Robot,
    bus: ZenohBus,
    keys: Keys,
    settings: PipelineSettings,
    options: AgentOptions,
    stop: threading.Event,
) -> None:
    """Run a robot until its body ends or `stop` is set, then write its map file.

    Raises:
        MapweaveError: the body cannot be read, or the disk cannot be written; one line says which.
    """
    # One core a robot: OpenCV's own threads would only fight over it.
    cv2.setNumThreads(1)
    options.data.mkdir(parents=True, exist_ok=True)
    console = Console(stderr=True)
    journal = Journal(options.data / f"{options.name}.sqlite", options.name)
    epoch = options.epoch if options.epoch is not None else int(time.time())
    map_id = journal.open_map(epoch)
    pipeline = Pipeline(map_id, robot.describe(), replace(settings, seed=options.seed))
    pipeline.set_mission(options.mission)
    replicator = Replicator(bus, keys, journal, map_id, servers=(options.server,))
    fleet = FleetLink(bus, keys, map_id)
    try:
        with _progress(console, options) as show:
            Runner(robot, pipeline, fleet, replicator, options.lockstep, show).run(stop)
    finally:
        robot.close()
        fleet.close()
        replicator.flush(10.0)
        path = options.data / f"{options.name}.mapweave"
        write_map_file(path, MapFile("agent", str(map_id), tuple(pipeline.map.contents()), {}))
        nodes, edges = len(pipeline.map.nodes), len(pipeline.map.edges)
        console.print(f"{options.name}: {nodes} nodes and {edges} edges in {path}")
        _hand_over(console, replicator, bus, options)
        replicator.close()
        journal.close()


def _hand_over(console: Console, replicator: Replicator, bus: ZenohBus, options: AgentOptions) -> None:
    if options.patience <= 0:
        console.print("offline: the map stays in the journal and is sent when a server can be reached")
    elif not bus.wait_connected(min(2.0, options.patience)):
        console.print("no server in reach: the map stays in the journal and is sent when one can be reached")
    elif replicator.wait_acknowledged(options.patience):
        console.print(f"server {options.server} has it all")
    else:
        console.print(
            f"server {options.server} has not said that it has it all: the rest stays in the journal"
        )


class _progress:
    """Progress of a run: with a bar where the end is known, else a line when something changes."""

    def __init__(self, console: Console, options: AgentOptions) -> None:
        self._console = console
        self._options = options
        self._bar: Progress | None = None
        self._said = ""

    def __enter__(self) -> _progress:
        if self._options.total is not None:
            self._bar = Progress(
                SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
                TextColumn("{task.fields[detail]}"), console=self._console,
            )  # fmt: skip
            self._task = self._bar.add_task(self._options.name, total=self._options.total, detail="")
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def __call__(self, step: Step) -> None:
        status = step.status
        if self._bar is not None:
            self._bar.update(self._task, advance=1, detail=f"{status.nodes} nodes, {status.detail}")
        elif status.doing != self._said:
            self._said = status.doing
            self._console.print(
                f"{self._options.name}: {status.doing} ({status.nodes} nodes) {status.detail}"
            )

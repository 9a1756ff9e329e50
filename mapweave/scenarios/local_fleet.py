"""A fleet in one process: the same agents and the same server over a bus in memory."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from mapweave.agent.observation import Command, Observation
from mapweave.agent.pipeline import TickResult
from mapweave.agent.synchronization import LockstepWaiting
from mapweave.hybridmap.errors import MapweaveError
from mapweave.mapserver.merging.merge_surroundings import MergeSurroundings
from mapweave.mapserver.schedule import LockstepSchedule
from mapweave.mapserver.server import MapServer, ServerSettings
from mapweave.processes.agent import Agent, AgentOptions
from mapweave.processes.agent_process import tick_logs
from mapweave.scenarios.actions import MISSION_KINDS
from mapweave.scenarios.fleet import FIRST_EPOCH, FLEET, SERVER, TrialStage
from mapweave.settings import load_settings
from mapweave.sim.ground_truth_client import SimControl
from mapweave.sim.ground_truth_service import GroundTruthService
from mapweave.sim.keys import SimKeys
from mapweave.sim.simulation import Simulation
from mapweave.wire.bus import Request
from mapweave.wire.memory import MemoryBus, MemoryHub, MessageFaults

if TYPE_CHECKING:
    from mapweave.processes.tick_log import TickLog

OVERTAKEN = 0.5
"""Share of a bad network's messages that later ones overtake."""


class LocalFleet:
    """Calls every agent itself, tick by tick. Its answers are those of a fleet of processes."""

    def __init__(self, stage: TrialStage) -> None:
        """Prepare; nothing runs yet."""
        self._stage = stage
        self.keys = SimKeys(FLEET)
        self._hub = MemoryHub()
        self.bus = MemoryBus(self._hub)
        self.control = SimControl(self.bus, FLEET, timeout=60.0)
        self._buses: dict[str, MemoryBus] = {}
        self._agents: dict[str, Agent] = {}
        self._logs: dict[str, list[TickLog]] = {}
        self._commands: dict[str, Command] = {}
        self._server: MapServer | None = None
        self._server_bus: MemoryBus | None = None
        self._simulation: Simulation | None = None
        self._thinking = 0.0
        self._asking = 0.0
        self._log: list[str] = []

    def start(self) -> None:
        """Build the world, start the server, then the agents."""
        cv2.setNumThreads(1)
        stage = self._stage
        self.start_server()
        world = stage.scenario.world(stage.seed)
        self._simulation = simulation = Simulation(world, stage.scenario.robots, stage.seed)
        sim_bus = MemoryBus(self._hub)
        self._buses["sim"] = sim_bus
        # The service answers in the bus's thread while this one waits: never during a tick.
        ground_truth = GroundTruthService(simulation, lambda: set(self._agents), {})

        def answer(request: Request) -> None:
            try:
                request.reply(ground_truth.answer(request.payload))
            except MapweaveError as error:
                request.refuse(str(error))

        sim_bus.serve(self.keys.control(), answer)
        for robot in stage.robots:
            self.start_agent(robot)

    def advance(self, tick: int) -> None:
        """Tick by tick: the world, then every robot, then what they want to know."""
        simulation = self._simulation
        assert simulation is not None
        while simulation.tick < tick:
            simulation.advance(self._commands)
            began = time.perf_counter()
            names = list(self._agents)
            # One after the other: on two threads they took as long, for the interpreter runs one at a time.
            self._commands = dict(zip(names, map(self._tick, names), strict=True))
            asked = time.perf_counter()
            for agent in self._agents.values():
                if agent.runner.has_questions:
                    agent.runner.exchange()
            self._thinking += asked - began
            self._asking += time.perf_counter() - asked

    def _tick(self, robot: str) -> Command:
        assert self._simulation is not None
        return self._agents[robot].tick(self._simulation.observe(robot)).command

    def kill_agent(self, robot: str) -> None:
        """Drop an agent. In lock-step all that it has mapped is on its disk already."""
        self._agents.pop(robot).close()
        for log in self._logs.pop(robot):
            if missing := log.close():
                self._log.append(f"{robot}: not in the {log.title}: {missing}")
        self._commands.pop(robot, None)
        self._buses.pop(robot).close()

    def start_agent(self, robot: str) -> None:
        """Start an agent with the disk that is there."""
        stage, simulation = self._stage, self._simulation
        assert simulation is not None
        bus = self._buses[robot] = MemoryBus(self._hub)
        options = AgentOptions(
            name=robot,
            data=stage.agents,
            epoch=FIRST_EPOCH,
            mission=MISSION_KINDS[stage.scenario.missions[robot]],
            seed=stage.agent_seed(robot),
            synchronization=LockstepWaiting(),
            server=SERVER,
            rerun=stage.rerun_log(robot),
            mcap_log=stage.mcap_folder(robot),
        )
        logs = self._logs[robot] = tick_logs(options)

        def stepped(observation: Observation, step: TickResult) -> None:
            for log in logs:
                log.step(observation, step, self._agents[robot].pipeline)

        self._agents[robot] = Agent(
            lambda: simulation.describe(robot), bus, self.keys, stage.settings, options, stepped,
            self._log.append,
        )  # fmt: skip

    def kill_server(self) -> None:
        """Drop the server and its bus."""
        if self._server is not None and self._server_bus is not None:
            self._server.__exit__(None, None, None)
            self._server_bus.close()
            self._server = self._server_bus = None

    def start_server(self) -> None:
        """Start the server with the disk that is there."""
        self._stage.store.parent.mkdir(parents=True, exist_ok=True)
        self._server_bus, file = MemoryBus(self._hub), self._stage.settings_file
        settings = ServerSettings(merge=load_settings(file).merge)
        self._server = MapServer(
            self._server_bus, self.keys, self._stage.store, SERVER, settings, LockstepSchedule(),
            surroundings=MergeSurroundings.repeatable,
        )  # fmt: skip
        self._server.__enter__()

    def cut(self, robot: str) -> None:
        """Take a robot's bus off the hub."""
        self._hub.cut(self._buses[robot])

    def worsen(self, robot: str, loss: float, delay: float) -> None:
        """Lose some of what the robot publishes, and let later messages overtake some."""
        faults = MessageFaults(drop=loss, delay=OVERTAKEN if delay > 0.0 else 0.0)
        random = np.random.default_rng([self._stage.seed, 0x105E, self._stage.robots.index(robot)])
        self._hub.disturb(faults, random, self._buses[robot])

    def restore(self, robot: str) -> None:
        """Put the bus back, and treat it well."""
        self._hub.restore(self._buses[robot])
        self._hub.calm(self._buses[robot])

    def end(self) -> None:
        """Close everything, the server last; the output is written."""
        for robot in list(self._agents):
            agent = self._agents[robot]
            agent.write_map()
            agent.replicator.flush(10.0)
            self.kill_agent(robot)
        for bus in self._buses.values():
            bus.close()
        self.kill_server()
        if self._simulation is not None:
            self._simulation.close()
        self.bus.close()
        self._write_log(self._stage.out / "logs")

    def _write_log(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "agents.log").write_text("".join(f"{line}\n" for line in self._log), encoding="utf-8")

    def wall(self) -> dict[str, float]:
        """The simulator's parts, the robots' share (drawing included), and questions to the server."""
        parts = dict(self._simulation.seconds) if self._simulation is not None else {}
        return {**parts, "robots": self._thinking, "questions": self._asking}

"""A fleet of processes over Zenoh, as on real robots: each may be killed, each network may be cut."""

import logging
import time
from collections.abc import Callable

from mapweave.hybridmap.errors import MapweaveError, NotConnected
from mapweave.scenarios.children import Children, free_port
from mapweave.scenarios.fleet import FIRST_EPOCH, FLEET, SERVER, TrialStage
from mapweave.scenarios.network_emulator import NetworkEmulator
from mapweave.sim.ground_truth_client import SimControl
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.zenoh_bus import ZenohBus

log = logging.getLogger(__name__)

PATIENCE = 60.0
"""How long a process may take to come up, s."""
COMPILING = 300.0
"""How long the first agents may take, s: on a computer that has run none, each compiles what runs often, one
beside the other."""
CHECK_EVERY = 2.0
"""How often the processes are checked while time passes, s."""
SAY_EVERY = 15.0
"""While it waits for a process it says so, s."""


class ProcessFleet:
    """Server, simulator and agents as processes on this machine.

    Robots reach their bases over the simulator's own endpoint and the fleet over the server's, since a
    robot's wheels do not depend on its Wi-Fi. Robots whose network the scenario touches reach the server over
    a cable.
    """

    def __init__(self, stage: TrialStage) -> None:
        """Prepare; nothing runs yet."""
        self._stage = stage
        self.keys = Keys(FLEET)
        self._fleet_port, self._simulator_port = free_port(), free_port()
        self._children = Children(stage.out / "logs")
        self._emulators: dict[str, NetworkEmulator] = {}
        self.bus = _client(self._fleet_port)
        self._sim_bus = _client(self._simulator_port)
        self.control = SimControl(self._sim_bus, FLEET, timeout=60.0)

    def start(self) -> None:
        """Server, simulator, agents; returns when every robot has asked for its first step."""
        stage, scenario = self._stage, self._stage.scenario
        touched = {e.table["robot"] for e in scenario.events if e.table["do"] in ("cut", "worsen", "restore")}
        self._emulators = {robot: NetworkEmulator(self._fleet_port, stage.seed) for robot in sorted(touched)}
        overrides = [part for override in scenario.overrides for part in ("--set", override)]
        self.start_server()
        self._children.start(
            "sim",
            ["sim", "serve", str(scenario.path), "--seed", str(stage.seed), *overrides, "--held",
             "--listen", _endpoint(self._simulator_port), "--fleet", FLEET],
        )  # fmt: skip
        self._until(self._simulating, "the simulator does not come up")
        for robot in stage.robots:
            self._start_agent(robot)
        self._until(lambda: self._active() == set(stage.robots), "an agent does not come up", COMPILING)

    def advance(self, tick: int) -> None:
        """Let the simulator go on, and check the processes now and then."""
        while not self.control.advance(tick, CHECK_EVERY):
            self._children.check()

    def kill_agent(self, robot: str) -> None:
        """SIGKILL."""
        self._children.kill(robot)
        self._until(
            lambda: robot not in self._active(), f"the simulator does not notice that {robot} is gone"
        )

    def start_agent(self, robot: str) -> None:
        """Start it again; returns when it has asked for a step."""
        self._start_agent(robot)
        self._until(lambda: robot in self._active(), f"agent {robot} does not come up")

    def _start_agent(self, robot: str) -> None:
        stage = self._stage
        port = self._emulators[robot].port if robot in self._emulators else self._fleet_port
        arguments = [
            "agent", robot, "--data", str(stage.agents), "--epoch", str(FIRST_EPOCH),
            "--seed", str(stage.agent_seed(robot)), "--lockstep", "--fleet", FLEET,
            "--mission", stage.scenario.missions[robot],
            "--connect", _endpoint(port), "--body", _endpoint(self._simulator_port),
        ]  # fmt: skip
        for option, log in (("--rerun", stage.rerun_log(robot)), ("--mcap-log", stage.mcap_folder(robot))):
            arguments += [option, log] if log else []
        self._children.start(robot, [*arguments, *self._settings()])

    def _settings(self) -> list[str]:
        file = self._stage.settings_file
        return [] if file is None else ["--settings", str(file)]

    def kill_server(self) -> None:
        """SIGKILL; the router goes with it."""
        self._children.kill("server")
        self._until(lambda: not self.bus.connected(), "the network does not notice that the server is gone")

    def start_server(self) -> None:
        """Start it; returns when this process is connected."""
        self._children.start(
            "server",
            ["server", "--listen", _endpoint(self._fleet_port), "--name", SERVER, "--fleet", FLEET,
             "--data", str(self._stage.store.parent), "--lockstep", *self._settings()],
        )  # fmt: skip
        self._until(self.bus.connected, "the map server does not come up")

    def cut(self, robot: str) -> None:
        """Cut the robot's cable."""
        self._emulators[robot].cut()

    def worsen(self, robot: str, loss: float, delay: float) -> None:
        """Make the robot's cable bad."""
        self._emulators[robot].worsen(loss, delay)

    def restore(self, robot: str) -> None:
        """Mend the robot's cable."""
        self._emulators[robot].restore()

    def end(self) -> None:
        """Agents first: they hand over what they have; the server last."""
        self._children.end(*self._stage.robots)
        self._children.end("sim", "server")
        for emulator in self._emulators.values():
            emulator.close()
        self._emulators.clear()
        self.bus.close()
        self._sim_bus.close()

    def wall(self) -> dict[str, float]:
        """What the simulator has measured."""
        return dict(self.control.status().wall)

    def _simulating(self) -> bool:
        try:
            return self._sim_bus.connected() and self.control.status().tick == 0
        except NotConnected:
            return False  # its world is not built yet

    def _active(self) -> set[str]:
        return {name for name, robot in self.control.status().robots.items() if robot.active}

    def _until(self, condition: Callable[[], bool], complaint: str, patience: float | None = None) -> None:
        patience, began, logs = patience or PATIENCE, time.monotonic(), self._stage.out / "logs"
        say_at = began + SAY_EVERY
        while not condition():
            self._children.check()
            now = time.monotonic()
            if now > began + patience:
                raise MapweaveError(f"{complaint} (waited {patience:.0f} s; see {logs})")
            if now > say_at:
                log.warning(
                    "%s yet: waiting for %.0f s, up to %.0f; see %s", complaint, now - began, patience, logs
                )
                say_at = now + SAY_EVERY
            time.sleep(0.02)


def _endpoint(port: int) -> str:
    return f"tcp/127.0.0.1:{port}"


def _client(port: int) -> ZenohBus:
    return ZenohBus(BusSettings(mode="client", endpoints=(_endpoint(port),)))

"""The processes of a fleet: agents, two servers, two routers between them; killed, frozen, started again.

Agents and servers are clients of two routers that are joined. Each has a link of its own to each of them
(`mapweave.scenarios.network_emulator`), is at one of them, and goes to the other one when that is away.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from itertools import chain
from pathlib import Path

from benchmarks.chaos.agent_process import ENOUGH, FLEET, Orders
from benchmarks.chaos.disorder import flag
from benchmarks.chaos.schedule import Kind
from benchmarks.fleet.drives import name_of
from mapweave.processes import parent_watchdog
from mapweave.scenarios.children import ChildFailed, free_port
from mapweave.scenarios.network_emulator import NetworkEmulator
from synthetic.postgres_server import PostgresServer

SERVERS, ROUTERS, DATABASE = ("s0", "s1"), ("z0", "z1"), "pg"
INTERVAL = 0.25
"""Between two steps of a robot, s."""
SQLITE = "sqlite"
LOST_SEGMENTS, LOSSY_DELAY = 0.2, 0.05
"""Share of TCP's segments that a lossy link loses, and what each takes, s: 39 kB a second are left."""
PATIENCE = 20.0
"""s for a process to end in order."""
NO_DATABASE = "the map store cannot be used"
RESTART = 2.0
"""s after which a server that found no database is started again, as its systemd unit has it."""


class FleetProcesses:
    """All processes of one run, and their links. A context manager."""

    def __init__(
        self, folder: Path, agents: int, seed: int, store: str, postgres: PostgresServer | None = None
    ) -> None:
        """Choose ports and open the links; nothing runs yet.

        Args:
            folder: for journals, stores and logs.
            agents: how many.
            seed: of what they map.
            store: "sqlite" for a file for each server, else the URL of the one that both use.
            postgres: runs it, and may be killed.
        """
        self._postgres = postgres
        self.folder, self._store = folder, store
        self.agents = tuple(name_of(k) for k in range(agents))
        self._ports = {name: free_port() for name in ROUTERS}
        self.links: dict[str, list[NetworkEmulator]] = {
            name: [NetworkEmulator(self._ports[router], seed) for router in ROUTERS]
            for name in (*self.agents, *SERVERS)
        }
        self._commands = {name: self._agent(k, seed) for k, name in enumerate(self.agents)}
        self._commands |= {name: self._server(name) for name in SERVERS}
        self._commands |= {name: self._router(name) for name in ROUTERS}
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._ended_at: dict[str, float] = {}

    def __enter__(self) -> FleetProcesses:
        """Nothing runs yet."""
        return self

    def __exit__(self, *_: object) -> None:
        """End all that runs."""
        for name in list(self._running):
            self.kill(name)
        for link in chain.from_iterable(self.links.values()):
            link.close()

    @property
    def endpoints(self) -> tuple[str, ...]:
        """The endpoints of the routers themselves."""
        return tuple(self._endpoint(name) for name in ROUTERS)

    def store_of(self, server: str) -> str:
        """Path or URL of a server's store."""
        return str(self.folder / server / f"{server}.sqlite") if self._store == SQLITE else self._store

    def start(self, name: str) -> None:
        """Start a process, again or for the first time."""
        if name == DATABASE and self._postgres is not None:
            self._postgres.start()
            return
        self._ended_at.pop(name, None)
        with (self.folder / f"{name}.log").open("ab") as output:
            self._running[name] = subprocess.Popen(
                self._commands[name], stdin=subprocess.PIPE, stdout=output, stderr=subprocess.STDOUT,
                env=parent_watchdog.environment(),
            )  # fmt: skip

    def kill(self, name: str) -> None:
        """End a process at once, without a word."""
        if name == DATABASE and self._postgres is not None:
            self._postgres.kill()
            return
        process = self._running.pop(name)
        process.kill()
        process.communicate()

    def end(self, name: str) -> None:
        """Ask a process to end, and wait.

        Raises:
            ChildFailed: it does not, or not in order.
        """
        process = self._running.pop(name)
        process.terminate()
        try:
            process.communicate(timeout=PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            raise ChildFailed(f"{name} does not end: {self._last_line(name)}") from None
        if process.returncode:
            raise ChildFailed(f"{name} ended with status {process.returncode}: {self._last_line(name)}")

    def check(self) -> None:
        """Raise ChildFailed if a process has ended by itself, other than a robot that is done.

        A server that began while the database was down is started again.
        """
        done = (self.folder / ENOUGH).exists()
        for name, process in tuple(self._running.items()):
            status, now = process.poll(), time.monotonic()
            if status == 1 and name in SERVERS and NO_DATABASE in self._last_line(name):
                if now > self._ended_at.setdefault(name, now) + RESTART:
                    process.communicate()
                    self.start(name)
            elif status is not None and not (done and status == 0 and name in self.agents):
                raise ChildFailed(f"{name} ended with status {status}: {self._last_line(name)}")

    def done(self) -> bool:
        """Whether all agents have ended, since all that they have is acknowledged."""
        return all(self._running[name].poll() == 0 for name in self.agents)

    def mapping(self) -> list[str]:
        """The agents that have not ended."""
        return [name for name in self.agents if self._running[name].poll() is None]

    def stop_mapping(self) -> None:
        """Tell the agents to end when all is acknowledged."""
        (self.folder / ENOUGH).touch()

    def begin(self, kind: Kind, target: str) -> None:
        """Disturb; `end_disturbance` takes it back."""
        match kind:
            case Kind.KILL | Kind.LOSE_STORE:
                self.kill(target)
            case Kind.STOP:
                self._signal(target, signal.SIGSTOP)
            case Kind.DISORDER:
                flag(self.folder, target).touch()
        if kind is Kind.LOSE_STORE:
            path = Path(self.store_of(target))
            for part in path.parent.glob(f"{path.name}*"):
                part.unlink()
        for link in self.links.get(target, []):
            match kind:
                case Kind.CUT | Kind.FLAP:
                    link.cut()
                case Kind.FROZEN:
                    link.freeze()
                case Kind.SLOW:
                    link.worsen(0.0, 0.3, 60e3)
                case Kind.LOSSY:
                    link.lose_segments(LOST_SEGMENTS, LOSSY_DELAY)
                case Kind.HALF:
                    link.half_close()

    def toggle(self, target: str, cut: bool) -> None:
        """Cut the links of a process, or mend them."""
        for link in self.links[target]:
            (link.cut if cut else link.restore)()

    def end_disturbance(self, kind: Kind, target: str) -> None:
        """Restore what was before."""
        match kind:
            case Kind.KILL | Kind.LOSE_STORE:
                self.start(target)
            case Kind.STOP:
                self._signal(target, signal.SIGCONT)
            case Kind.DISORDER:
                flag(self.folder, target).unlink()
        for link in self.links.get(target, []):
            link.restore()

    def _signal(self, name: str, number: signal.Signals) -> None:
        if name in self._running:
            # One that has ended by itself, since it found no database, is left alone.
            self._running[name].send_signal(number)

    def _last_line(self, name: str) -> str:
        lines = (self.folder / f"{name}.log").read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it printed nothing"

    def _endpoint(self, name: str) -> str:
        return f"tcp/127.0.0.1:{self._ports[name]}"

    def _routers_of(self, name: str) -> list[str]:
        """Half of the fleet has the one router first, half the other."""
        endpoints = [f"tcp/127.0.0.1:{link.port}" for link in self.links[name]]
        return endpoints if name[-1] in "02468" else endpoints[::-1]

    def _agent(self, robot: int, seed: int) -> Sequence[str]:
        endpoints = tuple(self._routers_of(name_of(robot)))
        orders = Orders(robot, endpoints, str(self.folder), SERVERS, INTERVAL, seed)
        return [sys.executable, "-m", "benchmarks.chaos.agent_process", json.dumps(asdict(orders))]

    def _server(self, name: str) -> Sequence[str]:
        command = [
            sys.executable, "-m", "mapweave", "server", "--name", name, "--fleet", FLEET,
            "--data", str(self.folder / name), "--connect", *self._routers_of(name),
        ]  # fmt: skip
        return command if self._store == SQLITE else [*command, "--store", self._store]

    def _router(self, name: str) -> Sequence[str]:
        others = [self._endpoint(other) for other in ROUTERS if other != name]
        return [
            sys.executable, "-m", "mapweave", "router", "--fleet", FLEET, "--listen", self._endpoint(name),
            "--connect", *others,
        ]  # fmt: skip

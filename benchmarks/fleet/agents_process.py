"""The links of some agents of a fleet, in a process of their own: journal, replication, status, missions.

    python -m benchmarks.fleet.agents_process '{"endpoint": ..., "folder": ..., "first": ..., ...}'

It prints `ready` when every agent has handed over its first node, then reads one line with the time of the
start, prints one JSON object when all is acknowledged, and stays connected until stdin ends: other processes
may still wait. Times are those of the system's monotonic clock, s. It ends with the process that started it.
"""

import ctypes
import heapq
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.fleet.disturbance import MuteBus, SlowJournal, flood
from benchmarks.fleet.drives import drive, name_of
from mapweave.agent.fleet_client import FleetClient
from mapweave.agent.mission_control import MissionControl
from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.replicator import Replicator
from mapweave.hybridmap import jit
from mapweave.hybridmap.agent_status import Status
from mapweave.hybridmap.change import ChangeBody
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.pose import Pose2
from mapweave.wire.bus_settings import AGENT_LEASE, BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.zenoh_bus import ZenohBus

FLEET, SERVER = "fleet", "s0"
INTERVAL = 10.0
"""Between two nodes of a robot, s."""
REPORTS = 2.0
"""Status reports of a robot in a second, as `mapweave agent` sends them; fewer if the server says so."""
CONNECTING = 30.0
"""Longest wait for a session, s."""
PATIENCE = 60.0
"""Longest wait for acknowledgements behind the last change, s."""
PR_SET_PDEATHSIG = 1
"""Of prctl(2)."""


@dataclass(frozen=True)
class Orders:
    """What the process has to do.

    Attributes:
        endpoint: of the router.
        folder: for the journals.
        first: number of its first agent.
        count: of its agents.
        agents: of all processes.
        seconds: of mapping at a node each `INTERVAL`.
        burst: changes of the whole fleet within the second behind that.
        seed: of the drives.
        disturbance: what its agents do to the server, one of `KINDS`; empty: nothing.
    """

    endpoint: str
    folder: str
    first: int
    count: int
    agents: int
    seconds: float
    burst: int
    seed: int
    disturbance: str = ""


class TimedJournal(Journal):
    """A journal that notes when the server's acknowledgement of each change is on the disk.

    Attributes:
        noted: s, by sequence number.
    """

    def __init__(self, path: Path, agent: str) -> None:
        """See Journal."""
        super().__init__(path, agent)
        self.noted: list[float] = []

    def acknowledge(self, server: str, map_id: MapId, watermark: int, reset: bool = False) -> None:
        """See Journal."""
        super().acknowledge(server, map_id, watermark, reset)
        self.noted += [time.monotonic()] * (watermark - len(self.noted))


class SlowTimedJournal(TimedJournal, SlowJournal):
    """A timed journal on a slow disk."""


class AgentLink:
    """One robot's link.

    Attributes:
        submitted: when each change was handed over, s.
        stops: changes that it has yet to hand over, a list for each stop.
    """

    def __init__(self, orders: Orders, number: int, stops: int) -> None:
        """Connect, and open the journal."""
        name = name_of(number)
        keys = Keys(FLEET)
        slow = orders.disturbance == "slow"
        self._bus = (MuteBus if slow else ZenohBus)(
            BusSettings(endpoints=(orders.endpoint,), lease=AGENT_LEASE)
        )
        if not self._bus.wait_connected(CONNECTING):
            raise SystemExit(f"{name} does not get a connection")
        journal = SlowTimedJournal if slow else TimedJournal
        self.journal = journal(Path(orders.folder) / f"{name}.sqlite", name)
        self._map = self.journal.open_map(1)
        self._replicator = Replicator(self._bus, keys, self.journal, self._map, (SERVER,))
        self._client = FleetClient(self._bus, keys, self._map, MissionControl(name))
        self.submitted: list[float] = []
        self._tour = drive(number, stops, orders.seed)
        self.stops: list[list[ChangeBody]] = self._tour.changes[::-1]

    def map_on(self) -> None:
        """Hand over the next stop."""
        bodies = self.stops.pop()
        self.submitted += [time.monotonic()] * len(bodies)
        self._replicator.submit(bodies, time.time_ns())

    def report(self) -> None:
        """Publish a status."""
        self._client.report(Status("mapping", "", 1, 0, Pose2(), True), time.time_ns())

    @property
    def report_period(self) -> float:
        """Time to its next status, s."""
        return max(1.0 / REPORTS, self._replicator.status_period)

    def waits(self) -> bool:
        """Whether something is not acknowledged."""
        return len(self.journal.noted) < len(self.submitted)

    def latencies(self, begin: float, end: float) -> list[float]:
        """Times, s, from handing over to the noted acknowledgement; inf without one."""
        noted = [*self.journal.noted, *[float("inf")] * len(self.submitted)]
        return [b - a for a, b in zip(self.submitted, noted, strict=False) if begin <= a < end]

    def flood(self, until: float) -> None:
        """Send and ask more than it may."""
        flood(self._bus, Keys(FLEET), self.journal, self._map, self._tour.view, until)

    def close(self) -> None:
        """Disconnect."""
        self._client.close()
        self._replicator.close()
        self._bus.close()
        self.journal.close()


class Reporter:
    """Publishes the statuses of agents from when each is connected, as `mapweave agent` does."""

    def __init__(self) -> None:
        """Begin, with no agent."""
        self._changed = threading.Condition()
        self._due: list[tuple[float, int, AgentLink]] = []
        self._count, self._closing = 0, False
        self._thread = threading.Thread(target=self._run, name="statuses", daemon=True)
        self._thread.start()

    def add(self, agent: AgentLink) -> None:
        """An agent is connected: its first status is due."""
        with self._changed:
            heapq.heappush(self._due, (time.monotonic(), self._count, agent))
            self._count += 1
            self._changed.notify()

    def close(self) -> None:
        """Publish no more. Idempotent."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._changed:
                left = self._due[0][0] - time.monotonic() if self._due else None
                if not self._closing and (left is None or left > 0.0):
                    self._changed.wait(left)
                    continue
                if self._closing:
                    return
                _, number, agent = heapq.heappop(self._due)
            agent.report()
            with self._changed:
                heapq.heappush(self._due, (time.monotonic() + agent.report_period, number, agent))


def run_schedule(agents: Sequence[AgentLink], orders: Orders, begin: float, reporter: Reporter) -> None:
    """Nodes of all agents, each at its own times; then the burst, in which none reports."""
    rng = np.random.default_rng([orders.seed, orders.first, 2])
    end = begin + orders.seconds
    due = [(at, k) for k, at in enumerate(first_stops(orders, begin))]
    due += [(end + rng.uniform(0.0, 1.0), number - orders.first) for number in burst_numbers(orders)]
    heapq.heapify(due)
    while due and due[0][0] < end + 1.0:
        at, k = heapq.heappop(due)
        if at >= end:
            reporter.close()
        time.sleep(max(0.0, at - time.monotonic()))
        agents[k].map_on()
        if at + INTERVAL < end:
            heapq.heappush(due, (at + INTERVAL, k))
    # Who has nothing more to map reports on, and disturbs on, for as long as the others map.
    time.sleep(max(0.0, end - time.monotonic()))
    reporter.close()


def first_stops(orders: Orders, begin: float) -> list[float]:
    """When each agent makes its first node of mapping, s."""
    rng = np.random.default_rng([orders.seed, orders.first, 1])
    return [begin + rng.uniform(0.0, INTERVAL) for _ in range(orders.count)]


def burst_numbers(orders: Orders) -> list[int]:
    """Which of these agents make a node in the burst, once for each."""
    # A stop is a node and an edge.
    everyone = np.arange(orders.burst // 2) % orders.agents
    return [int(n) for n in everyone if orders.first <= n < orders.first + orders.count]


def main() -> None:
    """Connect, wait for the start, map, and say how long acknowledgements took."""
    orders = Orders(**json.loads(sys.argv[1]))
    stops = 2 + int(orders.seconds / INTERVAL) + -(-orders.burst // 2 // orders.agents)
    jit.load()  # as a robot does before it maps
    agents, reporter = list[AgentLink](), Reporter()
    for k in range(orders.count):
        agents.append(AgentLink(orders, orders.first + k, stops))
        reporter.add(agents[-1])
        agents[-1].map_on()
    wait_until_acknowledged(agents)
    print("ready", flush=True)
    begin = float(sys.stdin.readline())
    if orders.disturbance == "flooding":
        agents[0].flood(begin + orders.seconds)
    run_schedule(agents, orders, begin, reporter)
    end = begin + orders.seconds
    wait_until_acknowledged(agents)
    print(
        json.dumps({
            "steady": [x for agent in agents for x in agent.latencies(begin, end)],
            "burst": [x for agent in agents for x in agent.latencies(end, end + 100.0)],
            "burst_end": max((t for agent in agents for t in agent.journal.noted), default=end),
        }),
        flush=True,
    )  # fmt: skip
    sys.stdin.read()
    # Closing a thousand sessions one after the other takes longer than the benchmark.
    os._exit(0)


def end_with_parent() -> None:
    """Let Linux kill this process when its parent is gone, also while it is frozen and reads no stdin."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() == 1:  # it was gone before
        os._exit(1)


def wait_until_acknowledged(agents: Sequence[AgentLink]) -> None:
    """Until all is acknowledged, or patience ends."""
    end = time.monotonic() + PATIENCE
    while any(agent.waits() for agent in agents) and time.monotonic() < end:
        time.sleep(0.02)


if __name__ == "__main__":
    end_with_parent()
    main()

"""How many robots one map server carries: what acknowledgements and answers take, and what that costs.

    python -m benchmarks.fleet [--agents N ...] [--seconds S] [--burst N] [--disturb] [--seed N] [--json]

A real `mapweave server` process with its router, over Zenoh on loopback. Each agent has a session, journal,
replicator and fleet client of its own, as on a robot; a process holds up to 125 of them. Each agent maps a
room of its own: a node of 150 landmarks and its edge every 10 s. It makes its first node and begins to report
when it is connected: every 2 s, and then twice a second or as rarely as the server asks. Behind that comes a
burst: so many changes within one second. Meanwhile one more session asks five times a second where it
is. Journals lie in memory, as they are other machines' disks; the server's store is on this machine's disk.

With `--disturb` three more agents hold the server up as well as they can: a slow one, none of whose changes
comes by itself and whose log takes a second to answer, one that is frozen in the middle, and one that sends a
thousand changes and beacons a second and asks where it is from three threads without a pause. The figures are
those of the others.

By number of agents: `connected_s` until all have handed over their first node; `acked_per_s`; `ack_p50_ms`
and `ack_p99_ms` from handing a change over to the journal's note that the server has it; `burst_p99_ms` and
`burst_s`, until all of the burst is acknowledged; `relocalize_p95_ms`; `unacked` changes at the end. Of one
core: `server_cpu`, `router_cpu` (Zenoh's threads in the server's process) and `generator_cpu` (all agents).
`burst_server_ms`, `burst_router_ms` and `burst_generator_ms` are the processor time of each for a change of
the burst, with all that they do until it is acknowledged: their sum is the cores that 1000 changes a second
take.
`disturbers_unacked` are changes of the agents that disturb, at the end, when what was held back or frozen has
been sent again; `said` is the last that the server's status said of each while they disturbed. `floor_*` is a
bare Zenoh question, answered after a bare commit of SQLite, in the same run on a router of its own;
`floor_cpu_ms` is the processor time of the three processes for it. It ends with 1 unless it is `good`: the
largest fleet is as fast as `asked`, all is acknowledged, and something is said of every agent that disturbs.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from benchmarks.command_line import at_least, command_line
from benchmarks.fleet import floor_process
from benchmarks.fleet.agents_process import FLEET, INTERVAL, PATIENCE, Orders, first_stops
from benchmarks.fleet.disturbance import KINDS, THAW_BEFORE, Freeze
from benchmarks.fleet.drives import drive, name_of
from benchmarks.process_usage import Usage, resident_mb, total
from mapweave.hybridmap.agent_status import SILENT, FleetStatus, RobotEntry
from mapweave.hybridmap.query import View
from mapweave.processes import parent_watchdog
from mapweave.scenarios.children import Children, free_port
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.messages import decode, encode_view
from mapweave.wire.zenoh_bus import ZenohBus

AGENTS_PER_PROCESS = 125
QUESTIONS_PER_S = 5.0
STATUS_WITHIN = 5.0
"""Longest wait for the server's status, s."""
BEHIND_AFTER = 1.1
"""From a node of the slow agent until the server knows of it and lacks it, s: the beacon comes after 0.5 s
and more, and the log then takes 1 s to answer."""
CONNECTING = 300.0
"""Longest wait until all agents are connected and have handed over their first node, s."""
ASKED = {"ack_p99_ms": 500.0, "relocalize_p95_ms": 250.0}
"""At most, of the largest fleet."""

Figures = dict[str, float | None]


class Generator:
    """A process with agents of the fleet."""

    def __init__(self, orders: Orders) -> None:
        """Start it."""
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.fleet.agents_process", json.dumps(asdict(orders))],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=dict(os.environ),
        )  # fmt: skip
        self.pid = self._process.pid

    def line(self) -> str:
        """The next line that it prints."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise SystemExit("a process with agents has ended before its time")
        return line

    def start(self, begin: float) -> None:
        """Let its agents map."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{begin}\n")
        self._process.stdin.flush()

    def close(self) -> None:
        """End it."""
        self._process.kill()
        self._process.communicate()


def end_all(generators: Sequence[Generator]) -> None:
    """End them, since they take too long."""
    for generator in generators:
        generator.close()


def ask(bus: ZenohBus, views: Sequence[View], begin: float, end: float) -> tuple[list[float], int]:
    """Ask where it is; returns how long each answer took, s, and how often there was none in time."""
    took, lost = [], 0
    messages = [encode_view(view) for view in views]
    for k in range(questions := round((end - begin) * QUESTIONS_PER_S)):
        time.sleep(max(0.0, begin + k / QUESTIONS_PER_S - time.monotonic()))
        asked = time.monotonic()
        if asked > end:
            # Answers took so long that there is no time left for these.
            lost += questions - k
            break
        replies = bus.ask(Keys(FLEET).any_relocalize(), messages[k % len(messages)], 10.0)
        if replies and not replies[0].error:
            took.append(time.monotonic() - asked)
        else:
            lost += 1
    return took, lost


def measure_fleet(
    agents: int, options: argparse.Namespace, folder: Path, progress: Progress
) -> tuple[Figures, dict[str, str]]:
    """Start a server and so many agents, and let them map; also what it says of those that disturb."""
    step = progress.add_task(f"{agents} agents connect", total=None)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    folder.mkdir()
    with ExitStack() as stack:
        journals = stack.enter_context(tempfile.TemporaryDirectory(dir=memory_folder()))
        children = stack.enter_context(Children(folder / "logs"))
        children.start("server", [
            "server", "--fleet", FLEET, "--listen", endpoint, "--data", str(folder),
        ])  # fmt: skip
        bus = ZenohBus(BusSettings(endpoints=(endpoint,)))
        stack.callback(bus.close)
        if not bus.wait_connected(60.0):
            raise SystemExit("the server does not listen")
        generators = []
        everyone = Orders(endpoint, journals, 0, agents, agents, options.seconds, options.burst, options.seed)
        for first in range(0, agents, AGENTS_PER_PROCESS):
            count = min(AGENTS_PER_PROCESS, agents - first)
            generators.append(Generator(replace(everyone, first=first, count=count)))
            stack.callback(generators[-1].close)
        disturbers = {}
        for number, kind in enumerate(KINDS if options.disturb else (), agents):
            orders = replace(everyone, first=number, count=1, disturbance=kind)
            disturbers[kind] = Generator(orders)
            stack.callback(disturbers[kind].close)
        began = time.monotonic()
        connecting = threading.Timer(CONNECTING, end_all, ([*generators, *disturbers.values()],))
        stack.callback(connecting.cancel)
        connecting.start()
        for generator in (*generators, *disturbers.values()):
            generator.line()
        connecting.cancel()
        connected = time.monotonic() - began
        children.check()
        views = [drive(k, 1, options.seed).view for k in range(min(agents, 20))]
        begin = time.monotonic() + 1.0
        end = begin + options.seconds
        for generator in (*generators, *disturbers.values()):
            generator.start(begin)
        if "frozen" in disturbers:
            Freeze(disturbers["frozen"], begin, end).start()
        progress.update(step, description=f"{agents} agents map", total=options.seconds + 1.0)
        asked: list[tuple[list[float], int]] = []
        asking = threading.Thread(target=lambda: asked.append(ask(bus, views, begin, end + 1.0)), daemon=True)
        asking.start()
        server, pids = children.pid("server"), [generator.pid for generator in generators]
        time.sleep(max(0.0, begin - time.monotonic()))
        usage = Usage(server)

        def used() -> NDArray[np.float64]:
            """Of the server's own threads, of Zenoh's in its process, and of all agents, s."""
            return np.array([*usage.take(), total(pids)])

        before = used()
        names = {name_of(number): kind for number, kind in enumerate(disturbers, agents)}
        slow = replace(everyone, first=agents, count=1)
        asked_about = StatusAsker(bus, names, when_behind(slow, begin), end) if disturbers else None
        while time.monotonic() < end:
            time.sleep(min(0.2, max(0.0, end - time.monotonic())))
            usage.take()
            progress.update(step, completed=time.monotonic() - begin)
        took, mapped = time.monotonic() - begin, used()
        rss = resident_mb(server)
        asking.join()
        said = asked_about.result() if asked_about else {}
        progress.update(step, description=f"{agents} agents wait for acknowledgements", total=None)
        results = [json.loads(generator.line()) for generator in generators]
        in_burst = used() - mapped
        disturbed = {kind: json.loads(disturber.line()) for kind, disturber in disturbers.items()}
        children.check()
        progress.update(step, description=f"{agents} agents", total=1, completed=1)
    steady = np.array([x for result in results for x in result["steady"]])
    burst = np.array([x for result in results for x in result["burst"]])
    (answers, unanswered), *_ = asked
    own, zenoh, generated = ((mapped - before) / took).tolist()
    figures: Figures = {
        "connected_s": round(connected, 1),
        "acked_per_s": round(float(np.isfinite(steady).sum()) / options.seconds, 1),
        "ack_p50_ms": milliseconds(steady, 50),
        "ack_p99_ms": milliseconds(steady, 99),
        "burst": len(burst),
        "burst_p99_ms": milliseconds(burst, 99),
        "burst_s": round(max(result["burst_end"] for result in results) - end, 2) if len(burst) else None,
        **{
            f"burst_{who}_ms": round(1e3 * spent / len(burst), 2) if len(burst) else None
            for who, spent in zip(("server", "router", "generator"), in_burst.tolist(), strict=True)
        },
        "unacked": int((~np.isfinite(steady)).sum() + (~np.isfinite(burst)).sum()),
        "relocalize_p95_ms": milliseconds(np.array(answers), 95),
        "unanswered": unanswered,
        "server_cpu": round(own, 3),
        "router_cpu": round(zenoh, 3),
        "generator_cpu": round(generated, 3),
        "server_rss_mb": round(rss),
    }  # fmt: skip
    if disturbers:
        unacked = [x for result in disturbed.values() for x in (*result["steady"], *result["burst"])]
        figures["disturbers_unacked"] = sum(x == float("inf") for x in unacked)
    return figures, said


class StatusAsker:
    """Asks for the server's status while agents disturb, in a thread of its own.

    What is said of an agent goes by: one that is behind catches up, one that is frozen goes on again. An
    answer about a thousand robots takes the server long, so it is asked for few.
    """

    def __init__(self, bus: ZenohBus, names: Mapping[str, str], behind: Sequence[float], end: float) -> None:
        """Begin.

        Args:
            bus: the connection; stays the caller's.
            names: of the agents that disturb, with the kind of each.
            behind: when the slow one is probably behind, s: it is asked until it is said to be.
            end: of mapping, s: shortly before it is asked about all of them.
        """
        self._bus, self._names = bus, names
        last = end - 2 * THAW_BEFORE
        self._moments = sorted([*((at, "slow") for at in behind), (last, "")])
        self._said = dict.fromkeys(names.values(), "")
        self._answers = 0
        self._thread = threading.Thread(target=self._run, name="status", daemon=True)
        self._thread.start()

    def result(self) -> dict[str, str]:
        """The last that was said of each kind; empty if nothing ever was.

        Raises:
            SystemExit: the server has never answered.
        """
        self._thread.join()
        if not self._answers:
            raise SystemExit("the server does not answer who is behind, silent or over its quota")
        return self._said

    def _run(self) -> None:
        for at, kind in self._moments:
            if self._said.get(kind):
                continue
            time.sleep(max(0.0, at - time.monotonic()))
            for reply in self._bus.ask(Keys(FLEET).any_robots(), b"", STATUS_WITHIN):
                if not reply.error:
                    self._note(decode(reply.payload, FleetStatus))
                    self._answers += 1

    def _note(self, status: FleetStatus) -> None:
        for entry in status.robots:
            if entry.robot in self._names and (words := trouble_of(entry)):
                self._said[self._names[entry.robot]] = words


def when_behind(slow: Orders, begin: float) -> list[float]:
    """When a server probably knows of changes of a slow agent that it lacks, s."""
    (first,) = first_stops(slow, begin)
    return [at + BEHIND_AFTER for at in np.arange(first, begin + slow.seconds, INTERVAL)]


def trouble_of(entry: RobotEntry) -> str:
    """That a robot is behind, silent or over its quota, as `mapweave status` shows it; empty if it is not."""
    behind = f"{entry.missing} changes missing for {entry.lag:.1f} s" if entry.missing else ""
    silent = f"silent for {entry.age:.1f} s" if entry.age > SILENT else ""
    return ", ".join(filter(None, (behind, silent if entry.alive else "gone", entry.over_quota)))


def milliseconds(times: np.ndarray, percent: float) -> float | None:
    """A percentile; what never came counts as long as was waited for it. None of nothing: JSON has no NaN."""
    if not len(times):
        return None
    value = np.percentile(np.where(np.isfinite(times), times, PATIENCE), percent)
    return round(1e3 * float(value), 1)


def good(rows: Mapping[str, Figures], said: Mapping[str, Mapping[str, str]]) -> bool:
    """Whether the largest fleet is in time, all is acknowledged, and all that disturb are named.

    Args:
        rows: figures by number of agents.
        said: by number of agents, of each kind that disturbs.
    """
    largest = rows[max(rows, key=int)]
    times = [(largest[key], most) for key, most in ASKED.items()]
    left = any(row["unacked"] or row.get("disturbers_unacked") for row in rows.values())
    named = all(words for kinds in said.values() for words in kinds.values())
    return all(took is not None and took <= most for took, most in times) and named and not left


def memory_folder() -> str | None:
    """A folder in memory, if there is one."""
    return "/dev/shm" if Path("/dev/shm").is_dir() else None


def measure_floor(folder: Path, questions: int = 300) -> Figures:
    """A bare question, answered after a bare commit."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with ExitStack() as stack:
        children = stack.enter_context(Children(folder / "floor"))
        children.start("router", ["router", "--listen", endpoint])
        process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.fleet.floor_process", endpoint, str(folder)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=parent_watchdog.environment(),
        )  # fmt: skip
        stack.callback(process.communicate)
        stack.callback(process.kill)
        assert process.stdout is not None
        process.stdout.readline()
        bus = ZenohBus(BusSettings(endpoints=(endpoint,)))
        stack.callback(bus.close)
        if not bus.wait_connected(20.0):
            raise SystemExit("the router of the floor does not listen")
        times, pids = [], (os.getpid(), process.pid, children.pid("router"))
        before = total(pids)
        for _ in range(questions):
            asked = time.monotonic()
            if bus.ask(floor_process.KEY, bytes(3000), 5.0):
                times.append(time.monotonic() - asked)
        used = total(pids) - before
    took = np.array(times)
    return {
        "floor_p50_ms": milliseconds(took, 50), "floor_p99_ms": milliseconds(took, 99),
        "floor_cpu_ms": round(1e3 * used / questions, 2),
    }  # fmt: skip


def main() -> None:
    """Measure, print, and exit with 1 if that is not good."""
    parser = command_line("fleet", __doc__)
    parser.add_argument("--agents", type=at_least(1), nargs="+", default=[10, 50, 200, 1000], help="fleets")
    parser.add_argument("--seconds", type=float, default=20.0, help="of mapping")
    parser.add_argument(
        "--burst", type=at_least(0), default=1000, help="changes within a second, behind that"
    )
    parser.add_argument("--disturb", action="store_true", help="with a slow, a frozen and a flooding agent")
    options = parser.parse_args()
    if options.seconds < INTERVAL:
        parser.error(f"--seconds must be at least {INTERVAL:g}")
    rows: dict[str, Figures] = {}
    report: dict[str, Any] = {
        "seed": options.seed, "disturbed": options.disturb, "cores": os.cpu_count(),
        "load_before": round(os.getloadavg()[0], 1),
    }  # fmt: skip
    with (
        tempfile.TemporaryDirectory() as folder,
        Progress(console=Console(stderr=True)) as progress,
    ):
        floor = measure_floor(Path(folder))
        for agents in options.agents:
            rows[str(agents)], said = measure_fleet(agents, options, Path(folder) / str(agents), progress)
            if said:
                report["said"] = {**report.get("said", {}), str(agents): said}
    table = Table(
        title=f"a map server and its fleet; a bare question and commit: {shown(floor['floor_p50_ms'])} ms"
    )
    table.add_column("agents")
    for name in rows:
        table.add_column(name, justify="right")
    for key in next(iter(rows.values())):
        table.add_row(key, *(shown(row[key]) for row in rows.values()))
    Console(stderr=options.json).print(table)
    is_good = good(rows, report.get("said", {}))
    if options.json:
        print(json.dumps({**report, **floor, "asked": ASKED, "good": is_good, "agents": rows}))
    sys.exit(0 if is_good else 1)


def shown(figure: float | None) -> str:
    """A figure in the table."""
    return "" if figure is None else f"{figure:g}"


if __name__ == "__main__":
    main()

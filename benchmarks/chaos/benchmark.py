"""Whether anything is lost, whatever is killed, frozen, cut off or deleted.

    python -m benchmarks.chaos [--agents N] [--seconds S] [--seed N] [--store sqlite|postgresql|URL ...]
                               [--json]

Real processes over TCP on loopback: agents (journal, replicator, fleet client), two map servers, two routers,
and a link between each of them and each router that can be cut, slowed, frozen, half closed and made lossy.
The schedule is drawn with the seed and printed: at least 20 kill -9, a third as many SIGSTOP, two thirds as
many links, and a third as many times in which messages come twice, late and in another order. A lossy link
loses a fifth of TCP's segments and delays each by 50 ms: what comes through stalls for 0.2 s, 0.6 s, 1.4 s
and more, at 39 kB a second (`mapweave.scenarios.network_emulator`). Messages of an agent (changes, beacons,
statuses) or of a server (acknowledgements) are disordered at the agents' links (`benchmarks.chaos.disorder`);
`doubled` and `reordered` are changes, as a listener at the routers hears them meanwhile.
With SQLite a server is also killed and its store deleted; it gets everything from the agents again. With
PostgreSQL both servers share a database, which is killed as well. Without `--store` the fleet runs on both,
one after the other, where there is a PostgreSQL: counts are summed, times are those of the worse store, and
`stores` has each by itself.

Each agent writes its own log, flushed to the disk, of what it hands over and of what its journal has then
committed: that is `sent`. When all is over the stores are read and compared with it. `undone` changes are
those that a server with a deleted store did not get again, since a later change has undone them and the robot
has dropped them. `recovery_s` is from the end of each disturbance (the process is started again, the link
mended) until both servers have acknowledged all that had been committed by then, whatever happens meanwhile;
null if that never came. `unacknowledged` are robots of which something is not acknowledged in the end.
`relocalize_gap_s` is measured afterwards: a robot asks all the time where it is, and one of the servers, or
the robot's router, is killed, or a server stopped; it is the longest time without an answer that names the
place. `frozen_router_gap_s` is the same with the robot's router stopped, which it has to give up first.
"""

import json
import math
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from benchmarks.chaos.account import Account, account, sent_changes
from benchmarks.chaos.agent_process import FLEET
from benchmarks.chaos.disorder import RouterListener
from benchmarks.chaos.fleet_processes import DATABASE, ROUTERS, SERVERS, SQLITE, FleetProcesses
from benchmarks.chaos.questions import LostRobot
from benchmarks.chaos.recovery import RobotTimes, recoveries
from benchmarks.chaos.schedule import KILLS, LINKS, Disturbance, Kind, draw_schedule
from benchmarks.chaos.scripted_robot import ScriptedRobot
from benchmarks.command_line import at_least, command_line, figure_table
from mapweave.agent.replication.journal import Journal
from mapweave.mapserver.log.opening import open_store
from mapweave.scenarios.children import ChildFailed
from synthetic.postgres_server import PostgresServer, binaries

POSTGRESQL = "postgresql"
COUNTED = ("kills", "lost_stores", "stops", "cuts", "lossy", "disorders", "doubled", "reordered")
"""Disturbances in a report, and messages that they have doubled and reordered."""
START = 120.0
"""Longest wait until both servers answer, s."""
SETTLE = 120.0
"""Longest wait until all is acknowledged when nothing is disturbed any more, s."""
FLAP = 0.3
"""Of a link that is cut again and again, s."""
LEAST_SECONDS = 10.0
ATTACKS = (
    (Kind.KILL, SERVERS[0], 4.0), (Kind.KILL, SERVERS[1], 4.0), (Kind.KILL, ROUTERS[0], 4.0),
    (Kind.STOP, SERVERS[0], 4.0), (Kind.STOP, ROUTERS[1], 10.0),
)  # fmt: skip
"""On a fleet in which a robot asks where it is. It is at the second router since the first one was killed.
The last of each is how long it lasts, s: a connection has a lease of 5 s, and a frozen endpoint is tried
for 2 s."""

Done = list[tuple[float, Kind, str]]


def wait_until(condition: Callable[[], bool], patience: float, what: str) -> None:
    """Wait for a condition; raises ChildFailed with `what` when the time is over."""
    if not comes_true(condition, patience):
        raise ChildFailed(what)


def comes_true(condition: Callable[[], bool], patience: float) -> bool:
    """Wait for a condition; False when the time is over."""
    end = time.monotonic() + patience
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.3)
    return True


def disturb(
    fleet: FleetProcesses, schedule: Sequence[Disturbance], seconds: float, progress: Progress
) -> Done:
    """Carry out a schedule; returns when each disturbance ended."""
    bar = progress.add_task("mapping", total=seconds)
    began = time.monotonic()
    waiting, going = list(schedule), list[tuple[float, Disturbance]]()
    done: Done = []
    while waiting or going or time.monotonic() < began + seconds:
        now = time.monotonic() - began
        for begun, one in [(begun, one) for begun, one in going if begun + one.lasts <= now]:
            going.remove((begun, one))
            fleet.end_disturbance(one.kind, one.target)
            done.append((time.monotonic(), one.kind, one.target))
        for one in [one for one in waiting if one.at <= now]:
            # A database that takes long to start makes all that is behind it late.
            if any(one.target == other.target for _, other in going):
                continue
            waiting.remove(one)
            fleet.begin(one.kind, one.target)
            going.append((now, one))
            progress.update(bar, description=f"{len(done) + len(going)}: {one.target} {one.kind}")
        for begun, one in going:
            if one.kind is Kind.FLAP:
                fleet.toggle(one.target, int((now - begun) / FLAP) % 2 == 0)
        fleet.check()
        progress.update(bar, completed=min(now, seconds))
        time.sleep(0.02)
    progress.update(bar, description="mapped", completed=seconds)
    return done


def relocalize_gaps(fleet: FleetProcesses, seed: int, progress: Progress) -> list[float]:
    """The longest times without an answer while each of `ATTACKS` lasts, s."""
    bar = progress.add_task("a lost robot asks", total=len(ATTACKS))
    views = [ScriptedRobot(k, seed).view for k in range(len(fleet.agents))]
    gaps: list[float] = []
    with LostRobot(fleet.endpoints, views) as robot:

        def recognised() -> bool:
            fleet.check()
            return robot.recognised(SERVERS)

        for kind, victim, lasts in ATTACKS:
            if not comes_true(recognised, START):
                said = "; ".join(robot.missing)
                raise ChildFailed(f"not both servers recognise a place after {START:g} s: {said}")
            if not gaps:
                robot.start()
            progress.update(bar, description=f"a lost robot asks: {victim} {kind}")
            began = time.monotonic()
            fleet.begin(kind, victim)
            time.sleep(lasts)
            gaps.append(robot.longest_gap(began, time.monotonic()))
            fleet.end_disturbance(kind, victim)
            progress.console.print(f"{victim} {kind}: {gaps[-1]:.2f} s without an answer", highlight=False)
            progress.advance(bar)
    progress.update(bar, description="a lost robot asked")
    return gaps


def run(
    folder: Path, agents: int, seconds: float, seed: int, store: str, progress: Progress
) -> dict[str, Any]:
    """Start a fleet, disturb it, let it come to rest and count."""
    names = [f"r{k}" for k in range(agents)]
    postgres = start_postgres(folder) if store == POSTGRESQL else None
    address = store if postgres is None else postgres.database()
    groups = (names, SERVERS, ROUTERS, *(() if postgres is None else [(DATABASE,)]))
    schedule = draw_schedule(seconds, groups, seed, store == SQLITE)
    for one in schedule:
        progress.console.print(str(one), highlight=False)
    with ExitStack() as stack:
        if postgres is not None:
            stack.callback(postgres.stop)
        fleet = stack.enter_context(FleetProcesses(folder, agents, seed, address, postgres))
        for name in (*ROUTERS, *SERVERS, *fleet.agents):
            fleet.start(name)
        step = progress.add_task("the fleet starts", total=None)
        wait_until(lambda: acknowledged(folder, names), START, "not all robots are acknowledged at the start")
        progress.update(step, description="the fleet runs", total=1, completed=1)
        with RouterListener(fleet.endpoints, FLEET) as heard:
            done = disturb(fleet, schedule, seconds, progress)
        *gaps, frozen = relocalize_gaps(fleet, seed, progress)
        fleet.stop_mapping()
        (folder / "disturbances.json").write_text(json.dumps(done))
        step = progress.add_task("all is acknowledged", total=None)
        comes_true(fleet.done, SETTLE)
        fleet.check()
        left = fleet.mapping()
        for name in left:
            progress.console.print(f"not all of {name} is acknowledged after {SETTLE:g} s", highlight=False)
            fleet.end(name)
        progress.update(step, total=1, completed=1)
        for name in SERVERS:
            fleet.end(name)
        total = Account()
        places = list(dict.fromkeys(map(fleet.store_of, SERVERS)))
        stores = [open_store(place) for place in places]
        for k, name in enumerate(names):
            journal = Journal(folder / f"{name}.sqlite")
            total += account(sent_changes(folder, k, seed), journal, stores)
            journal.close()
        for one_store in stores:
            one_store.close()
    took = recoveries([RobotTimes(folder, name) for name in names], SERVERS, done)
    kinds = [one.kind for one in schedule]
    return {
        "seed": seed, "agents": agents, "seconds": seconds, "store": store.partition(":")[0],
        **asdict(total), "unacknowledged": len(left),
        "recovery_s_p50": percentile(took, 50), "recovery_s_p95": percentile(took, 95),
        "relocalize_gap_s": round(max(gaps), 2), "frozen_router_gap_s": round(frozen, 2),
        "kills": sum(kind in KILLS for kind in kinds), "lost_stores": kinds.count(Kind.LOSE_STORE),
        "stops": kinds.count(Kind.STOP), "lossy": kinds.count(Kind.LOSSY),
        "cuts": sum(kind in LINKS for kind in kinds) - kinds.count(Kind.LOSSY),
        "disorders": kinds.count(Kind.DISORDER), "doubled": heard.doubled, "reordered": heard.reordered,
    }  # fmt: skip


def percentile(took: Sequence[float], percent: float) -> float | None:
    """A percentile of times; None if one that never ends counts in it: JSON has no infinity."""
    with np.errstate(invalid="ignore"):
        value = float(np.percentile(took, percent))
    return round(value, 2) if math.isfinite(value) else None


def together(reports: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The reports of several stores as one."""
    if len(reports) == 1:
        return reports[0]
    out = dict(reports[0], store=" and ".join(report["store"] for report in reports))
    for key in ("sent", "stored", "undone", "lost", "duplicated", "out_of_order", "unacknowledged", *COUNTED):
        out[key] = sum(report[key] for report in reports)
    for key in ("recovery_s_p50", "recovery_s_p95", "relocalize_gap_s", "frozen_router_gap_s"):
        times = [report[key] for report in reports]
        out[key] = None if None in times else max(times)
    out["maps_equal"] = all(report["maps_equal"] for report in reports)
    return out | {"stores": list(reports)}


def start_postgres(folder: Path) -> PostgresServer:
    """A cluster in a folder that its own user may read, and whose commits are on the disk when they return.

    Raises:
        ChildFailed: there is no PostgreSQL.
    """
    if binaries() is None:
        raise ChildFailed("there is no PostgreSQL: neither Debian's package postgresql nor PyPI's pgserver")
    place = folder / DATABASE
    place.mkdir()
    for part in (folder.parent, folder, place):
        part.chmod(0o755)
    return PostgresServer(place, "-c", "fsync=on")


def acknowledged(folder: Path, names: Sequence[str]) -> bool:
    """Whether both servers have acknowledged something of every robot."""
    files = [folder / f"{name}.acks" for name in names]
    return all(
        file.exists() and all(f"{server} " in file.read_text() for server in SERVERS) for file in files
    )


def good(report: dict[str, Any]) -> bool:
    """Whether nothing is lost, and all is acknowledged."""
    return report["maps_equal"] is True and not any(
        report[key] for key in ("lost", "duplicated", "out_of_order", "unacknowledged")
    )


def main() -> None:
    """Run once, print, and exit with 1 if anything is lost or stays unacknowledged."""
    parser = command_line("chaos", __doc__)
    parser.add_argument("--agents", type=at_least(1), default=5)
    parser.add_argument("--seconds", type=float, default=60.0, help="of mapping and disturbances")
    parser.add_argument(
        "--store", nargs="+", default=[SQLITE] if binaries() is None else [SQLITE, POSTGRESQL],
        help="sqlite: a file a server; postgresql: one database for both, which is started here and killed; "
        "or the URL of one (default: sqlite, and postgresql where it is installed)",
    )  # fmt: skip
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="keep journals, stores and logs here")
    options = parser.parse_args()
    if options.seconds < LEAST_SECONDS:
        parser.error(f"--seconds must be at least {LEAST_SECONDS:g}")
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with (
        tempfile.TemporaryDirectory() as place,
        Progress(*columns, console=Console(stderr=True)) as progress,
    ):
        folder, reports = Path(place), []
        try:
            for number, store in enumerate(options.store):
                own = folder / f"store-{number}"
                own.mkdir()
                reports.append(run(own, options.agents, options.seconds, options.seed, store, progress))
        except ChildFailed as failed:
            progress.stop()
            sys.exit(f"seed {options.seed}: {failed}")
        finally:
            if options.keep is not None:
                without = shutil.ignore_patterns(DATABASE)
                shutil.copytree(folder, options.keep, ignore=without, dirs_exist_ok=True)
    report = together(reports)
    shown = {key: value for key, value in report.items() if key != "stores"}
    Console(stderr=options.json).print(figure_table({"value": shown}, "chaos"))
    if options.json:
        print(json.dumps(report))
    sys.exit(0 if good(report) else 1)


if __name__ == "__main__":
    main()

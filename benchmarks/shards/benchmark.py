"""A server with its place index in shards of a Ray cluster, against one without: the same, and how fast?

    python -m benchmarks.shards [--shards N ...] [--robots N] [--nodes N] [--seconds S] [--seed N]
                                [--store sqlite|postgresql] [--json]

Real `mapweave server` processes over Zenoh on loopback, and a Ray cluster of several nodes, all on the
cores of this machine. Each server reads the logs of a fleet that has mapped one building, merges them, and
answers robots that ask without a pause. `start_s`, until all is merged and in its shards;
`merged_nodes_per_s` of two more robots that send all at once; `answers_per_s`; `same_links`: it has exactly
the links of the server without Ray; `max_pose_difference_m`, of any node's merged pose.

With the most shards, processes are killed (`--kills`) while robots ask and two robots map on: a shard, a
worker, the gateway, the server (started again), the head (another is started once answers are whole).
`recovery_s` is the longest time without a whole answer after a kill, `recovery_s_p95` that of all kills;
`acknowledged_s`, how long after a kill what robots sent first behind it is acknowledged; `lost`, nodes that
are not in the map of each server at the end, robots of which not all is acknowledged, and questions without
an answer; `wrong`, answers "found" further than 0.5 m from the truth, with or without kills. Once something
stays unacknowledged behind a kill, no more is killed. It ends with 1 if anything is lost, wrong, or linked
otherwise than without Ray, or a node is missing.

With `--store postgresql`, which is the default where a PostgreSQL is installed that can have standbys, two
front servers, each with its gateway and shards, share it: a primary with a synchronous standby, both started
here. Robots reach the servers by a router. `server` is then the first of them. The second one (`front`) is
killed as well, and the primary: the standby is promoted at once, so in a real set-up the time in which a
primary is taken for dead is added. The server without Ray is alone, with SQLite. `store` says which it was,
and `not_killed` what was not killed, and why.
"""

import argparse
import json
import math
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress

from benchmarks.command_line import at_least, command_line, figure_table
from benchmarks.shards.askers import PATIENCE, Askers
from benchmarks.shards.fleet import BuildingFleet, MappingRobot
from benchmarks.shards.ray_nodes import RayNodes
from benchmarks.shards.servers import MapServers
from benchmarks.shards.shared_store import SharedStore, can_be_shared
from mapweave.hybridmap.change import EdgePut
from mapweave.hybridmap.node import EdgeKind
from mapweave.scenarios.children import ChildFailed
from mapweave.storage.map_file import MapFile

KILLS = ("worker", "shard", "gateway", "server", "head")
SHARED_KILLS = ("front", "primary")
"""With PostgreSQL also these."""
SQLITE, POSTGRESQL = "sqlite", "postgresql"
ASKED, NO_SECOND = "not in --kills", f"a store in a file has one server and no primary (--store {POSTGRESQL})"
"""Why something is not killed."""
LATE = 2
"""Robots that join later."""
AFTER = 4.0
"""s after a kill before the next one, at least."""


def links_of(content: MapFile) -> set[tuple[str, str]]:
    """Pairs of nodes that are linked across maps, or by a loop."""
    edges = (body.edge for body in content.changes if isinstance(body, EdgePut))
    return {(str(edge.a), str(edge.b)) for edge in edges if edge.kind is EdgeKind.MERGED}


def compared(content: MapFile, reference: MapFile) -> dict[str, Any]:
    """Whether two merged maps are the same."""
    off = [
        content.poses[node][1].mean.distance(pose.mean) if node in content.poses else float("inf")
        for node, (_, pose) in reference.poses.items()
    ]
    links = links_of(content), links_of(reference)
    return {
        "links": len(links[0]),
        "same_links": links[0] == links[1],
        "max_pose_difference_m": round(max(off, default=0.0), 6),
    }


def all_compared(contents: Sequence[MapFile], reference: MapFile) -> dict[str, Any]:
    """The same of the merged maps of several servers: what differs most."""
    rows = [compared(content, reference) for content in contents]
    return {
        "links": rows[0]["links"],
        "same_links": all(row["same_links"] for row in rows),
        "max_pose_difference_m": max(row["max_pose_difference_m"] for row in rows),
    }


def measure(
    fleet: BuildingFleet,
    folder: Path,
    shards: int,
    cluster: RayNodes | None,
    store: SharedStore | None,
    o: argparse.Namespace,
) -> tuple[dict[str, Any], list[MapFile]]:
    """One server, or two on a store that they share: their figures, and their maps."""
    early = o.robots - LATE
    servers = MapServers(folder, shards, cluster, store)
    fleet.write(servers.address, range(early))
    began = time.monotonic()
    with servers:
        servers.wait(early * o.nodes)
        start_s = time.monotonic() - began
        began = time.monotonic()
        robots = [MappingRobot(log, servers.endpoint, folder, servers.names) for log in fleet.logs[early:]]
        for robot in robots:
            while robot.map_on():
                pass
        servers.wait(len(fleet.nodes))
        merge_s = time.monotonic() - began
        for robot in robots:
            robot.close()
        contents = servers.maps(fleet.edges)
        askers = Askers(fleet, servers.endpoint, o.askers)
        time.sleep(o.seconds)
        tally = askers.close()
    took = 1e3 * np.array(tally.seconds)
    return {
        "start_s": round(start_s, 1),
        "merged_nodes_per_s": round(LATE * o.nodes / merge_s, 1),
        "answers_per_s": round(len(tally.answers) / o.seconds, 1),
        "p50_ms": round(float(np.percentile(took, 50)), 1),
        "p95_ms": round(float(np.percentile(took, 95)), 1),
        "found": tally.found,
        "partial": sum(not whole for _, whole in tally.answers),
        "wrong": tally.wrong,
        "lost": tally.unanswered,
    }, contents


def killed(
    fleet: BuildingFleet,
    folder: Path,
    shards: int,
    cluster: RayNodes,
    store: SharedStore | None,
    reference: MapFile,
    o: argparse.Namespace,
) -> dict[str, Any]:
    """Kill processes while robots ask and map on."""
    early = o.robots - LATE
    recovery: dict[str, float] = {}
    acknowledged: dict[str, float | None] = {}
    late: set[str] = set()
    servers = MapServers(folder, shards, cluster, store)
    fleet.write(servers.address, range(early))
    with servers:
        servers.wait(early * o.nodes)
        robots = [MappingRobot(log, servers.endpoint, folder, servers.names) for log in fleet.logs[early:]]
        askers = Askers(fleet, servers.endpoint, o.askers)
        # Behind each kill as much of their logs, and a part is on its way when it happens.
        share = max(len(fleet.logs[-1]) // (2 * len(o.kills)), 1)
        for kind in o.kills:
            wait_until(partial(askers.tally.whole, time.monotonic()), f"before {kind}: no whole answers")
            for robot in robots:
                robot.map_on(share)
            since = time.monotonic()
            kill(kind, servers, cluster, store)
            for robot in robots:
                robot.map_on(share)
            late = unacknowledged(robots)
            acknowledged[kind] = None if late else round(time.monotonic() - since, 2)
            if late:
                print(f"not all is acknowledged {PATIENCE:g} s after a kill: {kind}", file=sys.stderr)
                break
            time.sleep(max(since + AFTER - time.monotonic(), 0.0))
            wait_until(partial(askers.tally.whole, since + AFTER), f"after {kind}: no whole answers")
            if kind == "head":
                cluster.start_head()
            servers.wait(0)
            recovery[kind] = round(askers.tally.recovery(since), 2)
        for robot in robots:
            while robot.map_on():
                pass
        late |= unacknowledged(robots)
        if not late:
            servers.wait(len(fleet.nodes))
        contents = servers.maps(fleet.edges)
        tally = askers.close()
        for robot in robots:
            robot.close()
    missing = sum(node.id not in content.poses for content in contents for node in fleet.nodes)
    return {
        "recovery_s": recovery,
        "recovery_s_p95": round(float(np.percentile([*recovery.values()], 95)), 2) if recovery else None,
        "acknowledged_s": acknowledged,
        "lost": missing + len(late) + tally.unanswered,
        "wrong": tally.wrong,
        "found": tally.found,
        "partial": sum(not whole for _, whole in tally.answers),
        "asked_again": tally.asked_again,
        **all_compared(contents, reference),
    }


def unacknowledged(robots: Sequence[MappingRobot]) -> set[str]:
    """Robots of which not all is acknowledged, though it was waited for."""
    return {robot.agent for robot in robots if not robot.acknowledged(PATIENCE)}


def kill(kind: str, servers: MapServers, cluster: RayNodes, store: SharedStore | None) -> None:
    """Kill -9 one process of a kind, of PostgreSQL all."""
    if kind in ("server", "front"):
        servers.restart(servers.names[0 if kind == "server" else 1])
    elif kind == "primary":
        assert store is not None
        store.lose_primary()
    elif kind == "head":
        cluster.kill_head()
    elif kind == "gateway":
        os.kill(servers.gateway(), signal.SIGKILL)
    else:
        titles = {"shard": ("ray::ShardServer",), "worker": ("ray::answer_work", "ray::IDLE")}[kind]

        def found() -> list[int]:
            return [pid for title in titles for pid in cluster.processes(title)]

        # Ray starts a worker when there is work.
        wait_until(found, f"no {kind} to kill")
        os.kill(found()[0], signal.SIGKILL)


def wait_until(condition: Callable[[], object], what: str) -> None:
    """Wait for a condition; end the benchmark, and say what is missing, if it does not come true."""
    end = time.monotonic() + PATIENCE
    while not condition():
        if time.monotonic() > end:
            raise SystemExit(f"{what} for {PATIENCE:g} s")
        time.sleep(0.05)


def summary(rows: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """What all rows together say."""
    sharded = [row for name, row in rows.items() if name != "without"]
    return {
        "same_links": all(row["same_links"] for row in sharded),
        "max_pose_difference_m": max(row["max_pose_difference_m"] for row in sharded),
        "lost": sum(row["lost"] for row in rows.values()),
        "wrong": sum(row["wrong"] for row in rows.values()),
        "recovery_s_p95": rows.get("killed", {}).get("recovery_s_p95"),
    }


def good(report: dict[str, Any]) -> bool:
    """Whether nothing is lost or wrong, and the links are those without Ray."""
    # The difference is infinite where a node is missing.
    whole = report["same_links"] and math.isfinite(report["max_pose_difference_m"])
    return whole and not report["lost"] and not report["wrong"]


def not_killed(kills: Sequence[str], store: str) -> dict[str, str]:
    """Kinds of processes that are not killed, with the reason."""
    without = {kind: NO_SECOND for kind in SHARED_KILLS if store == SQLITE}
    return {kind: ASKED for kind in KILLS + SHARED_KILLS if kind not in kills} | without


def in_json(report: dict[str, Any]) -> str:
    """A report in JSON, which has no infinity: null instead."""
    return json.dumps(json.loads(json.dumps(report), parse_constant=lambda word: None))


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print, and exit with 1 if anything is lost, wrong or linked otherwise."""
    parser = command_line("shards", __doc__, whole=True)
    parser.add_argument("--shards", type=at_least(1), nargs="+", default=[1, 2, 4], metavar="N")
    parser.add_argument("--robots", type=at_least(LATE + 1), default=12, help="that have mapped the building")
    parser.add_argument("--nodes", type=at_least(1), default=24, help="of each")
    parser.add_argument("--askers", type=at_least(1), default=4, help="lost robots that ask at once")
    parser.add_argument("--seconds", type=float, default=5.0, help="of asking")
    parser.add_argument("--ray-nodes", type=at_least(1), default=3, help="of the cluster")
    parser.add_argument(
        "--store", choices=(SQLITE, POSTGRESQL), default=POSTGRESQL if can_be_shared() else SQLITE,
        help="default: postgresql where it is installed, with standbys; else sqlite",
    )  # fmt: skip
    parser.add_argument("--kills", nargs="*", choices=KILLS + SHARED_KILLS, help="default: all of the store")
    o = parser.parse_args(arguments)
    of_store = KILLS + (SHARED_KILLS if o.store == POSTGRESQL else ())
    if o.kills is None:
        o.kills = list(of_store)
    if not {*o.kills} <= {*of_store}:
        parser.error(f"--kills {' '.join(SHARED_KILLS)}: with --store {POSTGRESQL} alone")
    if not o.seconds > 0.0:
        parser.error("--seconds must be positive")
    fleet = BuildingFleet(o.robots, o.nodes, o.seed)
    rows: dict[str, dict[str, Any]] = {}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        progress = stack.enter_context(Progress(console=Console(stderr=True)))
        step = progress.add_task("one server without Ray", total=len(o.shards) + 2)
        store = None
        if o.store == POSTGRESQL:
            try:
                store = stack.enter_context(SharedStore(folder))
            except ChildFailed as failed:
                raise SystemExit(str(failed)) from None
        rows["without"], (reference,) = measure(fleet, folder / "without", 1, None, None, o)
        progress.update(step, advance=1, description="a cluster")
        cluster = stack.enter_context(RayNodes(o.ray_nodes, folder))
        os.environ.update(cluster.token)
        for shards in o.shards:
            progress.update(step, advance=1, description=f"{shards} shards")
            row, contents = measure(fleet, folder / str(shards), shards, cluster, store, o)
            rows[f"{shards} shards"] = row | all_compared(contents, reference)
        if o.kills:
            progress.update(step, description="processes are killed")
            rows["killed"] = killed(fleet, folder / "killed", max(o.shards), cluster, store, reference, o)
        progress.update(step, advance=1)
    Console(stderr=o.json).print(figure_table(rows))
    report = summary(rows)
    if o.json:
        print(in_json({
            "robots": o.robots, "nodes": len(fleet.nodes), "seed": o.seed, "cores": os.cpu_count(),
            "store": o.store, "not_killed": not_killed(o.kills, o.store), **report, "sizes": rows,
        }))  # fmt: skip
    sys.exit(0 if good(report) else 1)

"""A server with its place index in shards of a Ray cluster, against one without: the same, and how fast?

    python -m benchmarks.shards [--shards N ...] [--robots N] [--nodes N] [--seconds S] [--seed N] [--json]

Real `mapweave server` processes over Zenoh on loopback, and a Ray cluster of several nodes, all on the
cores of this machine. Each server reads the logs of a fleet that has mapped one building, merges them, and
answers robots that ask without a pause. `start_s`, until all is merged and in its shards;
`merged_nodes_per_s` of two more robots that send all at once; `answers_per_s`; `same_links`: it has exactly
the links of the server without Ray; `max_pose_difference_m`, of any node's merged pose.

With the most shards, processes are killed (`--kills`) while robots ask and two robots map on: a shard, a
worker, the gateway, the server (started again), the head (another is started once answers are whole).
`recovery_s` is the longest time without a whole answer after a kill, `recovery_s_p95` that of all kills;
`lost`, acknowledged nodes that are not in the map at the end, and questions without an answer; `wrong`,
answers "found" further than 0.5 m from the truth, with or without kills.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import tempfile
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from benchmarks.command_line import command_line
from benchmarks.shards.askers import ASK_WITHIN, PATIENCE, Askers
from benchmarks.shards.fleet import FLEET, BuildingFleet, MappingRobot
from benchmarks.shards.ray_nodes import RayNodes, descendants
from mapweave.hybridmap.change import EdgePut
from mapweave.scenarios.children import Children, free_port
from mapweave.storage.map_file import MapFile, unpack_map_file
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import decode_record
from mapweave.wire.zenoh_bus import ZenohBus

KILLS = ("worker", "shard", "gateway", "server", "head")
LATE = 2
"""Robots that join later."""
AFTER = 4.0
"""s after a kill before the next one, at least."""
PERIOD = 0.3
"""s between two changes of a robot that maps on."""


class Server:
    """A `mapweave server` process. A context manager."""

    def __init__(self, folder: Path, shards: int, cluster: RayNodes | None) -> None:
        """Choose its folder, which has its store.

        Args:
            folder: for all its files.
            shards: parts of the place index.
            cluster: None: without Ray.
        """
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self._folder, self._shards, self._cluster = folder, shards, cluster
        (folder / "server.toml").write_text(f"[cluster]\nshards = {shards}\n")
        self.children = Children(folder / "logs")

    def __enter__(self) -> Server:
        """Start it."""
        self.start()
        self.bus = ZenohBus(BusSettings(endpoints=(self.endpoint,)))
        return self

    def __exit__(self, *_: object) -> None:
        """End it."""
        self.bus.close()
        self.children.end("server")

    def start(self) -> None:
        """Start it, or start it again."""
        ray = [] if self._cluster is None else ["--ray", self._cluster.address]
        self.children.start("server", [
            "server", "--fleet", FLEET, "--listen", self.endpoint, "--data", str(self._folder),
            "--settings", str(self._folder / "server.toml"), *ray,
        ])  # fmt: skip

    def kill(self) -> None:
        """Kill -9."""
        self.children.kill("server")

    def gateway(self) -> int:
        """The process between it and Ray."""
        ours = descendants(self.children.pid("server"))
        return next(pid for pid in ours if b"gateway_process" in Path(f"/proc/{pid}/cmdline").read_bytes())

    def wait(self, nodes: int) -> None:
        """Wait until so many nodes are merged, and shards, if there are any, answer themselves."""
        end = time.monotonic() + PATIENCE
        wanted = f"{self._shards} of {self._shards} shards" if self._cluster else ""
        status: dict[str, Any] = {}
        while time.monotonic() < end:
            self.children.check()
            for reply in self.bus.ask(Keys(FLEET).server_status("s0"), b"", ASK_WITHIN):
                if not reply.error:
                    status = decode_record(reply.payload)
            if status.get("settled") and int(status["nodes"]) >= nodes and status["cluster"] == wanted:
                return
            time.sleep(0.1)
        raise SystemExit(f"the server is not ready in {PATIENCE:g} s: {status}")

    def map(self) -> MapFile:
        """The merged map."""
        return unpack_map_file(self.bus.ask(Keys(FLEET).server_map("s0"), b"", PATIENCE)[0].payload)


def links_of(content: MapFile) -> set[tuple[str, str]]:
    """Pairs of nodes that are linked across maps, or by a loop."""
    edges = [body.edge for body in content.changes if isinstance(body, EdgePut)]
    return {
        (str(edge.a), str(edge.b)) for edge in edges if edge.kind.name == "LINK" or edge.a.map != edge.b.map
    }


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


def measure(
    fleet: BuildingFleet, folder: Path, shards: int, cluster: RayNodes | None, o: argparse.Namespace
) -> tuple[dict[str, Any], MapFile]:
    """One server: its figures, and its map."""
    early = o.robots - LATE
    fleet.write(folder / "s0.sqlite", range(early))
    began = time.monotonic()
    with Server(folder, shards, cluster) as server:
        server.wait(early * o.nodes)
        start_s = time.monotonic() - began
        began = time.monotonic()
        robots = [MappingRobot(log, server.endpoint, folder) for log in fleet.logs[early:]]
        for robot in robots:
            while robot.map_on():
                pass
        server.wait(len(fleet.nodes))
        merge_s = time.monotonic() - began
        for robot in robots:
            robot.close()
        content = server.map()
        askers = Askers(fleet, server.endpoint, o.askers)
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
    }, content


def killed(
    fleet: BuildingFleet,
    folder: Path,
    shards: int,
    cluster: RayNodes,
    reference: MapFile,
    o: argparse.Namespace,
) -> dict[str, Any]:
    """Kill processes while robots ask and map on."""
    early = o.robots - LATE
    fleet.write(folder / "s0.sqlite", range(early))
    recovery: dict[str, float] = {}
    with Server(folder, shards, cluster) as server:
        server.wait(early * o.nodes)
        robots = [MappingRobot(log, server.endpoint, folder) for log in fleet.logs[early:]]
        stop = threading.Event()

        def map_on() -> None:
            left = robots
            while left := [robot for robot in left if robot.map_on()]:
                stop.wait(PERIOD)

        mapping = threading.Thread(target=map_on)
        mapping.start()
        askers = Askers(fleet, server.endpoint, o.askers)
        for kind in o.kills:
            wait_until(partial(askers.tally.whole, time.monotonic()))
            since = time.monotonic()
            kill(kind, server, cluster)
            time.sleep(AFTER)
            wait_until(partial(askers.tally.whole, since + AFTER))
            if kind == "head":
                cluster.start_head()
            server.wait(0)
            recovery[kind] = round(askers.tally.recovery(since), 2)
        stop.set()
        mapping.join()
        unacknowledged = sum(not robot.acknowledged(PATIENCE) for robot in robots)
        server.wait(len(fleet.nodes))
        content = server.map()
        tally = askers.close()
        for robot in robots:
            robot.close()
    missing = sum(node.id not in content.poses for node in fleet.nodes)
    return {
        "recovery_s": recovery,
        "recovery_s_p95": round(float(np.percentile([*recovery.values()], 95)), 2),
        "lost": missing + unacknowledged + tally.unanswered,
        "wrong": tally.wrong,
        "found": tally.found,
        "partial": sum(not whole for _, whole in tally.answers),
        "asked_again": tally.asked_again,
        **compared(content, reference),
    }


def kill(kind: str, server: Server, cluster: RayNodes) -> None:
    """Kill -9 one process of a kind."""
    if kind == "server":
        server.kill()
        server.start()
    elif kind == "head":
        cluster.kill_head()
    elif kind == "gateway":
        os.kill(server.gateway(), signal.SIGKILL)
    else:
        titles = {"shard": ("ray::ShardServer",), "worker": ("ray::answer_work", "ray::IDLE")}[kind]

        def found() -> list[int]:
            return [pid for title in titles for pid in cluster.processes(title)]

        # Ray starts a worker when there is work.
        wait_until(found)
        os.kill(found()[0], signal.SIGKILL)


def wait_until(condition: Callable[[], object]) -> None:
    """Wait for a condition; end the benchmark if it does not come true."""
    end = time.monotonic() + PATIENCE
    while not condition():
        if time.monotonic() > end:
            raise SystemExit(f"no whole answers, or no process to kill, for {PATIENCE:g} s")
        time.sleep(0.05)


def table(rows: dict[str, dict[str, Any]]) -> Table:
    """For people."""
    out = Table("figure", *rows)
    for name in dict.fromkeys(name for row in rows.values() for name in row):
        out.add_row(name, *(str(row.get(name, "")) for row in rows.values()))
    return out


def main() -> None:
    """Measure and print."""
    parser = command_line("shards", __doc__, whole=True)
    parser.add_argument("--shards", type=int, nargs="+", default=[1, 2, 4], metavar="N")
    parser.add_argument("--robots", type=int, default=12, help="that have mapped the building")
    parser.add_argument("--nodes", type=int, default=24, help="of each")
    parser.add_argument("--askers", type=int, default=4, help="lost robots that ask at once")
    parser.add_argument("--seconds", type=float, default=5.0, help="of asking")
    parser.add_argument("--ray-nodes", type=int, default=3, help="of the cluster")
    parser.add_argument("--kills", nargs="*", choices=KILLS, default=list(KILLS))
    o = parser.parse_args()
    if min(*o.shards, o.robots - LATE, o.nodes, o.askers, o.ray_nodes) < 1 or o.seconds <= 0.0:
        parser.error(f"numbers must be positive, and there must be more than {LATE} robots")
    fleet = BuildingFleet(o.robots, o.nodes, o.seed)
    rows: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as name, Progress(console=Console(stderr=True)) as progress:
        folder = Path(name)
        step = progress.add_task("one server without Ray", total=len(o.shards) + 2)
        rows["without"], reference = measure(fleet, folder / "without", 1, None, o)
        progress.update(step, advance=1, description="a cluster")
        with RayNodes(o.ray_nodes, folder) as cluster:
            os.environ.update(cluster.token)
            for shards in o.shards:
                progress.update(step, advance=1, description=f"{shards} shards")
                row, content = measure(fleet, folder / str(shards), shards, cluster, o)
                rows[f"{shards} shards"] = row | compared(content, reference)
            if o.kills:
                progress.update(step, description="processes are killed")
                rows["killed"] = killed(fleet, folder / "killed", max(o.shards), cluster, reference, o)
            progress.update(step, advance=1)
    Console(stderr=o.json).print(table(rows))
    if o.json:
        sharded = [row for name, row in rows.items() if name != "without"]
        print(json.dumps({
            "robots": o.robots, "nodes": len(fleet.nodes), "seed": o.seed, "cores": os.cpu_count(),
            "same_links": all(row["same_links"] for row in sharded),
            "max_pose_difference_m": max(row["max_pose_difference_m"] for row in sharded),
            "lost": sum(row["lost"] for row in rows.values()),
            "wrong": sum(row["wrong"] for row in rows.values()),
            "recovery_s_p95": rows.get("killed", {}).get("recovery_s_p95"),
            "sizes": rows,
        }))  # fmt: skip

"""Many lost robots at once: how soon a map server answers, and which questions it refuses.

    python -m benchmarks.relocalize_load [--robots N] [--seconds S] [--nodes N] [--seed N] [--json]

A real `mapweave server` process, over Zenoh on loopback, holds a map of synthetic rooms (descriptors with the
spread of real ones). Each robot has a session of its own and asks without a pause where it is, always about
another view; a refused robot asks again at its retry time. Meanwhile one more asks for a route,
ten times a second. Robots and server share this machine's cores.

For each server: `p50_ms` and `p95_ms` from asking to a found, ambiguous or unknown answer; `refused_share` of
the questions; `answers_per_s`; `wait_p95_ms` from a robot's first asking about a view to its answer, pauses
included; `route_p95_ms`; `right_share` of the answers (within 0.25 m and 5 degrees); `lost`, questions that
without answers and refusals. Side by side: the default admission control, and a server that answers all
in turn (one worker, no refusals).
"""

from __future__ import annotations

import argparse
import json
import math
import os
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from benchmarks.command_line import command_line
from mapweave.hybridmap.change import ChangeBody
from mapweave.hybridmap.node import MapId, NodeId
from mapweave.hybridmap.pose import Pose2, wrap_angle
from mapweave.hybridmap.query import RelocalizeAnswer, RouteRequest, View
from mapweave.scenarios.children import Children, free_port
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import decode_record
from mapweave.wire.messages import decode, encode, encode_view
from mapweave.wire.zenoh_bus import ZenohBus
from synthetic.maps import changes_of, write_store
from synthetic.world import World, room, take_map, take_view

FLEET = "load"
ROOM_NODES = 20
"""Nodes a room, one robot each."""
PATIENCE = 10.0
"""Longest wait for an answer, s."""
RIVALS = {"admission_control": "", "in_turn": "[admission_control]\nworkers = 1\nin_time = 1000.0\n"}
"""Settings of the servers."""


@dataclass(frozen=True, eq=False)
class Building:
    """Rooms, each mapped by a robot.

    Attributes:
        rooms: the world around each node's robot.
        truth: where nodes were made.
    """

    rooms: dict[MapId, World]
    truth: dict[NodeId, Pose2]

    @classmethod
    def make(cls, nodes: int, store: Path, rng: np.random.Generator) -> Building:
        """Map so many nodes and write them to a store."""
        building, logs = cls({}, {}), dict[MapId, list[ChangeBody]]()
        for number in range(math.ceil(nodes / ROOM_NODES)):
            x, map_id = 20.0 * number, MapId(f"r{number}", 1)
            world = room(x, 0, 5, 4, 700, rng)
            stops = [
                Pose2(x + rng.uniform(1.2, 3.8), rng.uniform(1.2, 2.8), rng.uniform(-math.pi, math.pi))
                for _ in range(ROOM_NODES)
            ]
            made, edges = take_map(world, map_id, stops, rng)
            building.rooms[map_id] = world
            building.truth.update(zip((node.id for node in made), stops, strict=True))
            logs[map_id] = changes_of(made, edges)
        write_store(store, logs)
        return building

    def query(self, rng: np.random.Generator) -> tuple[View, MapId, Pose2]:
        """A view a little beside a node, whose map that node is in, and where it was taken."""
        ids = sorted(self.truth)
        node = ids[rng.integers(len(ids))]
        offset = Pose2.from_vector(rng.normal(0, [0.12, 0.12, 0.1]))
        pose = self.truth[node] @ offset
        return take_view(self.rooms[node.map], pose, rng)[0], node.map, pose


@dataclass
class Tally:
    """What one robot, or all of them, went through; times in s."""

    answered: list[float] = field(default_factory=list)
    waited: list[float] = field(default_factory=list)
    refused: int = 0
    right: int = 0
    lost: int = 0

    def add(self, other: Tally) -> None:
        """Put another one's to it."""
        self.answered += other.answered
        self.waited += other.waited
        self.refused += other.refused
        self.right += other.right
        self.lost += other.lost


def ask_on(bus: ZenohBus, building: Building, queries: list[tuple[View, MapId, Pose2]], end: float) -> Tally:
    """One robot: asks until the time is over, and finishes the last question."""
    tally, key = Tally(), Keys(FLEET).any_relocalize()
    messages = [encode_view(view) for view, _, _ in queries]
    number = 0
    while (began := time.monotonic()) < end:
        number = (number + 1) % len(queries)
        while True:
            asked = time.monotonic()
            replies = bus.ask(key, messages[number], PATIENCE)
            now = time.monotonic()
            if not replies or (replies[0].error and not replies[0].retry_after):
                tally.lost += 1
                break
            if not replies[0].error:
                tally.answered.append(now - asked)
                tally.waited.append(now - began)
                tally.right += is_right(building, queries[number], replies[0].payload)
                break
            tally.refused += 1
            time.sleep(replies[0].retry_after)
    return tally


def is_right(building: Building, query: tuple[View, MapId, Pose2], payload: bytes) -> bool:
    """Whether the best candidate is within 0.25 m and 5 degrees."""
    candidates = decode(payload, RelocalizeAnswer).candidates
    if not candidates:
        return False
    _, _, true = query
    answered = building.truth[candidates[0].node] @ candidates[0].node_from_robot.mean
    return answered.distance(true) < 0.25 and abs(wrap_angle(answered.heading - true.heading)) < math.radians(
        5
    )


def ask_routes(bus: ZenohBus, building: Building, stop: threading.Event) -> list[float]:
    """Ten routes a second; how long each took, s."""
    ids = sorted(building.truth)
    payload = encode(RouteRequest(ids[0], ids[min(ROOM_NODES, len(ids)) - 1]))
    times = []
    while not stop.wait(0.1):
        asked = time.monotonic()
        if bus.ask(Keys(FLEET).any_route(), payload, PATIENCE):
            times.append(time.monotonic() - asked)
    return times


def measure(rival: str, options: argparse.Namespace, folder: Path, progress: Progress) -> dict[str, float]:
    """Start a server, let all robots ask, and say how it was."""
    rng = np.random.default_rng(options.seed)
    folder.mkdir(parents=True)
    building = Building.make(options.nodes, folder / "s0.sqlite", rng)
    (folder / "server.toml").write_text(rival)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    step = progress.add_task(f"{folder.name}: the server reads its store", total=options.seconds)
    queries = [[building.query(rng) for _ in range(10)] for _ in range(options.robots)]
    sessions: list[ZenohBus] = []
    with Children(folder / "logs") as children:
        children.start("server", [
            "server", "--fleet", FLEET, "--listen", endpoint, "--data", str(folder),
            "--settings", str(folder / "server.toml"),
        ])  # fmt: skip
        try:
            settings = BusSettings(endpoints=(endpoint,))
            sessions.extend(ZenohBus(settings) for _ in range(options.robots + 1))
            wait_until_merged(sessions[-1], options.nodes, children)
            if not all(bus.wait_connected(20.0) for bus in sessions):
                raise SystemExit("not all robots found the server")
            progress.update(step, description=f"{folder.name}: all ask")
            stop = threading.Event()
            with ThreadPoolExecutor(options.robots + 1) as pool:
                routes = pool.submit(ask_routes, sessions[-1], building, stop)
                begin = time.monotonic()
                end = begin + options.seconds
                robots = [
                    pool.submit(ask_on, bus, building, mine, end)
                    for bus, mine in zip(sessions[:-1], queries, strict=True)
                ]
                while time.monotonic() < end:
                    time.sleep(0.1)
                    progress.update(step, completed=time.monotonic() - begin)
                total = Tally()
                for robot in robots:
                    total.add(robot.result())
                took = time.monotonic() - begin
                stop.set()
                children.check()
                return figures(total, routes.result(), took)
        finally:
            for bus in sessions:
                bus.close()


def wait_until_merged(bus: ZenohBus, nodes: int, children: Children) -> None:
    """The server reads its store first."""
    end = time.monotonic() + 60.0 + nodes
    while time.monotonic() < end:
        children.check()
        for reply in bus.ask(Keys(FLEET).server_status("s0"), b"", 5.0):
            status = decode_record(reply.payload)
            if status["settled"] and int(status["nodes"]) >= nodes:
                return
        time.sleep(0.2)
    raise SystemExit("the server has not read its store in time")


def figures(total: Tally, routes: list[float], took: float) -> dict[str, float]:
    """The numbers that are printed."""
    asked = len(total.answered) + total.refused + total.lost
    answered = 1e3 * np.array(total.answered or [math.nan])
    return {
        "answered": len(total.answered),
        "answers_per_s": round(len(total.answered) / took, 1),
        "p50_ms": round(float(np.percentile(answered, 50)), 1),
        "p95_ms": round(float(np.percentile(answered, 95)), 1),
        "max_ms": round(float(answered.max()), 1),
        "refused_share": round(total.refused / max(asked, 1), 3),
        "wait_p95_ms": round(1e3 * float(np.percentile(total.waited or [math.nan], 95)), 1),
        "route_p95_ms": round(1e3 * float(np.percentile(routes or [math.nan], 95)), 1),
        "right_share": round(total.right / max(len(total.answered), 1), 3),
        "lost": total.lost,
    }


def main() -> None:
    """Measure and print."""
    parser = command_line("relocalize_load", __doc__)
    parser.add_argument("--robots", type=int, default=50, help="that ask at once")
    parser.add_argument("--seconds", type=float, default=10.0, help="of asking")
    parser.add_argument("--nodes", type=int, default=400, help="in the map")
    options = parser.parse_args()
    if options.robots < 1 or options.seconds <= 0.0 or options.nodes < 1:
        parser.error("--robots, --seconds and --nodes must be positive")
    options.nodes = ROOM_NODES * math.ceil(options.nodes / ROOM_NODES)
    console = Console(stderr=True)
    report: dict[str, object] = {
        "robots": options.robots, "nodes": options.nodes, "seed": options.seed,
        "cores": os.cpu_count(), "load_before": round(os.getloadavg()[0], 1),
    }  # fmt: skip
    rows: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as folder, Progress(console=console) as progress:
        for name, settings in RIVALS.items():
            rows[name] = measure(settings, options, Path(folder) / name, progress)
    table = Table(title=f"{options.robots} robots ask at once, {options.nodes} nodes")
    table.add_column("")
    for name in rows:
        table.add_column(name, justify="right")
    for key in rows["admission_control"]:
        table.add_row(key, *(f"{row[key]:g}" for row in rows.values()))
    Console(stderr=options.json).print(table)
    if options.json:
        print(json.dumps({**report, **rows["admission_control"], "in_turn": rows["in_turn"]}))

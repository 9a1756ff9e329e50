"""A robot maps the same rooms for a year, with no server: how far do its own map and its journal grow?

    python -m benchmarks.own_map [--drives N] [--seed N] [--stops N] [--queries N] [--keep] [--json]

The rooms, stops and days between drives are those of `benchmarks.life`. On every drive the robot recognises a
place of its map and goes on with it, by the agent's own parts; then it retires what newer nodes have
superseded for long (`--keep`: nothing). Changes go to a journal, which is compacted after each drive. Printed
are, after each drive, the map's nodes and edges, the journal, the memory, and the longest that the loop
waits: for a new node to be tied to others, and for the examination of a node that may go. The last line also
has how many of the views that are taken anywhere in the rooms are recognised on the map in the end.
Memory is that of the process, less what it was after the first drive.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks.command_line import command_line
from benchmarks.life.benchmark import APART
from benchmarks.life.house import House
from benchmarks.process_usage import held_bytes
from mapweave.agent.localization.place_recognition import recognise_places
from mapweave.agent.mapping.node_retirement import NodeRetirement
from mapweave.agent.replication.journal import Journal
from mapweave.hybridmap.ids import MapId
from mapweave.mapserver.merging.pruning import DAY_NS
from synthetic.own_map import OwnMap

SERVER = "s0"
SOME = 5
"""Drives over which the last ones and those in the middle are averaged."""


@dataclass(frozen=True)
class Drive:
    """What the robot has after a drive.

    Attributes:
        nodes: of its map.
        edges: of its map.
        retired: nodes, after this drive.
        journal: bytes.
        memory: of the process, more than after the first drive, bytes.
        node_ms: the longest that a new node took.
        retire_ms: the longest that a tick took in which a node was examined.
    """

    nodes: int
    edges: int
    retired: int
    journal: int
    memory: int
    node_ms: float
    retire_ms: float


COLUMNS = tuple(field.name for field in fields(Drive))


def main() -> None:
    """Drive, count, ask, print."""
    parser = command_line("own_map", __doc__, "of rooms, stops and noise")
    parser.add_argument("--drives", type=int, default=100, help="through the same rooms (default 100)")
    parser.add_argument("--stops", type=int, default=2, help="in a room on every drive (default 2)")
    parser.add_argument("--queries", type=int, default=100, help="views that are asked about (default 100)")
    parser.add_argument("--keep", action="store_true", help="retire nothing")
    a = parser.parse_args()
    if min(a.drives, a.stops, a.queries) < 1:
        parser.error("--drives, --stops and --queries must be at least 1")
    console = Console(stderr=a.json)
    drives, recognised = run(a.drives, a.seed, a.stops, a.queries, not a.keep, console)
    table = Table("drive", *COLUMNS, title=f"seed {a.seed}")
    for number, one in enumerate(drives, start=1):
        table.add_row(str(number), *(f"{value:.4g}" for value in asdict(one).values()))
    console.print(table)
    figures = {"recognised": recognised, **in_the_long_run(drives)}
    console.print(figures)
    if a.json:
        print(json.dumps({"seed": a.seed, "drives": [asdict(one) for one in drives], **figures}))


def run(
    drives: int, seed: int, stops: int, queries: int, retire: bool, console: Console
) -> tuple[list[Drive], float]:
    """All drives, then the questions; see the module."""
    rng = np.random.default_rng([seed, 0x0A11])
    house, map_id = House.built(rng), MapId("r0", 1)
    own, curve, at_first = OwnMap(map_id, rng), list[Drive](), 0
    retirement = NodeRetirement(own.map)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "r0.sqlite"
        for number in track(range(1, drives + 1), "driving", console=console):
            now_ns = round(number * APART * DAY_NS)
            before = len(own.times)
            changes = own.drive(house, house.tour(stops, rng), now_ns)
            ticks, retired = [0.0], 0
            for _ in range(len(own.map.nodes) + 2 if retire else 0):
                began = time.perf_counter()
                node = retirement.next(now_ns + DAY_NS)
                ticks.append(time.perf_counter() - began)
                if node is not None:
                    own.builder.retire(node)
                    retired += 1
            changes += own.builder.take_changes()
            # A journal that is closed is one file.
            with closing(Journal(path, map_id.agent)) as journal:
                journal.append(journal.open_map(map_id.epoch), changes, now_ns)
                journal.acknowledge(SERVER, map_id, journal.head(map_id))
                journal.prune(map_id, [SERVER])
            # Libraries are loaded with the first drive.
            at_first = at_first or held_bytes()
            counts = len(own.map.nodes), len(own.map.edges), retired
            sizes = path.stat().st_size, held_bytes() - at_first
            waits = 1e3 * max(own.times[before:], default=0.0), 1e3 * max(ticks)
            curve.append(Drive(*counts, *sizes, *waits))
    views = [house.look(rng)[0] for _ in range(queries)]
    found = sum(bool(recognise_places(own.map, view, rng)) for view in views)
    return curve, round(found / queries, 4)


def in_the_long_run(curve: Sequence[Drive]) -> dict[str, float]:
    """What the last drives cost by those in the middle."""
    if len(curve) < 4 * SOME:
        return {}
    begin = len(curve) // 2 - SOME // 2 - 1
    middle, last = curve[begin : begin + SOME], curve[-SOME:]
    columns = {
        name: [[getattr(one, name) for one in some] for some in (middle, last)] for name in asdict(curve[0])
    }
    return {f"{name}_ratio": round(sum(b) / max(sum(a), 1e-9), 3) for name, (a, b) in columns.items()}

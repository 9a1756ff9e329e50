"""Where am I, among a thousand places and among a million: recall, false answers, time and memory.

    python -m benchmarks.relocalize [--nodes N ...] [--queries N] [--seed N] [--json]

A thousand places are real: simulated buildings (offices, a warehouse, a ring corridor, rooms with twins)
looked at with the robot's camera and eyes and made into nodes as uncertain as a robot's. Beyond these, places
are made of real views of other buildings (benchmarks.relocalize.distractors). Asked are views near mapped
poses, then disturbed ones, views of twin rooms, and views of unmapped buildings: to the last
two "here" is always a false answer. The ceiling compares views with every node by whole SIFT descriptors,
up to 10 000 nodes (of a larger fleet the first so many), every so manyth view where that is much; what the
index has lost is measured on the same views. A bag of visual words answers the same questions through the
same verification.

With `--nodes 1000 10000 100000 --queries 200` it takes about a quarter of an hour on one core, and the first
time of a seed some minutes more for its pictures, which it keeps in the folder for temporary files.

A server has its nodes ready; here those beyond the real ones are made on demand, and the
time for that is not counted, neither in an answer's nor in the index's.
"""

import json
import math
import os
import resource
from collections.abc import Iterable, Iterator
from itertools import islice
from typing import Any

# Small matrices gain nothing from more threads, and wait for each other where other programs run.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from benchmarks.command_line import at_least, command_line
from benchmarks.process_usage import held_bytes
from benchmarks.relocalize.fleet import Bench
from benchmarks.relocalize.peer import WordIndex
from benchmarks.relocalize.queries import KINDS
from benchmarks.relocalize.score import figures, recall_by_kind, spent, wrong_by_kind
from mapweave.hybridmap.node import Node
from mapweave.mapserver.relocalization.candidates import MOST_COMPARED
from mapweave.mapserver.relocalization.relocalizer import Relocalizer
from mapweave.mapserver.retrieval.place_index import PlaceIndex

REAL = 1000
"""Places that are real, at most."""
AT_ONCE = 4096
"""Nodes that are added to an index at once."""
CANDIDATES = MOST_COMPARED
PEER_AT_MOST = 100_000
"""Beyond, the bag of words is left out: it is not what is asked."""


def chunks(nodes: Iterable[Node], size: int) -> Iterator[list[Node]]:
    """So many at once."""
    rest = iter(nodes)
    while some := list(islice(rest, size)):
        yield some


def searched(bench: Bench, index: PlaceIndex) -> dict[str, float]:
    """How long the search takes of an answer."""
    ms = []
    for query in bench.queries:
        if query.kind in ("near", "nowhere"):
            view = query.picture.view
            began = spent()
            index.query(view, CANDIDATES)
            ms.append(1e3 * (spent() - began))
    found: dict[str, float] = {}
    for q in (50, 95):
        wall, cpu = np.percentile(ms, q, axis=0).tolist()
        found |= {f"search_p{q}_ms": round(wall, 2), f"search_cpu_p{q}_ms": round(cpu, 2)}
    return found


def measured(bench: Bench, size: int, peer: bool, ceilings: list[str]) -> dict[str, Any]:
    """Everything at one size."""
    index, before, began = PlaceIndex(), held_bytes(), spent() - bench.making
    with bench.task(f"{size} nodes: index", size) as step:
        for some in chunks(bench.nodes(size), AT_ONCE):
            index.extend(some)
            for _ in some:
                step()
    built = spent() - bench.making - began
    grown = (held_bytes() - before) / 1e6
    searches = searched(bench, index)
    relocalizer = Relocalizer(index, bench.node, bench.merged)
    prepared = bench.prepared(relocalizer)
    replies = bench.asked(f"{size} nodes", relocalizer)
    out: dict[str, Any] = {
        **figures(replies), **searches, "build_s": round(float(built[0]), 1),
        "build_cpu_s": round(float(built[1]), 1), "prepare_cpu_ms": round(prepared, 2),
        "memory_mb": round(grown, 1),
        "peak_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3, 1),
        "index_bytes_per_node": round(1e6 * grown / size), "recall": recall_by_kind(replies),
        "wrong": wrong_by_kind(replies),
    }  # fmt: skip
    if ceilings:
        out |= bench.ceiling(ceilings, size, relocalizer, replies)
    if peer and size <= PEER_AT_MOST:
        with bench.task(f"{size} nodes: words", size) as step:
            words = WordIndex(bench.nodes(size), bench.vocabulary, step)
        theirs = figures(
            bench.asked(
                f"{size} nodes: bag of words",
                Relocalizer(words, bench.node, bench.merged, alike=relocalizer.alike),
            )
        )
        for name in ("recall_at_1", "false_accept", "p50_ms", "p95_ms"):
            out[f"peer_{name}"] = theirs[name]
    return out


def table(sizes: dict[str, dict[str, Any]]) -> Table:
    """A table for people."""
    out, first = Table("figure", *sizes, title="nodes"), next(iter(sizes.values()))
    for name, value in first.items():
        if not isinstance(value, dict):
            out.add_row(name, *(f"{one.get(name, math.nan):g}" for one in sizes.values()))
    for name, words in (("recall", "recall"), ("wrong", '"here", wrongly'), ("exhaustive", "exhaustive")):
        for kind in first.get(name, {}):
            out.add_row(f"{words}, {kind}", *(f"{one[name][kind]:g}" for one in sizes.values()))
    return out


def main() -> None:
    """Run and print."""
    parser = command_line("relocalize", __doc__, whole=True)
    parser.add_argument(
        "--nodes", type=at_least(REAL), nargs="+", default=[1000, 10_000], help="sizes of the fleet's map"
    )
    parser.add_argument("--queries", type=at_least(4), default=200, help="of each kind (default 200)")
    parser.add_argument("--ceilings", nargs="*", default=["near"], choices=list(KINDS), help="kinds of views")
    parser.add_argument("--no-peer", action="store_true", help="without the bag of words")
    arguments = parser.parse_args()
    console = Console(stderr=arguments.json)
    sizes, real = sorted(set(arguments.nodes)), min(REAL, min(arguments.nodes))
    with Progress(console=console) as bar:
        bench = Bench(arguments.seed, real, arguments.queries, bar)
        hard = bench.hardness()
        found = {
            str(size): measured(bench, size, not arguments.no_peer, arguments.ceilings) for size in sizes
        }
    console.print(table(found))
    console.print(f"load of the machine {os.getloadavg()[0]:.1f}")
    console.print(f"votes of the best wrong node: {hard}")
    if arguments.json:
        by_name = {
            name: {size: one.get(name) for size, one in found.items()} for name in next(iter(found.values()))
        }
        run = {"seed": arguments.seed, "queries": arguments.queries, "load": os.getloadavg()[0]}
        extra = {"sizes": found, "hardness": hard}
        print(json.dumps({**by_name, **extra, **run}))

"""Where am I, among a thousand places and among a million: recall, false answers, time and memory.

    python -m benchmarks.relocalize [--nodes N ...] [--queries N] [--seed N] [--json]

A thousand places are real: simulated buildings (offices, a warehouse, a ring corridor, rooms with twins)
looked at with the robot's camera and eyes and made into nodes as uncertain as a robot's. Beyond these, places
are made of real views of other buildings (benchmarks.relocalize_distractors). Asked are views near mapped
postures, then disturbed ones, views of twin rooms, and views of buildings that nobody has mapped: to the last
two "here" is always a false answer. The ceiling compares every view with every real place by whole SIFT
descriptors; a bag of visual words answers the same questions through the same verification. The first run
takes its pictures (some minutes) and keeps them in the system's folder for temporary files.

A server has its nodes ready; here those beyond the real ones are made when somebody looks at them, and the
time for that is not counted, neither in an answer's nor in the index's.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import gc
import json
import os
import resource
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

# Small matrices gain nothing from more threads, and wait for each other where other programs run.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from benchmarks.relocalize_distractors import AGENT, gather
from benchmarks.relocalize_exhaustive import Exhaustive
from benchmarks.relocalize_peer import Vocabulary, WordIndex
from benchmarks.relocalize_places import joined, mapped, mapped_sites
from benchmarks.relocalize_queries import KINDS, Query, known, nowhere, twins
from benchmarks.relocalize_score import Reply, ask, figures, judged, recall_by_kind, share, spent
from hybridmap.descriptor import decode
from hybridmap.node import Node, NodeId
from mapserver.placeindex import PlaceIndex
from mapserver.relocalization import RelocalizationSettings, Relocalizer

REAL = 1000
"""Places that are real, at most."""
DONORS = 800
"""Views behind the others."""
AT_ONCE = 4096
"""Nodes that are added to an index at once."""
CANDIDATES = RelocalizationSettings().candidates
PEER_AT_MOST = 100_000
"""Beyond, the bag of words is left out: it is not what is asked."""


class Bench:
    """All that is asked of every size."""

    def __init__(self, seed: int, real: int, count: int, bar: Progress) -> None:
        """Take the pictures, or read them."""
        self.seed, self.bar = seed, bar
        sites = mapped_sites(seed)
        with self.task("places", real) as step:
            self.places = mapped(sites, real, seed, step)
        self.truth = {place.node.id: place for place in self.places}
        self.queries: list[Query] = []
        for kind in KINDS:
            with self.task(kind, count) as step:
                self.queries += known(kind, count, sites, self.places, seed, step)
        with self.task("twins", count) as step:
            self.queries += twins(count, sites, self.places, seed, step)
        with self.task("nowhere", count) as step:
            self.queries += nowhere(count, seed, step)
        with self.task("views of other buildings", DONORS) as step:
            self.distractors = gather(DONORS, self.places, seed, step)
        self.merged = joined(self.places, seed)
        self.making = np.zeros(2)
        """What was spent on making nodes, see benchmarks.relocalize_score.spent."""

    @cached_property
    def vocabulary(self) -> Vocabulary:
        """Of the bag of words, learned from the real places."""
        return Vocabulary(np.concatenate([decode(p.node.landmarks.codes) for p in self.places]), self.seed)

    @contextmanager
    def task(self, name: str, total: int) -> Iterator[Callable[[], None]]:
        """A line of progress."""
        task = self.bar.add_task(name, total=total)
        yield lambda: self.bar.advance(task)
        self.bar.update(task, completed=total, total=total)

    def node(self, node_id: NodeId) -> Node | None:
        """A node of the fleet, whichever size it has."""
        if node_id.agent == AGENT:
            return self.made(node_id.number)
        place = self.truth.get(node_id)
        return None if place is None else place.node

    def made(self, number: int) -> Node:
        """A node that is not real."""
        began = spent()
        node = self.distractors.node(number)
        self.making = self.making + spent() - began
        return node

    def nodes(self, size: int) -> Iterator[Node]:
        """The fleet's nodes, at a size."""
        yield from (place.node for place in self.places[:size])
        yield from (self.made(k) for k in range(size - len(self.places)))

    def asked(self, name: str, relocalizer: Relocalizer) -> list[Reply]:
        """All answers."""
        with self.task(name, len(self.queries)) as step:
            return ask(relocalizer.answer, self.queries, self.truth, step, lambda: self.making)

    def ceiling(self, kinds: list[str]) -> dict[str, float]:
        """Recall of the exhaustive search by kind."""
        chosen = [query for query in self.queries if query.kind in kinds]
        judge = Relocalizer(PlaceIndex(), self.node, self.merged)
        exhaustive = Exhaustive(self.places, judge)
        replies = []
        with self.task("exhaustive", len(chosen)) as step:
            for query in chosen:
                replies.append(judged(query, exhaustive.answer(query), self.truth))
                step()
        return {
            kind: share([r for r in replies if r.query.kind == kind], lambda r: r.recalled) for kind in kinds
        }

    def hardness(self) -> dict[str, dict[str, float]]:
        """How much the best wrong node looks like a view from nowhere, among real nodes and made ones."""
        count = len(self.places)
        made = [self.distractors.node(k) for k in range(count)]
        out = {}
        for name, nodes in (("real", [place.node for place in self.places]), ("made", made)):
            index = PlaceIndex()
            index.extend(nodes)
            views = [query.picture.view for query in self.queries if query.kind == "nowhere"]
            scores = [found[0][1] for view in views if (found := index.query(view, 1))]
            out[name] = {f"p{q}": round(float(np.percentile(scores, q)), 3) for q in (10, 50, 90, 99)}
        return out


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


def resident() -> float:
    """MB of memory that the process holds now; what it has freed is given back first, where that can be."""
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6


def measured(bench: Bench, size: int, peer: bool) -> dict[str, Any]:
    """Everything at one size."""
    index, before, began = PlaceIndex(), resident(), spent() - bench.making
    with bench.task(f"{size} nodes: index", size) as step:
        for some in chunks(bench.nodes(size), AT_ONCE):
            index.extend(some)
            for _ in some:
                step()
        index.settle()
    built = spent() - bench.making - began
    grown = resident() - before
    searches = searched(bench, index)
    replies = bench.asked(f"{size} nodes", Relocalizer(index, bench.node, bench.merged))
    out: dict[str, Any] = {
        **figures(replies), **searches, "build_s": round(float(built[0]), 1),
        "build_cpu_s": round(float(built[1]), 1), "memory_mb": round(grown, 1),
        "peak_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3, 1),
        "index_bytes_per_node": round(1e6 * grown / size), "recall": recall_by_kind(replies),
    }  # fmt: skip
    del index
    if peer and size <= PEER_AT_MOST:
        with bench.task(f"{size} nodes: words", size) as step:
            words = WordIndex(bench.nodes(size), bench.vocabulary, step)
        theirs = figures(
            bench.asked(f"{size} nodes: bag of words", Relocalizer(words, bench.node, bench.merged))
        )
        for name in ("recall_at_1", "false_accept", "p50_ms", "p95_ms"):
            out[f"peer_{name}"] = theirs[name]
    return out


def table(sizes: dict[str, dict[str, Any]]) -> Table:
    """For people."""
    out = Table("figure", *sizes, title="nodes")
    names = [name for name in next(iter(sizes.values())) if name != "recall"]
    for name in names:
        out.add_row(name, *(f"{one.get(name, float('nan')):g}" for one in sizes.values()))
    for kind in next(iter(sizes.values()))["recall"]:
        out.add_row(f"recall, {kind}", *(f"{one['recall'][kind]:g}" for one in sizes.values()))
    return out


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.relocalize", description=__doc__.splitlines()[0]
    )
    parser.add_argument(
        "--nodes", type=int, nargs="+", default=[1000, 10_000], help="sizes of the fleet's map"
    )
    parser.add_argument("--queries", type=int, default=200, help="of each kind (default 200)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--ceilings", nargs="*", default=["near"], choices=list(KINDS), help="kinds of views")
    parser.add_argument("--no-peer", action="store_true", help="without the bag of words")
    parser.add_argument("--json", action="store_true", help="last line of output: one JSON object")
    arguments = parser.parse_args()
    if min(arguments.nodes) < 100 or arguments.queries < 4 or arguments.seed < 0:
        parser.error("at least 100 nodes, 4 queries and a seed that is not negative are needed")
    console = Console(stderr=arguments.json)
    sizes, real = sorted(set(arguments.nodes)), min(REAL, min(arguments.nodes))
    with Progress(console=console) as bar:
        bench = Bench(arguments.seed, real, arguments.queries, bar)
        hard = bench.hardness()
        ceiling = bench.ceiling(arguments.ceilings)
        found = {str(size): measured(bench, size, not arguments.no_peer) for size in sizes}
    for one in found.values():
        if "near" in ceiling:
            one["recall_exhaustive"] = ceiling["near"]
    console.print(table(found))
    console.print(f"exhaustive: {ceiling}; load of the machine {os.getloadavg()[0]:.1f}")
    console.print(f"votes of the best wrong node: {hard}")
    if arguments.json:
        by_name = {
            name: {size: one.get(name) for size, one in found.items()} for name in next(iter(found.values()))
        }
        run = {"seed": arguments.seed, "queries": arguments.queries, "load": os.getloadavg()[0]}
        extra = {"sizes": found, "recall_exhaustive_by_kind": ceiling, "hardness": hard}
        print(json.dumps({**by_name, **extra, **run}))


if __name__ == "__main__":
    main()

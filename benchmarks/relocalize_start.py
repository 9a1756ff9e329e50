"""How long a server with a large store takes to start, until its places are searchable.

    python -m benchmarks.relocalize_start [--nodes N] [--seed N] [--json]

Fills a store with nodes as agents would send them, then opens it as a server does: once with nothing but the
store, once with the place index that was saved beside it. Filling is not counted; it takes longer than both
(about 2 ms a node), and 2 kB of disk a node. What the merge does with the nodes afterwards is not measured
here: until it is done, places are found but lie in no merged frame.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from benchmarks.relocalize_distractors import AGENT, Distractors, gather
from benchmarks.relocalize_places import mapped, mapped_sites
from hybridmap.change import Change, NodePut
from hybridmap.grid import snap
from hybridmap.node import MapId, Node
from mapserver.entry import Entry
from mapserver.placekeeper import SUFFIX, PlaceKeeper
from mapserver.store import Store
from wire.codec import encode_change

REAL, DONORS = 1000, 800
"""Views behind the nodes: those of benchmarks.relocalize, which keeps its pictures."""
AT_ONCE = 500
"""Changes in one commit."""
MAP = MapId(AGENT, 1)


def fill(path: Path, distractors: Distractors, count: int, bar: Progress) -> None:
    """Make the store."""
    store, task = Store(path), bar.add_task("the store is filled", total=count)
    for start in range(0, count, AT_ONCE):
        entries = []
        for number in range(start, min(start + AT_ONCE, count)):
            node = distractors.node(number)
            node = Node(node.id, 0, node.map_from_robot, node.camera, snap(node.landmarks, node.camera))
            change = Change(MAP, number + 1, 0, NodePut(node))
            entries.append(Entry(change.sequence, encode_change(change), change))
            bar.advance(task)
        store.apply(MAP, 1, entries)
    store.close()


def start(path: Path, count: int, bar: Progress) -> dict[str, float]:
    """Open the store, take its nodes in, and stop again.

    Returns:
        Seconds for each part, and from the beginning until all places are searchable; of that also those of
        processors, which a busy machine leaves nearly as they are.
    """
    task = bar.add_task("a server starts", total=count)
    began, processor = time.perf_counter(), time.process_time()
    store = Store(path)
    opened = time.perf_counter()
    keeper = PlaceKeeper(store, path)
    restored = time.perf_counter()
    nodes: list[Node] = []
    for map_id in store.maps():
        for change in store.replay(map_id):
            if isinstance(change.body, NodePut):
                nodes.append(change.body.node)
                bar.advance(task)
    read = time.perf_counter()
    keeper.index.extend(nodes)
    keeper.index.settle()
    done, spent = time.perf_counter(), time.process_time() - processor
    assert len(keeper.index) == count
    keeper.close()
    store.close()
    return {
        "open_s": opened - began, "saved_index_s": restored - opened, "read_s": read - restored,
        "index_s": done - read, "searchable_s": done - began, "searchable_cpu_s": spent,
        "save_s": time.perf_counter() - done,
    }  # fmt: skip


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.relocalize_start", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--nodes", type=int, default=10_000, help="in the store (default 10000)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="last line of output: one JSON object")
    arguments = parser.parse_args()
    if arguments.nodes < 200 or arguments.seed < 0:
        parser.error("at least 200 nodes and a seed that is not negative are needed")
    console = Console(stderr=arguments.json)
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(prefix="mapweave-start") as folder, Progress(console=console) as bar:
        path = Path(folder) / "store.db"
        task = bar.add_task("views", total=REAL + DONORS)
        places = mapped(mapped_sites(arguments.seed), REAL, arguments.seed, lambda: bar.advance(task))
        distractors = gather(DONORS, places, arguments.seed, lambda: bar.advance(task))
        bar.update(task, completed=REAL + DONORS)
        fill(path, distractors, arguments.nodes, bar)
        for name in ("store_alone", "with_saved_index"):
            found[name] = {key: round(value, 2) for key, value in start(path, arguments.nodes, bar).items()}
        saved = path.with_name(path.name + SUFFIX)
        found |= {"store_mb": round(path.stat().st_size / 1e6, 1)}
        found |= {"saved_index_mb": round(saved.stat().st_size / 1e6, 1), "nodes": arguments.nodes}
    table = Table("s", "store alone", "with the saved index", title=f"{arguments.nodes} nodes")
    for key in found["store_alone"]:
        table.add_row(key, f"{found['store_alone'][key]:g}", f"{found['with_saved_index'][key]:g}")
    console.print(table)
    if arguments.json:
        print(json.dumps({**found, "seed": arguments.seed}))


if __name__ == "__main__":
    main()

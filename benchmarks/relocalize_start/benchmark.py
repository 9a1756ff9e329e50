"""How long a server with a large store takes to start, until it answers lost robots rightly.

    python -m benchmarks.relocalize_start [--nodes N] [--seed N] [--store FOLDER] [--json]

Fills a store with the logs of a fleet (benchmarks.relocalize_start.store), then starts a real `mapweave
server` on it. Robots ask over Zenoh where views near real places were taken, from the beginning; the clock
stops when an answer comes back (`answer_s`), and runs from the start of the process. Then all questions are
asked once, while the server still compares the maps: it does so beside the answers, and is not waited for.

Filling takes about 3 ms of processor a node, and 4.5 kB of disk; with --store it is kept, and used again.
"""

import json
import math
import os
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress

from benchmarks.command_line import at_least, command_line, figure_table
from benchmarks.process_usage import peak_mb, used_by
from benchmarks.relocalize.distractors import gather
from benchmarks.relocalize.places import TruePlace, mapped, mapped_sites
from benchmarks.relocalize.queries import Query, known
from benchmarks.relocalize.score import judged, share
from benchmarks.relocalize_start.store import fill
from mapweave.hybridmap.query import RelocalizeAnswer
from mapweave.scenarios.children import Children, free_port
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import decode_record
from mapweave.wire.messages import decode, encode_view
from mapweave.wire.zenoh_bus import ZenohBus

REAL, DONORS = 1000, 800
"""Views behind the nodes: those of benchmarks.relocalize, which keeps its pictures."""
QUESTIONS = 100
FLEET, NAME = "start", "s0"
PATIENCE = 10.0
"""For one answer, s."""
LONGEST = 1800.0
"""Until the first answer, s."""


def start(
    folder: Path, queries: Sequence[Query], places: Sequence[TruePlace], bar: Progress
) -> dict[str, float]:
    """Start a server, ask, and end it.

    Returns:
        Seconds from the start of the process: `answer_s`, of which of processors `answer_cpu_s`. Of all
        questions then, while maps are compared: `right_share` of the answers "here" (`here_share`), their
        times, and how many gave a pose in a merged frame (`in_frame_share`). `peak_mb` of memory.
    """
    truth = {place.node.id: place for place in places}
    endpoint, task = f"tcp/127.0.0.1:{free_port()}", bar.add_task("a server starts", total=len(queries))
    with Children(folder / "logs") as children:
        began = time.monotonic()
        children.start(
            NAME, ["server", "--fleet", FLEET, "--listen", endpoint, "--data", str(folder), "--name", NAME]
        )
        pid, bus = children.pid(NAME), ZenohBus(BusSettings(endpoints=(endpoint,)))
        try:
            while _ask(bus, queries[0]) is None:
                children.check()
                if time.monotonic() - began > LONGEST:
                    raise SystemExit(f"no answer within {LONGEST:g} s")
                time.sleep(0.05)
            out = {"answer_s": time.monotonic() - began, "answer_cpu_s": used_by(pid)}
            took, replies, framed = [], [], 0
            for query in queries:
                asked = time.monotonic()
                answer = _ask(bus, query)
                if answer is not None:
                    took.append(time.monotonic() - asked)
                    reply = judged(query, answer, truth)
                    replies.append(reply)
                    best = answer.candidates[:1]
                    framed += bool(best and best[0].merged_from_robot is not None)
                bar.advance(task)
            status = decode_record(bus.ask(Keys(FLEET).server_status(NAME), b"", PATIENCE)[0].payload)
            here = [reply for reply in replies if reply.certainty == "found"]
            out |= {
                "answered_share": len(took) / len(queries), "here_share": len(here) / max(len(replies), 1),
                "right_share": share(here, lambda reply: reply.near),
                "in_frame_share": framed / max(sum(math.isfinite(r.error_m) for r in replies), 1),
                "p50_ms": 1e3 * float(np.median(took)), "p95_ms": 1e3 * float(np.percentile(took, 95)),
                "settled": float(bool(status["settled"])), "peak_mb": peak_mb(pid),
            }  # fmt: skip
        finally:
            bus.close()
        began = time.monotonic()
        children.end(NAME, patience=600.0)
        out["end_s"] = time.monotonic() - began
    return out


def _ask(bus: ZenohBus, query: Query) -> RelocalizeAnswer | None:
    """The answer; None while the server does not listen yet, or is busy."""
    replies = bus.ask(Keys(FLEET).any_relocalize(), encode_view(query.picture.view), PATIENCE)
    good = [reply for reply in replies if not reply.error]
    return decode(good[0].payload, RelocalizeAnswer) if good else None


def main() -> None:
    """Run and print."""
    parser = command_line("relocalize_start", __doc__)
    parser.add_argument("--nodes", type=at_least(REAL), default=10_000, help="in the store (default 10000)")
    parser.add_argument("--store", type=Path, help="folder for the store, which is kept there and used again")
    arguments = parser.parse_args()
    console, seed = Console(stderr=arguments.json), arguments.seed
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(prefix="mapweave-start") as temporary, Progress(console=console) as bar:
        folder = arguments.store or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        path, sites = folder / f"{NAME}.sqlite", mapped_sites(seed)
        task = bar.add_task("views", total=REAL + DONORS + QUESTIONS)
        places = mapped(sites, REAL, seed, lambda: bar.advance(task))
        queries = known("near", QUESTIONS, sites, places, seed, lambda: bar.advance(task))
        if not path.exists():
            distractors = gather(DONORS, places, seed, lambda: bar.advance(task))
            filling = bar.add_task("the store is filled", total=arguments.nodes)
            fill(path, places, distractors, arguments.nodes, lambda more: bar.advance(filling, more))
        bar.update(task, completed=REAL + DONORS + QUESTIONS)
        found |= {key: round(one, 3) for key, one in start(folder, queries, places, bar).items()}
        found["store_mb"] = round(path.stat().st_size / 1e6, 1)
    console.print(figure_table({"value": found}, f"{arguments.nodes} nodes", "{:g}".format))
    if arguments.json:
        run = {"nodes": arguments.nodes, "seed": seed, "load": round(os.getloadavg()[0], 1)}
        print(json.dumps({**found, **run}))

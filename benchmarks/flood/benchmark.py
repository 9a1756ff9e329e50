"""One robot of five floods the map server: what the other four notice.

    python -m benchmarks.flood [--seconds S] [--rate N] [--seed N] [--json]

A real `mapweave server` process, over Zenoh on loopback. Four honest robots send a change a second with the
real journal and replicator, and ask once a second where they are. First they are alone (`quiet`), then a
fifth process floods the server, each time in another way: `changes`, `--rate` node puts a second, and a new
map each 200; `beacons`, as many of maps whose logs never answer; `questions`, relocalize, route and known
from four threads without a pause.

Of the honest robots: `ack_p50_ms` and `ack_p99_ms` from handing over a change to its acknowledgement;
`answer_p50_ms` and `answer_p95_ms` from asking to an answer, refusals and their pauses included; `lost`,
changes and questions that got none within 60 s. Of the server at the end of each part: `rss_mb`, its
memory; `nodes` in the merged map, of which the honest robots have 80.
"""

from __future__ import annotations

import json
import math
import multiprocessing
import os
import tempfile
import threading
import time
from multiprocessing.process import BaseProcess
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from benchmarks.command_line import command_line
from benchmarks.flood.fleet import FLEET, NODES, PATIENCE, HonestRobot, Waits
from benchmarks.flood.flooder import KINDS, flood
from benchmarks.process_usage import resident_mb
from mapweave.scenarios.children import Children, free_port
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import decode_record
from mapweave.wire.zenoh_bus import ZenohBus

ROBOTS = 4
"""Honest ones."""
PARTS = ("quiet", *KINDS)


def work(robots: list[HonestRobot], seconds: float) -> Waits:
    """Let all robots work at once."""
    waits = Waits()
    threads = [threading.Thread(target=robot.work, args=(seconds, waits)) for robot in robots]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return waits


def figures(waits: Waits) -> dict[str, float]:
    """What is printed of one part."""
    acks, answers = 1e3 * np.array(waits.acks or [math.nan]), 1e3 * np.array(waits.answers or [math.nan])
    return {
        "acks": len(waits.acks),
        "ack_p50_ms": round(float(np.percentile(acks, 50)), 1),
        "ack_p99_ms": round(float(np.percentile(acks, 99)), 1),
        "answers": len(waits.answers),
        "answer_p50_ms": round(float(np.percentile(answers, 50)), 1),
        "answer_p95_ms": round(float(np.percentile(answers, 95)), 1),
        "lost": waits.lost,
    }


def merged_nodes(asker: ZenohBus) -> int:
    """Nodes in the merged map; -1 without an answer."""
    replies = asker.ask(Keys(FLEET).server_status("s0"), b"", PATIENCE)
    return int(decode_record(replies[0].payload)["nodes"]) if replies else -1


def wait_until_merged(asker: ZenohBus) -> None:
    """The maps of the honest robots are merged before anything is measured."""
    end = time.monotonic() + PATIENCE
    while merged_nodes(asker) < ROBOTS * NODES:
        if time.monotonic() > end:
            raise SystemExit("the server has not merged the maps in time")
        time.sleep(0.1)


def end(flooders: list[BaseProcess]) -> None:
    """End the flood."""
    while flooders:
        flooder = flooders.pop()
        flooder.kill()
        flooder.join()


def measure(seconds: float, rate: float, seed: int, folder: Path) -> dict[str, dict[str, float]]:
    """All parts."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with Children(folder / "logs") as children, Progress(console=Console(stderr=True)) as progress:
        step = progress.add_task("the robots hand over their maps", total=len(PARTS))
        children.start("server", ["server", "--fleet", FLEET, "--listen", endpoint, "--data", str(folder)])
        server = children.pid("server")
        robots = [HonestRobot(number, endpoint, folder, seed) for number in range(ROBOTS)]
        asker = ZenohBus(BusSettings(endpoints=(endpoint,)))
        flooders: list[BaseProcess] = []
        try:
            if not all(robot.hand_over() for robot in robots):
                raise SystemExit("the server has not taken the maps in time")
            wait_until_merged(asker)
            parts: dict[str, dict[str, float]] = {}
            for part in PARTS:
                progress.update(step, description=part)
                if part in KINDS:
                    flooders.append(
                        multiprocessing.get_context("spawn").Process(
                            target=flood, args=(endpoint, part, rate, seed + 50), daemon=True
                        )
                    )
                    flooders[-1].start()
                    time.sleep(2.0)
                waits = work(robots, seconds)
                parts[part] = figures(waits) | {
                    "rss_mb": round(resident_mb(server), 1),
                    "nodes": merged_nodes(asker),
                }
                end(flooders)
                children.check()
                progress.advance(step)
            return parts
        finally:
            end(flooders)
            for robot in robots:
                robot.close()
            asker.close()


def main() -> None:
    """Measure and print."""
    parser = command_line("flood", __doc__)
    parser.add_argument("--seconds", type=float, default=15.0, help="of each part")
    parser.add_argument("--rate", type=float, default=500.0, help="changes or beacons a second")
    options = parser.parse_args()
    if not (0.0 < options.seconds < math.inf and 0.0 < options.rate < math.inf):
        parser.error("--seconds and --rate must be positive")
    report = {"seed": options.seed, "cores": os.cpu_count(), "load_before": round(os.getloadavg()[0], 1)}
    with tempfile.TemporaryDirectory() as folder:
        parts = measure(options.seconds, options.rate, options.seed, Path(folder))
    table = Table(title="Four honest robots, without and with one that floods the server")
    table.add_column("")
    for part in PARTS:
        table.add_column(part, justify="right")
    for key in parts["quiet"]:
        table.add_row(key, *(f"{parts[part][key]:g}" for part in PARTS))
    Console(stderr=options.json).print(table)
    if options.json:
        print(json.dumps({**report, **parts}))

"""How fast the simulator carries a fleet, where the time goes, and what drawing costs at the least.

    python -m benchmarks.sim [--robots 1 2 4 8] [--seconds S] [--seed N] [--json]

For each number of robots a fleet explores an office with the full pipeline at 10 Hz and 320 x 240: agents,
journals, replication and map server, in lock-step, once in processes (as `mapweave sim run` does by default)
and once in one process. Starting the processes is not counted. `share` tells where the time of the fleet in
one process goes, in the same run. The renderer is timed beside PyBullet's bare `getCameraImage` of the
same views, without any texture: the floor that a simulator on PyBullet pays at the least.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks.command_line import command_line
from benchmarks.sim.bare_view import BareView
from mapweave.agent.ekf.mapping_filter import MappingFilter
from mapweave.agent.fleet_client import FleetClient
from mapweave.agent.replication.replicator import Replicator
from mapweave.agent.settings import AgentSettings
from mapweave.agent.vision.tracker import Tracker
from mapweave.scenarios.fleet import TICKS_PER_SECOND, TrialFleet, TrialStage
from mapweave.scenarios.local_fleet import LocalFleet
from mapweave.scenarios.process_fleet import ProcessFleet
from mapweave.scenarios.scenario import load_scenario, scenario_path
from mapweave.sim.camera import WEBCAM
from mapweave.sim.imager import Imager
from mapweave.sim.renderer import Renderer
from mapweave.sim.scene import Scene
from mapweave.sim.simulation import Simulation
from mapweave.sim.world import PanelSet
from mapweave.sim.worlds.catalog import make_world
from mapweave.vision.sift import Sift

PARTS: dict[str, tuple[tuple[type[Any], tuple[str, ...]], ...]] = {
    "render": ((Imager, ("picture",)),),
    "physics": ((Simulation, ("advance",)),),
    "features": ((Sift, ("extract",)), (Tracker, ("track", "add"))),
    "filter": ((MappingFilter, ("predict", "update", "add", "landmarks", "converged")),),
    "bus": (
        (Replicator, ("submit", "flush", "wait_acknowledged")),
        (FleetClient, ("report", "answers", "ask")),
    ),
}
"""Whose calls count for a part. None of them calls one of another part."""

VIEWS = 60
"""Views that the renderers draw."""


def stage_of(robots: int, seed: int, out: Path) -> TrialStage:
    """An office with a room for each robot, at least three."""
    overrides = (f"robots={robots}", f"world.rooms={max(3, min(robots, 12))}")
    return TrialStage(load_scenario(scenario_path("office"), overrides), seed, out, AgentSettings())


def time_fleet(fleet: TrialFleet, seconds: float) -> float:
    """Wall seconds that a fleet takes for some simulated ones; starting is not counted."""
    fleet.start()
    try:
        fleet.advance(1)
        began = time.perf_counter()
        fleet.advance(1 + round(seconds * TICKS_PER_SECOND))
        return time.perf_counter() - began
    finally:
        fleet.end()


@contextmanager
def metered() -> Iterator[dict[str, float]]:
    """Seconds by part, while the context lasts. Costs about a microsecond a call."""
    spent = dict.fromkeys(PARTS, 0.0)
    originals: list[tuple[type[Any], str, Any]] = []

    def timed(part: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def wrapper(*args: Any, **named: Any) -> Any:
            began = time.perf_counter()
            try:
                return call(*args, **named)
            finally:
                spent[part] += time.perf_counter() - began

        return wrapper

    for part, owners in PARTS.items():
        for owner, names in owners:
            for name in names:
                originals.append((owner, name, getattr(owner, name)))
                setattr(owner, name, timed(part, getattr(owner, name)))
    try:
        yield spent
    finally:
        for owner, name, call in originals:
            setattr(owner, name, call)


def in_one_process(robots: int, seed: int, seconds: float) -> tuple[float, dict[str, float]]:
    """Wall seconds, and the share of each part; `rest` is what an agent does beside, and the loop."""
    with tempfile.TemporaryDirectory() as folder, metered() as spent:
        wall = time_fleet(LocalFleet(stage_of(robots, seed, Path(folder))), seconds)
    found = {part: round(time_spent / wall, 4) for part, time_spent in spent.items()}
    return wall, {**found, "rest": round(1.0 - sum(found.values()), 4)}


def renderers(seed: int) -> dict[str, float]:
    """Milliseconds a view: our renderer with textures, PyBullet's without any."""
    world = make_world("office", seed)
    rng = np.random.default_rng([seed, 0xBA2E])
    poses = [world.plan.random_free_pose(rng, 0.3) for _ in range(VIEWS)]
    scene, renderer, bare = (
        Scene([PanelSet.of(world.panels)]),
        Renderer(WEBCAM, world.background),
        BareView(world),
    )
    ours, floor = [], []
    for repeat in range(2):  # textures are painted when they are first seen: the second round counts
        for pose in poses:
            rotation, position = np.eye(3), np.array([pose.x, pose.y, 0.0])
            rotation[:2, :2] = pose.rotation
            began = time.perf_counter()
            renderer.render(scene, rotation, position)
            middle = time.perf_counter()
            if repeat:
                bare.render(WEBCAM, pose)
                ours.append(middle - began)
                floor.append(time.perf_counter() - middle)
    return {"ours_ms": 1e3 * float(np.median(ours)), "bare_getCameraImage_ms": 1e3 * float(np.median(floor))}


def main() -> None:
    """Run and print."""
    parser = command_line("sim", __doc__, whole=True)
    parser.add_argument("--robots", type=int, nargs="+", default=[1, 2, 3, 4, 8], help="how many; 1 to 16")
    parser.add_argument("--seconds", type=float, default=40.0, help="simulated, for each fleet (default: 40)")
    arguments = parser.parse_args()
    robots = arguments.robots
    if not 1 <= min(robots) <= max(robots) <= 16 or not arguments.seconds > 0:
        parser.error("--robots are 1 to 16, --seconds more than 0")
    cv2.setNumThreads(1)
    result = measure(arguments.robots, arguments.seconds, arguments.seed, quiet=arguments.json)
    if arguments.json:
        print(json.dumps(result))
    else:
        Console().print(table(result))


def measure(robots: list[int], seconds: float, seed: int, quiet: bool) -> dict[str, Any]:
    """All figures."""
    many: dict[str, float] = {}
    one: dict[str, float] = {}
    parts: dict[str, dict[str, float]] = {}
    for count in track(robots, "fleets", console=Console(stderr=True, quiet=quiet)):
        with tempfile.TemporaryDirectory() as folder:
            wall = time_fleet(ProcessFleet(stage_of(count, seed, Path(folder))), seconds)
        many[str(count)] = round(seconds / wall, 3)
        wall, parts[str(count)] = in_one_process(count, seed, seconds)
        one[str(count)] = round(seconds / wall, 3)
    return {
        "seed": seed,
        "seconds": seconds,
        "real_time_factor": many,
        "real_time_factor_one_process": one,
        "share": parts,
        "renderer": {name: round(value, 3) for name, value in renderers(seed).items()},
    }


def table(result: dict[str, Any]) -> Table:
    """A table for people."""
    shown = Table(title=f"a fleet in an office, seed {result['seed']}")
    for title in ("robots", "x real time", "in one process", *(f"{part} %" for part in (*PARTS, "rest"))):
        shown.add_column(title, justify="right")
    for count, factor in result["real_time_factor"].items():
        part = result["share"][count]
        cells = [f"{100 * part[name]:.0f}" for name in (*PARTS, "rest")]
        shown.add_row(count, f"{factor:.1f}", f"{result['real_time_factor_one_process'][count]:.1f}", *cells)
    drawn = result["renderer"]
    shown.caption = (
        f"a view: {drawn['ours_ms']:.1f} ms with textures; PyBullet's bare getCameraImage, without: "
        f"{drawn['bare_getCameraImage_ms']:.1f} ms"
    )
    return shown

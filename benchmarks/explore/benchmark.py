"""How much floor a fleet maps in a minute: the paper's way by chance, ours, and ours with what others know.

    python -m benchmarks.explore [--seed N] [--minutes M] [--robots 1 2 3] [--rooms R]
                                [--spread] [--json]

Whole fleets (agents, journals, map server, in lock-step) explore the same office from the same places. They
are set down together, or, with --spread, each robot in a room of its own:

- `random`: the paper's (section 4.1): map the view driving back and forth, turn on the spot to a side that
  chance chooses until at most four features are left, again; and drive on straight for a random way, since
  otherwise it would never leave its place;
- `ours`: look all around at a place, then go to where most floor is unknown; each robot for itself;
- `fleet`: the same, and what other robots have looked around at is left to them. Not run for one robot.

Floor is mapped once a node shows it, by the truth: in the field of view of its image, at most 3 m away,
nothing solid between. `overlap` is the share of it which nodes of more than one robot show.
"""

import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from benchmarks.command_line import at_least, command_line, failing_in_one_line
from benchmarks.explore.area import Look, MappedFloor, mapped_floor
from benchmarks.explore.start import office
from mapweave.agent.settings import AgentSettings, ExplorerSettings
from mapweave.evaluation.map_score import score_map
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.node import EdgeKind
from mapweave.scenarios.fleet import TICKS_PER_SECOND, TrialStage
from mapweave.scenarios.local_fleet import LocalFleet
from mapweave.storage.map_file import unpack_map_file

STRATEGIES = {
    "random": ExplorerSettings(random=True, ask_fleet=False),
    "ours": ExplorerSettings(ask_fleet=False),
    "fleet": ExplorerSettings(),
}
STRIDE = 5.0
"""Simulated time between two moves of the progress bar, s."""


@dataclass(frozen=True, eq=False)
class Exploration:
    """What one fleet did.

    Attributes:
        floor: what it has mapped, and when.
        nodes: how many.
        collisions: with anything.
        false_links: between its maps.
        components: parts of the merged map.
        ate: root mean square position error of the nodes, m; None without nodes.
    """

    floor: MappedFloor
    nodes: int
    collisions: int
    false_links: int
    components: int
    ate: float | None


def explore(stage: TrialStage, seconds: float, on_time: Callable[[float], None]) -> Exploration:
    """Let a fleet explore.

    Args:
        stage: which, and where.
        seconds: how long, simulated.
        on_time: called with the seconds since the last call.
    """
    fleet = LocalFleet(stage)
    fleet.start()
    try:
        for until in np.append(np.arange(STRIDE, seconds, STRIDE), seconds):
            fleet.advance(round(until * TICKS_PER_SECOND))
            on_time(STRIDE)
        return _judged(stage, fleet)
    finally:
        fleet.end()


def _judged(stage: TrialStage, fleet: LocalFleet) -> Exploration:
    (reply,) = fleet.bus.ask(fleet.keys.any_server_map(), b"", 60.0)
    merged = unpack_map_file(reply.payload)
    whole = HybridMap(merged.changes)
    truth = fleet.control.truth_of(whole.nodes.values())
    looks: dict[str, list[Look]] = {robot: [] for robot in stage.robots}
    for node in whole.nodes.values():
        looks[node.id.agent].append(Look(node.stamp_ns / 1e9, truth[node.id], node.camera.semi_aperture))
    links = [edge for edge in whole.edges.values() if edge.kind is EdgeKind.MERGED]
    score = score_map({node: (c, p.mean) for node, (c, p) in merged.poses.items()}, links, truth)
    robots = fleet.control.status().robots.values()
    return Exploration(
        floor=mapped_floor(fleet.control.plan(), looks),
        nodes=len(truth),
        collisions=sum(robot.collisions for robot in robots),
        false_links=score.false_links,
        components=score.components,
        ate=round(score.ate, 4) if truth else None,
    )


def measure(
    robots: list[int], rooms: int, minutes: float, seed: int, spread: bool, quiet: bool
) -> dict[str, dict[int, Exploration]]:
    """Every strategy with every number of robots."""
    runs = [(name, count) for count in robots for name in STRATEGIES if name != "fleet" or count > 1]
    done: dict[str, dict[int, Exploration]] = {name: {} for name in STRATEGIES}
    with Progress(console=Console(stderr=True, quiet=quiet)) as progress:
        bar = progress.add_task("", total=len(runs) * minutes * 60.0)
        for name, count in runs:
            progress.update(bar, description=f"{name}, {count} {'robots' if count > 1 else 'robot'}")
            scenario = office(rooms, count, seed, spread)
            with tempfile.TemporaryDirectory() as folder:
                settings = AgentSettings(exploration=STRATEGIES[name])
                stage = TrialStage(scenario, seed, Path(folder), settings)
                done[name][count] = explore(stage, minutes * 60.0, lambda s: progress.advance(bar, s))
    return done


def figures(done: dict[str, dict[int, Exploration]], minutes: float, seed: int) -> dict[str, Any]:
    """All figures, by the number of robots."""
    end = minutes * 60.0
    rates = {
        name: {str(n): round(one.floor.area(end) / minutes, 3) for n, one in ones.items()}
        for name, ones in done.items()
    }

    def each(value: Callable[[Exploration], Any]) -> dict[str, dict[str, Any]]:
        return {name: {str(n): value(one) for n, one in ones.items()} for name, ones in done.items()}

    def ratio(rate: float, random: float) -> float | None:
        return round(rate / random, 3) if random else None

    def half(one: Exploration) -> float | None:
        at = one.floor.time_to(0.5)
        return None if at is None else round(at / 60.0, 2)

    return {
        "seed": seed,
        "minutes": minutes,
        "floor_m2": round(next(iter(done["ours"].values())).floor.whole, 1),
        **{f"area_per_minute_{name}": rate for name, rate in rates.items()},
        "speedup_over_random": {
            name: {n: ratio(rate, rates["random"][n]) for n, rate in rates[name].items()}
            for name in ("ours", "fleet")
        },
        "overlap": each(lambda one: round(one.floor.overlap(end), 3)),
        "minutes_to_half": each(half),
        "nodes": each(lambda one: one.nodes),
        "collisions": each(lambda one: one.collisions),
        "false_links": each(lambda one: one.false_links),
        "components": each(lambda one: one.components),
        "ate_m": each(lambda one: one.ate),
    }


def table(result: dict[str, Any]) -> Table:
    """A table for people."""
    shown = Table(
        title=f"office of {result['floor_m2']:.0f} m2, {result['minutes']:g} minutes, seed {result['seed']}"
    )
    for title in (
        "robots", "strategy", "m2 a minute", "x random", "half mapped, min", "overlap %", "nodes",
        "collisions", "parts of the map", "false links", "error m",
    ):  # fmt: skip
        shown.add_column(title, justify="left" if title == "strategy" else "right")
    for count in result["area_per_minute_ours"]:
        for name in STRATEGIES:
            rate = result[f"area_per_minute_{name}"].get(count)
            if rate is None:
                continue
            shown.add_row(
                count, name, f"{rate:.1f}",
                _short(result["speedup_over_random"].get(name, {count: 1.0})[count], 2),
                _short(result["minutes_to_half"][name][count], 1),
                f"{100 * result['overlap'][name][count]:.0f}",
                *(str(result[key][name][count]) for key in ("nodes", "collisions", "components")),
                str(result["false_links"][name][count]), _short(result["ate_m"][name][count], 3),
            )  # fmt: skip
    return shown


def _short(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def main() -> None:
    """Run and print."""
    parser = command_line("explore", __doc__, whole=True)
    parser.add_argument("--robots", type=at_least(1), nargs="+", default=[1, 2, 3], help="how many; 1 to 16")
    parser.add_argument("--minutes", type=float, default=5.0, help="simulated (default: 5)")
    parser.add_argument("--rooms", type=int, default=6, help="of the office, 3 to 12 (default: 6)")
    parser.add_argument("--spread", action="store_true", help="each robot begins in a room of its own")
    arguments = parser.parse_args()
    if not arguments.minutes > 0.0:
        parser.error("--minutes must be positive")
    cv2.setNumThreads(1)
    robots, minutes, seed = arguments.robots, arguments.minutes, arguments.seed
    with failing_in_one_line("explore"):
        done = measure(robots, arguments.rooms, minutes, seed, arguments.spread, arguments.json)
    result = figures(done, minutes, seed)
    if arguments.json:
        print(json.dumps(result))
    else:
        Console().print(table(result))

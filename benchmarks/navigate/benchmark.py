"""Navigation in the large: put down anywhere in a mapped office, a robot finds itself and drives to a goal.

    python -m benchmarks.navigate [--seed N] [--out DIR] [--runs N] [--rooms N] [--map-time S] [--json]

One robot explores an office from nothing. Then, with the map on its disk and its server's, it is put down
again and again at random poses from which no image was taken, and sent to a random node at least four
edges away. Agent, server and messages are the fleet's own, in one process; images are rendered, wheels slip.
Errors are against where the goal's image was truly taken. A drive succeeds if the robot says within 240 s
that it has arrived, is then within 5 cm and 5 degrees, and has touched nothing. The shortest way is that of a
robot that knows the floor. Of the map it prints what the drives have measured and how far its nodes are off
before and after them. DIR gets fig11.png (desired and reached views), drives.png, and the map, which a
later call with the same DIR, seed and rooms takes up again.
"""

import argparse
import json
import os
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path

# numpy reads it when it is imported. One thread for algebra and images, as in Mapweave's own processes.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from benchmarks.command_line import at_least, command_line, failing_in_one_line, figure_table
from benchmarks.navigate.drives import NavigationOutcome, drive
from benchmarks.navigate.floor import FreeFloor
from benchmarks.navigate.map import Figures, map_figures
from benchmarks.navigate.office import TRUTH, Mapped, Office
from benchmarks.navigate.pictures import draw
from benchmarks.navigate.plots import draw_plot
from mapweave.hybridmap.errors import InvalidValue
from mapweave.sim.floorplan import BuildingPlan
from mapweave.sim.robots import RobotSetup

WIDTH = 140
"""Of what is printed into a file or a pipe, characters."""


def main() -> None:
    """Map, drive, draw and print."""
    arguments = _arguments()
    cv2.setNumThreads(1)
    console = Console(stderr=arguments.json)
    if not console.is_terminal:
        console = Console(stderr=arguments.json, width=WIDTH)
    with failing_in_one_line("navigate"):
        outcomes, mapped, plan, learned = _run(arguments, console)
        pictures = draw(outcomes, mapped, plan, arguments.out)
    figures = summary(outcomes) | learned
    console.print(_table(outcomes, arguments.seed))
    console.print(_totals(figures, len(mapped.truth)))
    console.print(f"pictures: {', '.join(str(path) for path in pictures)}")
    if arguments.json:
        print(json.dumps({"seed": arguments.seed, "nodes": len(mapped.truth), **figures}))


def summary(outcomes: Sequence[NavigationOutcome]) -> Figures:
    """The figures of all drives. Errors and ratios are medians over the drives that said they had arrived."""
    there = [one for one in outcomes if one.status.finished]
    drives = [one.status.drive for one in outcomes]

    def median(values: Sequence[float]) -> float | None:
        return round(statistics.median(values), 5) if values else None

    return {
        "runs": len(outcomes),
        "success": round(sum(one.success for one in outcomes) / len(outcomes), 4),
        "arrived": len(there),
        "goal_error_m_median": median([one.error_m for one in there]),
        "goal_error_m_max": round(max((one.error_m for one in there), default=0.0), 5) if there else None,
        "goal_error_deg_median": median([one.error_deg for one in there]),
        "collisions": sum(one.collisions for one in outcomes),
        "edges_driven": sum(one.edges for one in drives),
        "nodes_skipped": sum(one.skipped for one in drives),
        "relocalizations": sum(one.relocalizations for one in drives),
        "blocks": sum(one.blocks for one in drives),
        "path_over_shortest": median([one.path_over_shortest for one in there]),
        "found_s_median": median([one.found_s for one in outcomes if one.found_s is not None]),
        "time_s_median": median([one.time_s for one in there]),
    }


def _arguments() -> argparse.Namespace:
    parser = command_line("navigate", __doc__, "of office, robot, starts and goals")
    parser.add_argument("--out", type=Path, default=Path("out/navigate"), help="folder of map and pictures")
    parser.add_argument("--runs", type=at_least(1), default=20, help="drives (default 20)")
    parser.add_argument("--rooms", type=int, default=2, help="of the office (default 2)")
    parser.add_argument(
        "--map-time", type=float, default=420.0, help="exploration ends after this, simulated s (default 420)"
    )
    return parser.parse_args()


def _run(
    arguments: argparse.Namespace, console: Console
) -> tuple[list[NavigationOutcome], Mapped, BuildingPlan, Figures]:
    folder = arguments.out / f"map-{arguments.seed}-{arguments.rooms}-{arguments.map_time:g}"
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[doing]}"))
    with Progress(*columns, TimeElapsedColumn(), console=console) as progress:
        if not (folder / TRUTH).exists():
            _map(folder, arguments, progress)
        task = progress.add_task("driving", total=arguments.runs, doing="")
        # Another day: the robot is switched on with the map on its disk, and must localize.
        with Office(folder, arguments.seed, arguments.rooms) as office:
            mapped, plan, before = office.mapped(), office.control.plan(), office.merged()
            floor = FreeFloor.of(plan, RobotSetup("r0").describe().radius)
            outcomes = []
            for run in range(arguments.runs):
                plot = draw_plot(mapped, plan, floor, np.random.default_rng([arguments.seed, run, 0xD21]))
                outcomes.append(drive(office, plot, _shown(progress, task, run + 1)))
                progress.advance(task)
            learned = map_figures(before, office.merged(), mapped)
    return outcomes, mapped, plan, learned


def _map(folder: Path, arguments: argparse.Namespace, progress: Progress) -> None:
    """Explore, and keep the map."""
    folder.mkdir(parents=True, exist_ok=True)
    if any(folder.iterdir()):
        raise InvalidValue(f"{folder}: holds a map that was not finished; remove it or name another --out")
    task = progress.add_task("mapping", total=arguments.map_time, doing="")
    with Office(folder, arguments.seed, arguments.rooms) as office:
        office.explore(
            arguments.map_time, lambda now, doing: progress.update(task, completed=now, doing=doing)
        )
    progress.update(task, completed=arguments.map_time)


def _shown(progress: Progress, task: object, run: int) -> Callable[[float, str], None]:
    def show(now: float, doing: str) -> None:
        progress.update(task, doing=f"{run}: {now:.0f} s, {doing}")  # type: ignore[arg-type]

    return show


def _table(outcomes: Sequence[NavigationOutcome], seed: int) -> Table:
    """A drive a row."""
    table = Table(title=f"seed {seed}")
    for name in ("drive", "goal", "edges", "found s", "time s", "mm", "deg", "way", "driven", "skipped",
                 "lost", "blocked", "outcome"):  # fmt: skip
        table.add_column(name, justify="left" if name in ("goal", "outcome") else "right")
    for number, one in enumerate(outcomes, start=1):
        drove = one.status.drive
        table.add_row(
            str(number), str(one.plot.goal), str(one.plot.edges),
            "-" if one.found_s is None else f"{one.found_s:.1f}",
            f"{one.time_s:.0f}", f"{one.error_m * 1000:.0f}", f"{one.error_deg:.2f}",
            f"{one.path_over_shortest:.2f}", str(drove.edges), str(drove.skipped),
            str(drove.relocalizations), str(drove.blocks), one.reason or "there",
        )  # fmt: skip
    return table


def _totals(figures: Figures, nodes: int) -> Table:
    title = f"{figures['runs']} drives on a map of {nodes} nodes"
    return figure_table({"value": figures}, title, lambda value: "-" if value is None else f"{value:g}")

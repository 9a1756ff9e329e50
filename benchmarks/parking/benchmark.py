"""How well a robot parks at a view that it has mapped: real rendering, tracking and filters.

    python -m benchmarks.parking [--starts N] [--seed N] [--goals N] [--one-view] [--out DIR] [--json]

In arenas of the simulator a robot maps a place by itself, as it does when it explores. The first view there
is the goal. Then it is put down 0.3 to 2.5 m from it, in the half-plane behind it or up to 10 cm ahead,
turned by less than 45 degrees, with at least six of the goal's landmarks in the image and free floor in
between. It finds itself, and parks. A parking succeeds if the robot says within 60 s that it has parked,
stands within 1 cm and 1 degree of where the goal's image was taken, had never fewer than four of the goal's
landmarks in view while it servoed, and touched nothing. What the robot itself says of its pose is held
against the truth: the squared error over its covariance (NEES) is 3 on average if the covariance is right,
and less if the robot is more careful than it need be. Starts from which an independent planner finds no
path that keeps four landmarks in view are left out and counted. With --one-view the robot knows nothing but
the goal's view.

With --out the paper's Figures 12, 13 and 14 are drawn, of the parking with the median time.
"""

import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress
from rich.table import Table

from benchmarks.command_line import at_least, command_line, failing_in_one_line
from benchmarks.parking.figures import draw_figures
from benchmarks.parking.run import ParkingOutcome, park
from benchmarks.parking.scene import ParkingScene

DEALT = 0x57A7
"""Separates the draws of starts from those of scenes."""


def parkings(
    seed: int, starts: int, goals: int, one_view: bool
) -> Iterator[tuple[int, ParkingScene, ParkingOutcome | None]]:
    """Park from as many starts as there is a path for, evenly over the goals.

    Args:
        seed: of everything.
        starts: how many.
        goals: each in another arena.
        one_view: whether the robot knows the goal's view alone.

    Yields:
        Number of the goal, its scene, and what came of a start; None for one without a path.
    """
    for number, share in enumerate(np.diff(np.linspace(0, starts, goals + 1).astype(int)).tolist()):
        if not share:
            continue
        scene = ParkingScene((seed, number), one_view)
        rng = np.random.default_rng([seed, number, DEALT])
        done = 0
        while done < share:
            start = scene.draw_start(rng)
            shortest = scene.shortest(start)
            if shortest is None:
                yield number, scene, None
                continue
            yield number, scene, park(scene, start, shortest, seed=int(rng.integers(2**31)))
            done += 1


def summary(outcomes: Sequence[ParkingOutcome], left_out: int) -> dict[str, float]:
    """The figures. Errors are over all that say they have parked, time over those that have.

    Their standard deviations and NEES are over those that know themselves by the goal.
    """
    arrived = [o for o in outcomes if o.arrived]
    known = [o for o in arrived if math.isfinite(o.nees)]
    good = [o for o in outcomes if o.success]

    def percentile(values: Sequence[float], q: float) -> float:
        return round(float(np.percentile(values, q)), 4) if values else math.nan

    return {
        "success": round(len(good) / len(outcomes), 4),
        "arrived": round(len(arrived) / len(outcomes), 4),
        "error_m_median": percentile([o.error_m for o in arrived], 50),
        "error_deg_median": percentile([o.error_deg for o in arrived], 50),
        "error_m_p95": percentile([o.error_m for o in arrived], 95),
        "error_deg_p95": percentile([o.error_deg for o in arrived], 95),
        "sigma_m_median": percentile([o.sigma_m for o in known], 50),
        "nees_mean": round(float(np.mean([o.nees for o in known])), 2) if known else math.nan,
        "time_s_median": percentile([o.time_s for o in good], 50),
        "time_s_p95": percentile([o.time_s for o in good], 95),
        "path_ratio_median": percentile([o.path_ratio for o in good], 50),
        "switches_p95": percentile([o.switches for o in outcomes], 95),
        "fov_violations": sum(o.violations > 0 for o in outcomes),
        "collisions": sum(o.collisions for o in outcomes),
        "starts": len(outcomes),
        "starts_left_out": left_out,
    }


def table_of(outcomes: Sequence[tuple[int, ParkingOutcome]]) -> Table:
    """One row a start."""
    table = Table(
        "goal", "from m, m, deg", "s", "off mm, deg", "believed mm", "switches", "", title="parkings"
    )  # fmt: skip
    for goal, o in outcomes:
        table.add_row(
            f"{goal}", f"{o.start.x:5.2f} {o.start.y:5.2f} {math.degrees(o.start.heading):3.0f}",
            f"{o.time_s:.1f}", f"{1e3 * o.error_m:.1f} {o.error_deg:.2f}",
            f"{1e3 * o.believed_m:.1f} +- {1e3 * o.sigma_m:.1f}",
            f"{o.switches}", "[green]parked[/]" if o.success else f"[red]{escape(o.reason)}[/]",
        )  # fmt: skip
    return table


def run(
    seed: int, starts: int, goals: int, one_view: bool, out: Path | None, console: Console
) -> dict[str, float]:
    """Park, print, draw; returns the figures."""
    outcomes: list[tuple[int, ParkingScene, ParkingOutcome]] = []
    left_out = 0
    with Progress(console=console) as progress:
        task = progress.add_task("mapping a goal", total=starts)
        for goal, scene, outcome in parkings(seed, starts, goals, one_view):
            if outcome is None:
                left_out += 1
                continue
            outcomes.append((goal, scene, outcome))
            progress.update(task, advance=1, description=f"parking at goal {goal + 1} of {goals}")
    console.print(table_of([(goal, outcome) for goal, _, outcome in outcomes]))
    figures = summary([outcome for _, _, outcome in outcomes], left_out)
    totals = Table("figure", "value", title=f"{starts} starts, {left_out} without a path")
    for key, value in figures.items():
        totals.add_row(key, f"{value:g}")
    console.print(totals)
    if out is not None:
        # Of those that have parked if there are any: the one in the middle by time.
        best = [one for one in outcomes if one[2].success] or outcomes
        _, scene, outcome = sorted(best, key=lambda one: one[2].time_s)[len(best) // 2]
        for path in draw_figures(scene, outcome, out):
            console.print(f"wrote {path}")
    return figures


def main() -> None:
    """Run and print."""
    parser = command_line("parking", __doc__)
    parser.add_argument("--starts", type=at_least(1), default=20, help="starts with a path (default 20)")
    parser.add_argument(
        "--goals", type=at_least(1), default=5, help="goals, each in another arena (default 5)"
    )
    parser.add_argument("--one-view", action="store_true", help="map the goal's view alone")
    parser.add_argument("--out", type=Path, help="folder for the pictures; it is made")
    arguments = parser.parse_args()
    console = Console(stderr=arguments.json)
    with failing_in_one_line("parking"):
        if arguments.out is not None:
            arguments.out.mkdir(parents=True, exist_ok=True)
        figures = run(
            arguments.seed, arguments.starts, min(arguments.goals, arguments.starts), arguments.one_view,
            arguments.out, console,
        )  # fmt: skip
    if arguments.json:
        print(json.dumps({key: None if math.isnan(v) else v for key, v in figures.items()}))

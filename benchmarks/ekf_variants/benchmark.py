"""Where to keep landmarks and where to linearise: the choices of docs/decisions/ekf-parametrisation.md.

    python -m benchmarks.ekf_variants [--runs N] [--steps N] [--seed N] [--jobs N] [--json]

Every filter gets the same runs as in benchmarks.ekf: 50 s at 10 Hz in four shapes, 30 landmarks, wheels that
slip, no wrong tracks. Its error is given as a ratio to that of the batch optimum. NEES (3 degrees of freedom,
of the pose and of a landmark in the filter's own coordinates) is averaged over the runs that have not
diverged: to diverge is to be ten times as far off as the optimum, or to end without a number.
"""

from __future__ import annotations

import argparse
import json
import math
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import repeat
from multiprocessing import get_context

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.stats import chi2

from benchmarks.ekf_speed.benchmark import one_thread
from benchmarks.ekf_variants.coordinates import Points, Rays
from benchmarks.ekf_variants.textbook import Choice, TextbookFilter
from mapweave.agent.ekf.mapping_state import PRIOR_DEPTH, PRIOR_SPREAD
from mapweave.agent.settings import FilterSettings
from synthetic.mapping_error import error, filter_error, follow, landmark_nees
from synthetic.mapping_optimum import batch_optimum
from synthetic.mapping_run import SHAPES, MappingRun, draw_run

DIVERGED = 10.0
"""Error over the batch optimum's."""

TEXTBOOK = {
    "moving points, the paper's": Choice(Points(), moving=True, aside_sigma=0.2),
    "moving points, 2.5 +- 1 m": Choice(Points(), moving=True),
    "moving points, 2.5 +- 2 m": Choice(Points(), moving=True, depth_sigma=2.0),
    "moving points, iterated": Choice(Points(), moving=True, iterations=5),
    "moving points, step again": Choice(Points(), moving=True, relinearisations=3),
    "fixed points": Choice(Points(), moving=False),
    "fixed points, FEJ": Choice(Points(), moving=False, first_estimates=True),
    "fixed points, iterated": Choice(Points(), moving=False, iterations=5),
    "fixed rays": Choice(Rays(), moving=False),
    "fixed rays, FEJ": Choice(Rays(), moving=False, first_estimates=True),
    "fixed rays, iterated": Choice(Rays(), moving=False, iterations=5),
}
"""Points are (p1, p2, p3), rays (a, b, w); moving with the camera, or fixed at the first image's; FEJ:
first-estimates Jacobians; step again: a step is linearised again where its image says that the robot went."""

OURS = {"ours, each step once": 0, "ours": 3}
"""Our filter by how often a step is linearised again."""


@dataclass(frozen=True)
class Outcome:
    """One filter on one run.

    Attributes:
        ratio: error over the batch optimum's; infinite if the filter ended without a number.
        nees_pose: of the last pose.
        nees_landmark: mean over the landmarks.
    """

    ratio: float
    nees_pose: float
    nees_landmark: float


def try_textbook(run: MappingRun, choice: Choice, best: float) -> Outcome:
    """Filter a run as a choice has it; the batch optimum's error is `best`, m."""
    lost = Outcome(math.inf, math.nan, math.nan)
    # A landmark that such a filter puts on the optical centre's plane divides by zero: it has diverged.
    with np.errstate(all="ignore"):
        try:
            filter_ = TextbookFilter(run, choice)
            for odometry, pixels in zip(run.odometry, run.pixels[1:], strict=True):
                filter_.step(odometry, pixels)
            off = error(run, np.arange(len(run.points)), filter_.pose_vector, filter_.points_in_anchor())
            last = run.poses[-1]
            nees = filter_.pose_nees(last), filter_.landmark_nees(run.points, last)
        except np.linalg.LinAlgError:
            return lost
    return Outcome(off / best, *nees) if math.isfinite(off) else lost


def try_ours(run: MappingRun, relinearisations: int, best: float) -> Outcome:
    """Our filter on the same run."""
    settings = FilterSettings(pixel_sigma=run.pixel_sigma, relinearisations=relinearisations)
    filter_ = follow(run, settings)
    off = filter_error(run, filter_, np.ones(len(run.points), np.bool_))
    return Outcome(off / best, filter_.pose.mahalanobis2(run.poses[-1]), landmark_nees(run, filter_))


def try_run(seed: int, trial: int, steps: int) -> dict[str, Outcome]:
    """All filters on one run."""
    run = draw_run(np.random.default_rng([seed, trial]), SHAPES[trial % len(SHAPES)], steps)
    pose_vector, points = batch_optimum(run, PRIOR_DEPTH, PRIOR_SPREAD)
    best = error(run, np.arange(len(run.points)), pose_vector, points)
    outcomes = {name: try_textbook(run, choice, best) for name, choice in TEXTBOOK.items()}
    return outcomes | {name: try_ours(run, again, best) for name, again in OURS.items()}


def summary(outcomes: list[Outcome]) -> dict[str, float]:
    """The figures of one filter over all runs."""
    ratios = np.array([o.ratio for o in outcomes])
    stayed = [o for o in outcomes if o.ratio <= DIVERGED]
    return {
        "ratio_median": float(np.median(ratios)),
        "ratio_p90": float(np.percentile(ratios, 90, method="higher")),
        "nees_pose": float(np.mean([o.nees_pose for o in stayed])) if stayed else math.nan,
        "nees_landmark": float(np.mean([o.nees_landmark for o in stayed])) if stayed else math.nan,
        "diverged": 1.0 - len(stayed) / len(outcomes),
    }


def main() -> None:
    """Run and print."""
    about = __doc__.splitlines()[0]
    parser = argparse.ArgumentParser(prog="python -m benchmarks.ekf_variants", description=about)
    parser.add_argument("--runs", type=int, default=24, help="mapping runs (default 24)")
    parser.add_argument("--steps", type=int, default=500, help="length of a run (default 500)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--json", action="store_true", help="last line of output: one JSON object")
    arguments = parser.parse_args()
    if min(arguments.runs, arguments.steps, arguments.jobs) < 1 or arguments.seed < 0:
        parser.error("--runs, --steps and --jobs must be at least 1, --seed at least 0")
    console = Console(stderr=arguments.json)
    one_thread()
    with ProcessPoolExecutor(arguments.jobs, mp_context=get_context("spawn")) as pool:
        seeds, steps = repeat(arguments.seed), repeat(arguments.steps)
        results = pool.map(try_run, seeds, range(arguments.runs), steps)
        trials = list(track(results, "filtering", total=arguments.runs, console=console))
    figures = {name: summary([trial[name] for trial in trials]) for name in trials[0]}
    interval = [float(chi2.ppf(q, 3 * len(trials)) / len(trials)) for q in (0.025, 0.975)]
    title = f"{len(trials)} runs; a consistent filter's NEES: {interval[0]:.2f} to {interval[1]:.2f}"
    table = Table("filter", "median", "p90", "pose", "marks", "diverged", title=title)
    table.caption = "error over the optimum's: median, p90; NEES: pose, landmarks"
    for name, row in figures.items():
        cells = [f"{row[key]:.3g}" if row[key] >= 10 else f"{row[key]:.2f}" for key in list(row)[:4]]
        table.add_row(name, *cells, f"{100 * row['diverged']:.0f} %")
    console.print(table)
    if arguments.json:
        keys = next(iter(figures.values()))
        columns = {key: {name: _number(row[key]) for name, row in figures.items()} for key in keys}
        print(json.dumps(columns | {"nees_interval": [_number(end) for end in interval]}))


def _number(value: float) -> float | None:
    """For JSON, which has no infinity and no NaN."""
    return float(f"{value:.5g}") if math.isfinite(value) else None

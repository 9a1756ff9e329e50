"""How near the two filters come to the optimum, and whether they know how far off they are.

    python -m benchmarks.ekf [--runs N] [--seed N] [--jobs N] [--json]

Mapping: 50 s at 10 Hz back and forth, in four shapes of drive; 30 landmarks 1.5-5 m ahead, 0.5-1 px, wheels
of 2 % that slip by 10 % in two steps of a hundred. The rival is the maximum a posteriori of the whole run by
GTSAM on the same measurements, noise and priors. An error is the RMS distance to the truth, in the first
robot frame, of all landmarks and of the robot itself at the end. The same runs are repeated with 30 % of the
tracks spoiled; there the other 70 % are judged. Localization: ten random starts a run, and one node that is
driven through again and again with the map that the drive before has left. Times of a step are printed beside
FilterPy's (benchmarks.ekf_speed).
"""

import json
import math
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context

import numpy as np
from rich.console import Console
from rich.progress import track
from scipy.special import chdtri

from benchmarks.command_line import at_least, command_line, figure_table
from benchmarks.ekf_speed.benchmark import measure, one_thread
from mapweave.agent.ekf.mapping_state import PRIOR_DEPTH, PRIOR_SPREAD
from synthetic.localization_run import FEW, Start, SurveyedNode, try_drives, try_start
from synthetic.mapping_error import error, filter_error, follow, landmark_nees, left_out
from synthetic.mapping_optimum import batch_optimum
from synthetic.mapping_run import SHAPES, draw_run
from synthetic.track_faults import spoil

_STARTS = 10
_DRIVES = 4


@dataclass(frozen=True)
class FilterRun:
    """One run.

    Attributes:
        ratio: error over the batch optimum's.
        nees_pose: of the last pose, 3 degrees of freedom.
        nees_landmark: mean over the landmarks, in the camera's (a, b, w), 3 degrees of freedom each.
        outlier_ratio: error with spoiled tracks over that without, on the good ones.
        left_out: landmarks that these errors leave out: let go by the filter, or at infinity to it.
        starts: localization.
        places: a node as it was mapped, and after each drive through it.
    """

    ratio: float
    nees_pose: float
    nees_landmark: float
    outlier_ratio: float
    left_out: int
    starts: tuple[Start, ...]
    places: tuple[SurveyedNode, ...]


def try_run(seed: int, trial: int) -> FilterRun:
    """One run with everything that is measured on it."""
    rng = np.random.default_rng([seed, trial])
    run = draw_run(rng, SHAPES[trial % len(SHAPES)])
    filter_ = follow(run)
    everything = np.ones(len(run.points), np.bool_)
    pose_vector, points = batch_optimum(run, PRIOR_DEPTH, PRIOR_SPREAD)
    best = error(run, filter_.ids, pose_vector, points[filter_.ids])
    spoiled_run, spoiled = spoil(run, 0.3, rng)
    spoiled_filter = follow(spoiled_run)
    return FilterRun(
        filter_error(run, filter_, everything) / best,
        filter_.pose.mahalanobis2(run.poses[-1]),
        landmark_nees(run, filter_),
        filter_error(spoiled_run, spoiled_filter, ~spoiled) / filter_error(run, filter_, ~spoiled),
        left_out(filter_, everything) + left_out(spoiled_filter, ~spoiled),
        tuple(try_start(rng) for _ in range(_STARTS)),
        tuple(try_drives(rng, _DRIVES)),
    )


def summary(trials: list[FilterRun]) -> dict[str, float | list[float]]:
    """The figures over all runs."""
    ratios = [t.ratio for t in trials]
    starts = [start for t in trials for start in t.starts]
    few = [start.converged for start in starts if start.visible <= FEW]
    healthy = [start for start in starts if start.healthy]
    n = len(trials)
    return {
        "rmse_ratio_to_batch_median": float(np.median(ratios)),
        "rmse_ratio_to_batch_p90": float(np.percentile(ratios, 90)),
        "nees_pose": float(np.mean([t.nees_pose for t in trials])),
        "nees_landmark": float(np.mean([t.nees_landmark for t in trials])),
        "nees_interval": [float(chdtri(3 * n, q) / n) for q in (0.975, 0.025)],
        "outlier30_ratio": float(np.median([t.outlier_ratio for t in trials])),
        "outlier30_ratio_p90": float(np.percentile([t.outlier_ratio for t in trials], 90)),
        "landmarks_left_out": float(sum(t.left_out for t in trials)),
        "localization_converged": float(np.mean([start.converged for start in starts])),
        "localization_starts_few": float(len(few)),
        "localization_converged_few": float(np.mean(few)) if few else float("nan"),
        "localization_nees": float(np.mean([start.nees for start in healthy])),
        "localization_wrong_healthy": float(np.mean([not start.near for start in healthy])),
        "map_update_ratio": float(np.median([start.after.error / start.before.error for start in starts])),
        "map_error_by_drive": _by_drive([[place.error for place in t.places] for t in trials]),
        "map_nees_by_drive": _by_drive([[place.nees for place in t.places] for t in trials]),
    }


def _by_drive(figures: list[list[float]]) -> list[float]:
    """Median over the nodes, before all drives and after each."""
    return [float(figure) for figure in np.median(figures, axis=0)]


def main() -> None:
    """Run and print."""
    parser = command_line("ekf", __doc__)
    parser.add_argument("--runs", type=at_least(1), default=100, help="mapping runs (default 100)")
    parser.add_argument("--jobs", type=at_least(1), default=1, help="processes")
    arguments = parser.parse_args()
    console = Console(stderr=arguments.json)
    one_thread()
    with console.status("timing ..."):
        times = measure(arguments.seed)
    with ProcessPoolExecutor(arguments.jobs, mp_context=get_context("spawn")) as pool:
        results: Iterator[FilterRun] = pool.map(
            try_run, [arguments.seed] * arguments.runs, range(arguments.runs)
        )
        trials = list(track(results, "filtering", total=arguments.runs, console=console))
    figures = summary(trials)
    figures |= times
    console.print(figure_table({"value": figures}, f"{arguments.runs} runs of 500 steps", _shown))
    if arguments.json:
        print(json.dumps({key: _rounded(value) for key, value in figures.items()}))


def _shown(value: float | list[float]) -> str:
    parts = value if isinstance(value, list) else [value]
    return ", ".join(f"{part:.3g}" if part < 1e-3 else f"{part:.3f}" for part in parts)


def _rounded(value: float | list[float]) -> float | list[float] | None:
    """The value for JSON, which has no NaN: a figure of no starts is null."""
    if isinstance(value, list):
        return [float(f"{part:.5g}") for part in value]
    return None if math.isnan(value) else float(f"{value:.5g}")

"""What one predict and update costs beside FilterPy's, and whether both come to the same.

    python -m benchmarks.ekf_speed [--seed N] [--json]

Three filters take turns on the same run, step by step, in one process on one core: ours as robots run it
(gates, and steps linearised again); ours with the rival's algorithm (each step linearised once, gates that
refuse nothing); and FilterPy's on the same model. Each pays for its own model. Medians over 200 steps.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context

import numpy as np
from rich.console import Console
from rich.table import Table

from agent.ekf.mapping import FilterSettings, MappingFilter
from agent.observation import Odometry
from benchmarks.ekf_filterpy import FilterPyMapping
from benchmarks.ekf_run import AXLE, WHEEL_NOISE, MappingRun, draw_run
from hybridmap.pose import Array

SIZES = (30, 100)
_BELIEVE_ALL = 1.0 - 1e-15


@dataclass(frozen=True)
class Speed:
    """Of one size of state.

    Attributes:
        full_ms: median step of our filter as robots run it.
        plain_ms: of ours with FilterPy's algorithm.
        filterpy_ms: of FilterPy's.
        difference: largest between the states of the two that share the algorithm, over all steps: m, rad,
            1, 1/m.
        covariance_difference: and between their covariances, entry ij in units of sigma_i sigma_j.
    """

    full_ms: float
    plain_ms: float
    filterpy_ms: float
    difference: float
    covariance_difference: float


class Ours:
    """Our filter at the pace of the race."""

    def __init__(self, run: MappingRun, settings: FilterSettings) -> None:
        """Start with all landmarks of the first image."""
        self.filter = MappingFilter(run.camera, AXLE, WHEEL_NOISE, settings)
        self._ids = np.arange(len(run.points))
        self.filter.add(self._ids, run.pixels[0])

    def step(self, odometry: Odometry, pixels: Array) -> None:
        """Predict and update."""
        self.filter.predict(odometry)
        self.filter.update(self._ids, pixels)

    @property
    def x(self) -> Array:
        """(3 + 3n,) state."""
        return np.concatenate([self.filter.state.posture, self.filter.state.rays.ravel()])


def plain(run: MappingRun) -> FilterSettings:
    """Settings under which our filter does what a textbook's does."""
    return FilterSettings(
        pixel_sigma=run.pixel_sigma, relinearisations=0, gate_probability=_BELIEVE_ALL, widest_slope=np.inf
    )


def rival(run: MappingRun) -> FilterPyMapping:
    """FilterPy's filter at the start of a run."""
    s = plain(run)
    return FilterPyMapping(
        run.camera, AXLE, WHEEL_NOISE, run.pixels[0], s.pixel_sigma, s.prior_depth, s.prior_spread
    )


def covariance_gap(ours: Array, theirs: Array) -> float:
    """Largest difference of two covariances, entry ij in units of sigma_i sigma_j, where there is any."""
    sigmas = np.sqrt(np.diag(theirs))
    scale = np.outer(sigmas, sigmas)
    return float((np.abs(ours - theirs) / np.where(scale > 0, scale, 1.0)).max())


def race(seed: int, landmarks: int, steps: int = 200) -> Speed:
    """Let the three filters take turns on one run."""
    run = draw_run(np.random.default_rng(seed), "arc", steps=steps, landmarks=landmarks)
    full = Ours(run, FilterSettings(pixel_sigma=run.pixel_sigma))
    same, other = Ours(run, plain(run)), rival(run)

    def theirs(odometry: Odometry, pixels: Array) -> None:
        other.move(odometry)
        other.see(pixels)

    racers: list[Callable[[Odometry, Array], None]] = [full.step, same.step, theirs]
    times = np.empty((steps, len(racers)))
    difference = covariance_difference = 0.0
    for k, (odometry, pixels) in enumerate(zip(run.odometry, run.pixels[1:], strict=True)):
        for turn in range(len(racers)):
            # In another order each step: nobody always finds the caches warm.
            i = (k + turn) % len(racers)
            before = time.perf_counter()
            racers[i](odometry, pixels)
            times[k, i] = 1e3 * (time.perf_counter() - before)
        difference = max(difference, float(np.abs(same.x - other.x).max()))
        off = covariance_gap(same.filter.state.covariance, other.P)
        covariance_difference = max(covariance_difference, off)
    full_ms, plain_ms, filterpy_ms = (float(ms) for ms in np.median(times, axis=0))
    return Speed(full_ms, plain_ms, filterpy_ms, difference, covariance_difference)


def one_thread() -> None:
    """Give each process spawned from here one thread: small matrices gain nothing from more."""
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"


def measure(seed: int) -> dict[str, float]:
    """The figures of all sizes, from a process of its own with one thread."""
    one_thread()
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        speeds = {n: pool.submit(race, seed, n).result() for n in SIZES}
    figures: dict[str, float] = {}
    for n, speed in speeds.items():
        figures[f"step_ms_n{n}"] = speed.full_ms
        figures[f"step_ms_n{n}_plain"] = speed.plain_ms
        figures[f"filterpy_step_ms_n{n}"] = speed.filterpy_ms
    figures["filterpy_difference"] = max(speed.difference for speed in speeds.values())
    figures["filterpy_covariance_difference"] = max(s.covariance_difference for s in speeds.values())
    return figures


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.ekf_speed", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="last line of output: one JSON object")
    arguments = parser.parse_args()
    console = Console(stderr=arguments.json)
    with console.status("three filters take turns ..."):
        figures = measure(arguments.seed)
    table = Table(
        "landmarks", "ours", "ours, plain", "FilterPy", "FilterPy / ours", title="ms a step, median"
    )
    for n in SIZES:
        ours, same, theirs = (figures[f"{key}_n{n}{end}"] for key, end in _COLUMNS)
        table.add_row(str(n), f"{ours:.2f}", f"{same:.2f}", f"{theirs:.2f}", f"{theirs / ours:.1f}")
    console.print(table)
    console.print(f"largest difference of states {figures['filterpy_difference']:.1e}")
    if arguments.json:
        print(json.dumps({key: float(f"{value:.4g}") for key, value in figures.items()}))


_COLUMNS = (("step_ms", ""), ("step_ms", "_plain"), ("filterpy_step_ms", ""))


if __name__ == "__main__":
    main()

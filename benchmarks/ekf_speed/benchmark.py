"""What one predict and update costs beside FilterPy's, and whether both come to the same.

    python -m benchmarks.ekf_speed [--seed N] [--json]

Three filters take turns of 20 steps on the same run, in one process on one core: ours as robots run it
(gates, and steps linearised again); ours with the rival's algorithm (each step linearised once, gates that
refuse nothing); and FilterPy's on the same model. Each pays for its own model. Medians over 200 steps.
"""

import contextlib
import json
import os
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Protocol
from unittest.mock import patch

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.command_line import command_line
from mapweave.agent.ekf import mapping_filter, measurement_model, pixel_noise
from mapweave.agent.ekf.mapping_filter import MappingFilter
from mapweave.agent.ekf.mapping_state import PRIOR_DEPTH, PRIOR_SPREAD
from mapweave.agent.observation import Odometry
from mapweave.agent.settings import FilterSettings
from mapweave.hybridmap.pose import Array
from synthetic.mapping_run import AXLE, WHEEL_NOISE, MappingRun, draw_run

SIZES = (30, 100)
_BELIEVE_ALL = 1.0 - 1e-15
_BURST = 20
"""Steps in a row before the next filter's turn, so that a step finds its own memory and not the other's."""

Belief = tuple[Array, Array]
"""(3 + 3n,) state and its covariance."""


@dataclass(frozen=True)
class Speed:
    """The times of both filters for one size of state.

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


class Racer(Protocol):
    """A filter at the pace of the race."""

    def rules(self) -> contextlib.AbstractContextManager[None]:
        """The rules by which it steps."""

    def step(self, odometry: Odometry, pixels: Array) -> None:
        """Predict and update."""

    @property
    def belief(self) -> Belief:
        """What it believes now; no longer than until the next step."""


class Ours:
    """Our filter."""

    def __init__(self, run: MappingRun, plain: bool = False) -> None:
        """Start with all landmarks of the first image.

        Args:
            run: what is seen.
            plain: whether to do what a textbook's filter does, within `rules`.
        """
        self._plain = plain
        with self.rules():
            self._filter = MappingFilter(run.camera, AXLE, WHEEL_NOISE, FilterSettings(run.pixel_sigma))
        self._ids = np.arange(len(run.points))
        self._filter.add(self._ids, run.pixels[0])

    def rules(self) -> contextlib.AbstractContextManager[None]:
        """See Racer."""
        return textbook() if self._plain else contextlib.nullcontext()

    def step(self, odometry: Odometry, pixels: Array) -> None:
        """See Racer."""
        self._filter.predict(odometry)
        self._filter.update(self._ids, pixels)

    @property
    def belief(self) -> Belief:
        """See Racer."""
        state = self._filter.state
        return np.concatenate([state.pose_vector, state.rays.ravel()]), state.covariance


class Theirs:
    """FilterPy's."""

    def __init__(self, run: MappingRun) -> None:
        """Start with all landmarks of the first image, from our priors."""
        # It imports scipy.stats, which takes as long as a sixth of all that the tests import.
        from benchmarks.ekf_speed.filterpy_filter import FilterPyMapping

        self._filter = FilterPyMapping(
            run.camera, AXLE, WHEEL_NOISE, run.pixels[0], run.pixel_sigma, PRIOR_DEPTH, PRIOR_SPREAD
        )

    def rules(self) -> contextlib.AbstractContextManager[None]:
        """See Racer."""
        return contextlib.nullcontext()

    def step(self, odometry: Odometry, pixels: Array) -> None:
        """See Racer."""
        self._filter.move(odometry)
        self._filter.see(pixels)

    @property
    def belief(self) -> Belief:
        """See Racer."""
        return self._filter.x, self._filter.P


@contextlib.contextmanager
def textbook() -> Iterator[None]:
    """While it lasts, our filter does what a textbook's does."""
    with (
        patch.multiple(
            mapping_filter, RELINEARISATIONS=0, GATE_PROBABILITY=_BELIEVE_ALL, WIDEST_SLOPE=np.inf
        ),
        patch.object(measurement_model, "RELINEARISATIONS", 0),
        patch.object(pixel_noise, "ADAPTATION", 0.0),
    ):
        yield


def gap(ours: Belief, theirs: Belief) -> tuple[float, float]:
    """Largest difference of two states, and of their covariances, entry ij in units of sigma_i sigma_j."""
    (x, p), (y, q) = ours, theirs
    sigmas = np.sqrt(np.diag(q))
    scale = np.outer(sigmas, sigmas)
    return float(np.abs(x - y).max()), float((np.abs(p - q) / np.where(scale > 0, scale, 1.0)).max())


def race(seed: int, landmarks: int, steps: int = 200) -> Speed:
    """Let the three filters take turns on one run."""
    run = draw_run(np.random.default_rng(seed), "arc", steps=steps, landmarks=landmarks)
    racers: list[Racer] = [Ours(run), Ours(run, plain=True), Theirs(run)]
    size = 3 + 3 * landmarks
    # Beliefs are kept in places of their own: taken between the steps, they would leave cold memory to these.
    # With all its rules our filter may give a landmark up; what is compared are the two that do not.
    kept = [[(np.empty(size), np.empty((size, size))) for _ in range(_BURST)] for _ in racers]
    times: list[tuple[float, float, float]] = []
    gaps: list[tuple[float, float]] = []
    for start in range(0, steps, _BURST):
        burst = range(start, min(start + _BURST, steps))
        full_ms, plain_ms, filterpy_ms = (
            _turn(racer, run, burst, room) for racer, room in zip(racers, kept, strict=True)
        )
        times += zip(full_ms, plain_ms, filterpy_ms, strict=True)
        gaps += [gap(ours, theirs) for ours, theirs, _ in zip(kept[1], kept[2], burst, strict=False)]
    return Speed(*np.median(times, axis=0), *np.max(gaps, axis=0))


def _turn(racer: Racer, run: MappingRun, burst: range, kept: list[Belief]) -> list[float]:
    """How long each step of a burst takes, ms; what is believed after it is kept."""
    times = []
    with racer.rules():
        for k, (state, covariance) in zip(burst, kept, strict=False):
            before = time.perf_counter()
            racer.step(run.odometry[k], run.pixels[k + 1])
            times.append(1e3 * (time.perf_counter() - before))
            x, p = racer.belief
            state[: len(x)], covariance[: len(x), : len(x)] = x, p
    return times


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
    parser = command_line("ekf_speed", __doc__)
    arguments = parser.parse_args()
    console = Console(stderr=arguments.json)
    with console.status("three filters take turns ..."):
        figures = measure(arguments.seed)
    table = Table("landmarks", "ours", "ours, plain", "FilterPy", "FilterPy / ours", title="ms a step")
    for n in SIZES:
        ours, same, theirs = (figures[f"{key}_n{n}{end}"] for key, end in _COLUMNS)
        table.add_row(str(n), f"{ours:.2f}", f"{same:.2f}", f"{theirs:.2f}", f"{theirs / ours:.1f}")
    console.print(table)
    console.print(f"largest difference of states {figures['filterpy_difference']:.1e}")
    if arguments.json:
        print(json.dumps({key: float(f"{value:.4g}") for key, value in figures.items()}))


_COLUMNS = (("step_ms", ""), ("step_ms", "_plain"), ("filterpy_step_ms", ""))

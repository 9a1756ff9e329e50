"""How well a robot parks at a view of which only bearings are known, on an exact unicycle.

    python -m benchmarks.appearance [--trials N] [--seed N] [--landmarks N ...] [--jobs N] [--json]

The tasks of benchmarks.servo, but nobody knows a depth: the goal is its view's pixels, with 0.5 px noise like
every other pixel. What is seen of a few landmarks in one noisy view bounds how well anybody can park at it,
so the servo that knows depths runs on the same view, with depths that are off by three per cent, as in a
node. The naive rival turns to the epipole and drives there. A trial succeeds if the robot says that it has
arrived within 60 s, stands within 1 cm and 1 degree, and never had fewer than four landmarks in view.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks.appearance.drivers import DRIVERS
from benchmarks.servo.planner import shortest_length
from benchmarks.servo.world import (
    LEAST_VISIBLE,
    PIXEL_SIGMA_PX,
    ROBOT,
    Task,
    Unicycle,
    draw_task,
)
from hybridmap.pose import wrap_angle

_TIME_LIMIT = 60.0
_HEADING = math.radians(1.0)


@dataclass(frozen=True)
class Outcome:
    """One driver on one task; `ticks_ms` are the times of its calls."""

    arrived: bool
    violated: bool
    error_m: float
    error_deg: float
    length_m: float
    time_s: float
    ticks_ms: tuple[float, ...]

    def success(self, position: float) -> bool:
        """Arrived within a position (m) and one degree, never with too few landmarks in view."""
        good = self.error_m <= position and math.radians(self.error_deg) <= _HEADING
        return self.arrived and not self.violated and good


def park(name: str, task: Task, rng: np.random.Generator) -> Outcome:
    """Run one driver on one task."""
    robot, driver = Unicycle(task), DRIVERS[name](task, PIXEL_SIGMA_PX, rng)
    ticks_ms, arrived = [], False
    for _ in range(round(_TIME_LIMIT / ROBOT.tick)):
        before = time.perf_counter()
        command = driver.command(robot.pose)
        ticks_ms.append(1e3 * (time.perf_counter() - before))
        if command is None:
            arrived = True
            break
        driver.move(*robot.drive(command))
    return Outcome(
        arrived,
        robot.least_visible < LEAST_VISIBLE,
        math.hypot(robot.pose.x, robot.pose.y),
        math.degrees(abs(wrap_angle(robot.pose.heading))),
        robot.length,
        ROBOT.tick * len(ticks_ms),
        tuple(ticks_ms),
    )


def run_trial(seed: int, trial: int, landmarks: int) -> dict[str, Outcome] | None:
    """All drivers on one task; None if no admissible path exists."""
    task = draw_task(np.random.default_rng([seed, trial, landmarks]), landmarks)
    if shortest_length(task) is None:
        return None
    return {name: park(name, task, np.random.default_rng([seed, trial, landmarks, 1])) for name in DRIVERS}


def summary(outcomes: list[Outcome], reference: list[Outcome]) -> dict[str, float]:
    """The figures of one driver; lengths compared with those of the servo that knows depths."""
    arrived = [(o, r) for o, r in zip(outcomes, reference, strict=True) if o.arrived and r.arrived]
    ticks = np.concatenate([o.ticks_ms for o in outcomes])
    errors_m, errors_deg = [o.error_m for o in outcomes], [o.error_deg for o in outcomes]
    ratios = [o.length_m / max(r.length_m, 0.1) for o, r in arrived]
    figures = {
        "success": np.mean([o.success(0.01) for o in outcomes]),
        "success_2cm": np.mean([o.success(0.02) for o in outcomes]),
        "arrived": np.mean([o.arrived for o in outcomes]),
        "fov_violations": sum(o.violated for o in outcomes),
        "error_m_median": np.median(errors_m),
        "error_m_p95": np.percentile(errors_m, 95),
        "error_deg_median": np.median(errors_deg),
        "error_deg_p95": np.percentile(errors_deg, 95),
        "path_over_servo_median": np.median(ratios) if ratios else math.nan,
        "time_s_median": np.median([o.time_s for o in outcomes]),
        "tick_ms": ticks.mean(),
        "tick_ms_p99": np.percentile(ticks, 99),
    }
    return {key: round(float(value), 4) for key, value in figures.items()}


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.appearance", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--trials", type=int, default=50, help="starts drawn (default 50)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--landmarks", type=int, nargs="+", default=[12, 60], help="in the goal's view")
    parser.add_argument("--jobs", type=int, default=1, help="processes; more than cores spoils tick_ms")
    parser.add_argument("--json", action="store_true", help="last line of output: one JSON object")
    arguments = parser.parse_args()
    if min(arguments.trials, arguments.jobs) < 1 or min(arguments.landmarks) < 6 or arguments.seed < 0:
        parser.error("at least one trial and job, at least 6 landmarks, and seed 0 or more are needed")
    console = Console(stderr=arguments.json)
    result: dict[str, dict[str, dict[str, float]]] = {name: {} for name in DRIVERS}
    counts: dict[str, int] = {}
    with ProcessPoolExecutor(arguments.jobs) as pool:
        for landmarks in arguments.landmarks:
            n = arguments.trials
            results = pool.map(run_trial, [arguments.seed] * n, range(n), [landmarks] * n)
            title = f"parking at {landmarks} bearings"
            run = [t for t in track(results, title, total=n, console=console) if t is not None]
            counts[str(landmarks)] = len(run)
            if not run:
                continue
            reference = [t["servo_with_depths"] for t in run]
            for name in DRIVERS:
                result[name][str(landmarks)] = summary([t[name] for t in run], reference)
            table = Table("figure", *DRIVERS, title=f"{landmarks} landmarks, {len(run)} starts")
            for key in result["appearance"][str(landmarks)]:
                table.add_row(key, *(f"{result[name][str(landmarks)][key]:g}" for name in DRIVERS))
            console.print(table)
    if arguments.json:
        ours = result.pop("appearance")
        keys = next(iter(ours.values()), {})
        turned = {key: {size: figures[key] for size, figures in ours.items()} for key in keys}
        print(json.dumps({"trials": counts, **turned, "rivals": result}))

"""How well the servo parks on an exact unicycle: success, errors, detours, switches and time a tick.

    python -m benchmarks.servo [--trials N] [--seed N] [--jobs N] [--json]

Twelve landmarks 1.5-5 m ahead of the goal, of which at least four must stay in view at every instant (judged
ten times a tick); horizontal semi-aperture 30 degrees; 0.5 px noise on every pixel, 2 % on the wheels; a pose
filter in between. A trial succeeds if the robot says that it has arrived within 60 s, stands within 1 cm and
1 degree, and never had fewer than four landmarks in view. Starts from which an independent planner finds no
admissible path are left out and counted. Greedy switching and a pursuit that ignores the field of view run on
the same trials.
"""

import json
import math
import time
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np
from rich.console import Console
from rich.progress import track

from benchmarks.command_line import at_least, command_line, figure_table
from benchmarks.servo.planner import shortest_length
from benchmarks.servo.rivals import CONTROLLERS
from benchmarks.servo.world import LEAST_VISIBLE, ROBOT, PoseFilter, Task, Unicycle, draw_task
from mapweave.hybridmap.pose import wrap_angle

_TIME_LIMIT = 60.0
_POSITION, _HEADING = 0.01, math.radians(1.0)


@dataclass(frozen=True)
class ServoOutcome:
    """One controller on one task; `ticks_ms` are the times of its calls, the first with its start."""

    arrived: bool
    success: bool
    violated: bool
    error_m: float
    error_deg: float
    path_ratio: float
    switches: int
    time_s: float
    start_ms: float
    ticks_ms: tuple[float, ...]


def park(name: str, task: Task, shortest: float, rng: np.random.Generator) -> ServoOutcome:
    """Run one controller on one task."""
    robot, filter_ = Unicycle(task), PoseFilter(task, rng)
    visible = filter_.see(robot.pose)
    before = time.perf_counter()
    controller = CONTROLLERS[name](filter_.pose, task.points)
    start_ms = 1e3 * (time.perf_counter() - before)
    ticks_ms = []
    arrived = False
    for _ in range(round(_TIME_LIMIT / ROBOT.tick)):
        before = time.perf_counter()
        command = controller.command(filter_.pose, task.points, visible)
        ticks_ms.append(1e3 * (time.perf_counter() - before))
        if command is None:
            arrived = True
            break
        filter_.move(*robot.drive(command))
        visible = filter_.see(robot.pose)
    error_m, error = math.hypot(robot.pose.x, robot.pose.y), abs(wrap_angle(robot.pose.heading))
    violated = robot.least_visible < LEAST_VISIBLE
    return ServoOutcome(
        arrived,
        arrived and not violated and error_m <= _POSITION and error <= _HEADING,
        violated,
        error_m,
        math.degrees(error),
        robot.length / shortest,
        controller.switches,
        ROBOT.tick * len(ticks_ms),
        start_ms,
        tuple(ticks_ms),
    )


def run_trial(seed: int, trial: int) -> dict[str, ServoOutcome] | None:
    """All controllers on one task; None if no admissible path exists."""
    task = draw_task(np.random.default_rng([seed, trial]))
    shortest = shortest_length(task)
    if shortest is None:
        return None
    return {name: park(name, task, shortest, np.random.default_rng([seed, trial, 1])) for name in CONTROLLERS}


def summary(outcomes: list[ServoOutcome]) -> dict[str, float]:
    """The figures of one controller. Errors are over all trials; ratio, time over those that succeeded."""
    good = [o for o in outcomes if o.success]
    ticks = np.concatenate([o.ticks_ms for o in outcomes])

    def percentile(values: Iterable[float], q: float) -> float:
        listed = list(values)
        return round(float(np.percentile(listed, q)), 4) if listed else math.nan

    return {
        "success": round(len(good) / len(outcomes), 4),
        "arrived": round(sum(o.arrived for o in outcomes) / len(outcomes), 4),
        "fov_violations": sum(o.violated for o in outcomes),
        "error_m_p95": percentile((o.error_m for o in outcomes), 95),
        "error_deg_p95": percentile((o.error_deg for o in outcomes), 95),
        "path_ratio_median": percentile((o.path_ratio for o in good), 50),
        "path_ratio_p95": percentile((o.path_ratio for o in good), 95),
        "switches_p95": percentile((o.switches for o in outcomes), 95),
        "time_s_median": percentile((o.time_s for o in good), 50),
        "tick_ms": round(float(ticks.mean()), 3),
        "tick_ms_p99": percentile(ticks.tolist(), 99),
        "tick_ms_max": round(float(ticks.max()), 2),
        "start_ms_max": round(max(o.start_ms for o in outcomes), 1),
    }


def main() -> None:
    """Run and print."""
    parser = command_line("servo", __doc__)
    parser.add_argument("--trials", type=at_least(1), default=200, help="starts drawn (default 200)")
    parser.add_argument(
        "--jobs", type=at_least(1), default=1, help="processes; more than cores spoils tick_ms"
    )
    arguments = parser.parse_args()
    console = Console(stderr=arguments.json)
    with ProcessPoolExecutor(arguments.jobs) as pool:
        results = pool.map(
            run_trial, [arguments.seed] * arguments.trials, range(arguments.trials), chunksize=4
        )
        trials = list(track(results, "parking", total=arguments.trials, console=console))
    run = [t for t in trials if t is not None]
    figures = {name: summary([t[name] for t in run]) for name in CONTROLLERS} if run else {}
    title = f"{len(run)} starts, {len(trials) - len(run)} without a path"
    console.print(figure_table(figures, title, "{:g}".format))
    if arguments.json:
        ours = figures.pop("servo", {})
        print(json.dumps({"trials": len(run), "left_out": len(trials) - len(run), **ours, "rivals": figures}))

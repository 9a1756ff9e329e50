"""Merging in the simulator, from the first image to the merged map: how right, and how much of it is found.

    python -m benchmarks.merge_sim [--runs N] [--seed N] [--workers N] [--scenarios NAME ...] [--json]

Each run is a whole trial (`mapweave sim run NAME --one-process`): robots that explore, a server that merges
while they do, and the truth, which only the score uses. Run k has the seed 1000 * SEED + k, so each
can be looked at by itself with `mapweave sim run NAME --seed ...`.

| scenario | what |
|---|---|
| office | three robots in three rooms; their maps should become one |
| twin-rooms | two robots in two closed rooms that look exactly alike; nothing may be joined |
| twin-corridor | the same rooms open onto a corridor that is like nothing else |
| warehouse | three robots between rows of alike racks |

`merged_ate_m_median`: error of the merged map's nodes after one rigid alignment a component. `components`: of
the merged map, median; `whole`: share of the runs that became one map. `false_merges`: pairs of maps that
ended up joined wrongly (by more than 0.5 m or 15 degrees), of all runs; `false_links`: links that are off by
as much. `link_recall` is the share of the chances to join a node's place to another map's that are taken, as
`mapweave sim run` has it (median); null where no two maps share a place. Each figure is an object by
scenario.

A run takes one to three minutes on a core of its own; 10 runs of all four scenarios on two cores 35 to 50
minutes. A run that fails or is killed is reported, is under `failed`, and makes the exit status 1.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import threading
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from benchmarks.command_line import at_least, command_line, figure_table
from benchmarks.merge_sim.run import MergeRun

SCENARIOS: dict[str, tuple[str, ...]] = {
    "office": ("office",),
    "twin-rooms": ("twin-rooms",),
    "twin-corridor": ("twin-rooms", "--set", "name=twin-corridor", "--set", "world.joined=true"),
    "warehouse": ("warehouse",),
}
"""Arguments of a run: a scenario, and what is set otherwise in it."""
LONGEST = 1800.0
"""A run that takes longer is killed, wall s."""
SEEDS_APART = 1000
"""Two seeds share no run with up to as many runs."""


@dataclass(frozen=True)
class Failure:
    """A run that did not come to its end.

    Attributes:
        scenario: its name.
        seed: of everything.
        reason: in one line.
    """

    scenario: str
    seed: int
    reason: str


class RunPool:
    """Runs in processes of their own; those under way can be ended."""

    def __init__(self) -> None:
        """None yet."""
        self._lock = threading.Lock()
        self._under_way: set[subprocess.Popen[str]] = set()
        self._ended = False

    def run(self, name: str, seed: int) -> MergeRun | Failure:
        """Run one and wait for it."""
        scenario, *overrides = SCENARIOS[name]
        command = [sys.executable, "-m", "benchmarks.merge_sim.run", scenario, str(seed), *overrides]
        single = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
        with self._lock:
            if self._ended:
                return Failure(name, seed, "was not begun")
            process = subprocess.Popen(
                command,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                env={**os.environ, **single},
            )
            self._under_way.add(process)
        try:
            out, said = process.communicate(timeout=LONGEST)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            return Failure(name, seed, f"was killed after {LONGEST / 60.0:.0f} minutes")
        finally:
            with self._lock:
                self._under_way.discard(process)
        return outcome(name, seed, process.returncode, out, said)

    def end(self) -> None:
        """End all that is under way, and begin nothing more."""
        with self._lock:
            self._ended = True
            for process in self._under_way:
                process.kill()


def outcome(name: str, seed: int, status: int, out: str, said: str) -> MergeRun | Failure:
    """What a process that has ended says of its run."""
    if status < 0:
        return Failure(name, seed, f"was killed by signal {-status}")
    lines = [line for line in said.splitlines() if line.strip()]
    if status > 0:
        return Failure(name, seed, lines[-1] if lines else f"ended with status {status}")
    try:
        return MergeRun(**json.loads(out.splitlines()[-1]))
    except (IndexError, TypeError, ValueError):
        return Failure(name, seed, "said nothing that can be read")


def figures(runs: Sequence[MergeRun]) -> dict[str, float | None]:
    """The figures of some runs of one scenario."""
    errors = [run.merged_ate_m for run in runs if run.merged_ate_m is not None]
    recalls = [run.link_recall for run in runs if run.link_recall is not None]
    return {
        "merged_ate_m_median": _median(errors),
        "merged_ate_m_worst": max(errors, default=None),
        "components": _median([run.components for run in runs]),
        "whole": sum(run.components == 1 for run in runs) / len(runs) if runs else None,
        "false_merges": sum(run.false_merges for run in runs) if runs else None,
        "links": sum(run.links for run in runs) if runs else None,
        "false_links": sum(run.false_links for run in runs) if runs else None,
        "link_recall": _median(recalls),
        "wall_s": _median([run.wall_s for run in runs]),
    }


def summary(seed: int, names: Iterable[str], results: Sequence[MergeRun | Failure]) -> dict[str, Any]:
    """All figures, for JSON: each by scenario; then each run, and what failed."""
    done = [one for one in results if isinstance(one, MergeRun)]
    by_name = {name: figures([run for run in done if run.scenario == name]) for name in names}
    columns = {figure: {name: by_name[name][figure] for name in by_name} for figure in figures([])}
    rounded = {
        figure: {name: None if value is None else round(value, 4) for name, value in column.items()}
        for figure, column in columns.items()
    }
    return {
        "seed": seed,
        "runs": {name: sum(run.scenario == name for run in done) for name in by_name},
        **rounded,
        "failed": [vars(one) for one in results if isinstance(one, Failure)],
        "each": [vars(run) for run in done],
    }


def measure(
    names: Sequence[str], runs: int, seed: int, workers: int, console: Console
) -> list[MergeRun | Failure]:
    """Run all, some at a time; what fails is said at once."""
    # One of each in turn: a benchmark that is stopped early has seen something of all.
    wanted = [(name, SEEDS_APART * seed + k) for k in range(runs) for name in names]
    results: dict[tuple[str, int], MergeRun | Failure] = {}
    runner = RunPool()
    columns = (
        TextColumn("{task.description}"), BarColumn(bar_width=30), MofNCompleteColumn(), TimeElapsedColumn(),
    )  # fmt: skip
    with Progress(*columns, console=console) as progress, ThreadPoolExecutor(workers) as pool:
        whole = progress.add_task("runs", total=len(wanted))

        def one(name: str, number: int) -> None:
            task = progress.add_task(f"  {name}, seed {number}", total=None)
            found = results[name, number] = runner.run(name, number)
            progress.remove_task(task)
            progress.advance(whole)
            if isinstance(found, Failure):
                progress.console.print(f"{name}, seed {number}: {found.reason}", highlight=False)

        try:
            for future in [pool.submit(one, *each) for each in wanted]:
                future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            runner.end()
            raise
    return [results[each] for each in sorted(wanted, key=lambda each: (names.index(each[0]), each[1]))]


def table(found: dict[str, Any]) -> Table:
    """A table for people."""
    shown = ("runs", *figures([]))
    columns = {name: {figure: found[figure][name] for figure in shown} for name in found["runs"]}
    title = f"merging in the simulator, seed {found['seed']}"
    return figure_table(columns, title, lambda value: "-" if value is None else f"{value:.4g}")


def main() -> None:
    """Run, score and print."""
    arguments = _arguments()
    console = Console(stderr=True)
    try:
        results = measure(arguments.scenarios, arguments.runs, arguments.seed, arguments.workers, console)
    except KeyboardInterrupt:
        print("merge_sim: stopped; no figures", file=sys.stderr)
        raise SystemExit(130) from None
    found = summary(arguments.seed, arguments.scenarios, results)
    Console(stderr=arguments.json).print(table(found))
    for failure in found["failed"]:
        print("merge_sim: {scenario}, seed {seed}: {reason}".format(**failure), file=sys.stderr)
    if arguments.json:
        print(json.dumps(found))
    if found["failed"]:
        raise SystemExit(1)


def _median(values: Sequence[float]) -> float | None:
    return statistics.median(values) if values else None


def _arguments() -> argparse.Namespace:
    parser = command_line("merge_sim", __doc__, "run k has the seed 1000 * SEED + k", whole=True)
    parser.add_argument("--runs", type=int, default=10, help="of each scenario (default 10)")
    parser.add_argument(
        "--workers", type=at_least(1), default=2, help="runs at a time, some 500 MB each (default 2)"
    )
    parser.add_argument(
        "--scenarios", nargs="+", choices=list(SCENARIOS), default=list(SCENARIOS), help="(default: all)"
    )
    arguments = parser.parse_args()
    if not 1 <= arguments.runs <= SEEDS_APART:
        parser.error(f"--runs is 1 to {SEEDS_APART}")
    arguments.scenarios = list(dict.fromkeys(arguments.scenarios))
    return arguments

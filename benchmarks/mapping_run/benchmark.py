"""The paper's mapping run (Figures 7 and 8) from the simulator's camera, with the truth beside it.

    python -m benchmarks.mapping_run [--seed N] [--out DIR] [--world arena|office] [--json]

50 s at 10 Hz back and forth before a wall: rendered pictures, SIFT features, Lucas-Kanade tracks and the
mapping EKF, as a robot runs them. First the paper's line; the same again while a person walks past; then an
arc and a weave. Each run is compared with the simulator's pose and with the wheels alone, and each
landmark, as it was known last, with where the ray of its first pixel meets the world. Pictures of the line
lie in DIR, those of the other runs in folders below it: fig7 pose, fig8 encoders, landmarks, map, view.
"""

import argparse
import json
import os
from functools import partial
from pathlib import Path

# numpy reads it when it is imported. One thread for algebra and images, as in Mapweave's own processes.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from benchmarks.command_line import command_line, failing_in_one_line, figure_table
from benchmarks.mapping_run.figures import draw
from benchmarks.mapping_run.scene import drive
from benchmarks.mapping_run.score import Figures, figures
from mapweave.hybridmap.errors import InvalidValue

RUNS = {"line": ("line", False), "person": ("line", True), "arc": ("arc", False), "weave": ("weave", False)}
"""Shape of the drive, and whether a person walks past, by name of the run."""
LEAST_STEPS = 30


def main() -> None:
    """Run, draw and print."""
    arguments = _arguments()
    cv2.setNumThreads(1)
    console = Console(stderr=arguments.json)
    with failing_in_one_line("mapping_run"):
        results, abandoned = _run(arguments, console)
    console.print(figure_table(results, f"seed {arguments.seed}, {arguments.world}", _shown))
    for note in notes(results, abandoned):
        console.print(note)
    console.print(f"pictures are in {arguments.out}")
    if arguments.json:
        by_figure = {
            key: {name: _rounded(one[key]) for name, one in results.items()}
            for key in next(iter(results.values()))
        }
        print(json.dumps({"seed": arguments.seed, "abandoned": abandoned, **by_figure}))


def _arguments() -> argparse.Namespace:
    parser = command_line("mapping_run", __doc__, "of world, start, wheels and camera")
    parser.add_argument("--out", type=Path, default=Path("out/mapping_run"), help="folder of the pictures")
    parser.add_argument("--world", choices=("arena", "office"), default="arena")
    parser.add_argument("--steps", type=int, default=500, help="ticks of 0.1 s a run (default 500)")
    parser.add_argument(
        "--runs", nargs="+", choices=tuple(RUNS), default=tuple(RUNS), help="which (default all)"
    )
    return parser.parse_args()


def _run(arguments: argparse.Namespace, console: Console) -> tuple[dict[str, Figures], dict[str, str]]:
    """Figures of each run, and why its robot would have given it up; pictures are written meanwhile."""
    if arguments.steps < LEAST_STEPS:
        raise InvalidValue(f"--steps {arguments.steps} is too short for a drive: at least {LEAST_STEPS}")
    folders = {name: arguments.out if name == "line" else arguments.out / name for name in arguments.runs}
    for folder in folders.values():
        _make(folder)
    results, abandoned = {}, {}
    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console) as progress:
        for name, folder in folders.items():
            shape, person = RUNS[name]
            task = progress.add_task(name, total=arguments.steps)
            run = drive(
                arguments.seed, arguments.world, shape, arguments.steps, person,
                partial(progress.advance, task),
            )  # fmt: skip
            progress.update(task, completed=arguments.steps)
            results[name], abandoned[name] = figures(run), run.given_up
            draw(run, folder)
    return results, abandoned


def notes(results: dict[str, Figures], abandoned: dict[str, str]) -> list[str]:
    """What a reader must know before he compares the runs."""
    notes = []
    for name, one in results.items():
        if abandoned[name]:
            reason = abandoned[name]
            notes.append(f"{name}: the robot would have dropped this episode ({reason}); it was ended there")
        if RUNS[name][1] and not one["person_in_view_s"]:
            notes.append(f"{name}: no person came into view, there was no room ahead; take another seed")
        if not one["landmarks_left"]:
            notes.append(
                f"{name}: no landmark was left at the end; since the last the wheels were trusted alone"
            )
    return notes


def _make(folder: Path) -> None:
    """Make a folder, before anything takes long.

    Raises:
        InvalidValue: it cannot be made, or nothing can be written into it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".probe"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise InvalidValue(f"--out {folder}: {error.strerror}; name a folder that can be written") from None


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 5)


def _shown(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}".rstrip("0").rstrip(".")

"""How well points are tracked: plain Lucas-Kanade, checked backward, and held to where they were first seen.

    python -m benchmarks.tracking [--drives N] [--frames N] [--seed N] [--json]

Each drive approaches and retreats by half a metre with a weaving heading, at 10 Hz. Half of them go before
photographs on slanted walls (blur, gamma, changing light, noise), half through simulated rooms (the
simulator's four cameras). SIFT features of the first image are followed without any expectation, by three
trackers side by side, and compared with the truth: `rms_px` by age in frames and over all, of tracks less
than 3 px off; `wrong`, the share of the others; `lost`, the share of points that were in view all the time
and are not tracked at the end; `ms` a frame, median, with `points` tracked on average.
"""

from __future__ import annotations

import json
import os
import sys
import time
from dataclasses import dataclass
from typing import Any, Protocol

# numpy reads it when it is imported. One thread for algebra and images, as in Mapweave's own processes.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks.command_line import command_line
from benchmarks.tracking.scenes import Drive, drives
from mapweave.agent.settings import TrackerSettings
from mapweave.agent.vision.tracker import BORDER_PX, LEVELS, Tracker
from mapweave.hybridmap.pose import Array
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Sift

AGES = (1, 10, 20, 40, 80, 159)
WRONG_PX = 3.0
SCENES = ("walls", "rooms")
LEAST_FRAMES = 12


class Follower(Protocol):
    """What follows points: mapweave.agent.vision.tracker.Tracker, or a rival."""

    ids: NDArray[np.int64]
    raw: Array

    def track(self, image: NDArray[np.uint8]) -> object:
        """Follow all points into the next image."""

    def add(self, ids: NDArray[np.int64], raw: Array) -> None:
        """Follow points of the last image."""


class PlainFlow:
    """Lucas-Kanade as OpenCV has it, in the windows of our tracker: what it says is believed."""

    def __init__(self) -> None:
        """Start with no points."""
        self.ids: NDArray[np.int64] = np.zeros(0, np.int64)
        self.raw: Array = np.zeros((0, 2))
        self._image: NDArray[np.uint8] | None = None

    def track(self, image: NDArray[np.uint8]) -> None:
        """Follow all points into the next image."""
        before, self._image = self._image, image
        if before is None or not len(self.ids):
            return
        s = TrackerSettings()
        start = self.raw.astype(np.float32)[:, None]
        there, found, _ = cv2.calcOpticalFlowPyrLK(
            before, image, start, start.copy(), winSize=(s.window_px, s.window_px), maxLevel=LEVELS,
            criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.02),
        )  # fmt: skip
        inside = (there[:, 0] >= BORDER_PX) & (there[:, 0] < np.array(image.shape[::-1]) - BORDER_PX)
        kept = (found[:, 0] == 1) & inside.all(axis=1)
        self.ids, self.raw = self.ids[kept], there[kept, 0].astype(np.float64)

    def add(self, ids: NDArray[np.int64], raw: Array) -> None:
        """Follow points of the last image."""
        self.ids, self.raw = ids.copy(), raw.copy()


def followers(lens: Lens) -> dict[str, Follower]:
    """The trackers that are compared, by name."""
    return {
        "plain": PlainFlow(),
        "checked": Tracker(lens, TrackerSettings(anchored=False)),
        "held": Tracker(lens, TrackerSettings()),
    }


@dataclass(frozen=True, eq=False)
class Outcome:
    """One tracker on one drive.

    Attributes:
        errors_px: (T, N) from the truth, NaN where a point is not tracked or has no truth.
        in_view: (N,) whether the point was in view all the time.
        tracked: (T, N) whether it is tracked.
        ms: (T - 1,) time of a frame.
    """

    errors_px: Array
    in_view: NDArray[np.bool_]
    tracked: NDArray[np.bool_]
    ms: Array


def follow(drive: Drive) -> dict[str, Outcome]:
    """All trackers over one drive, frame by frame in turn."""
    lens = Lens(drive.description.camera, drive.description.distortion)
    features = Sift(lens).extract(drive.images[0])
    truth = drive.truth(features.pixels)
    runners = followers(lens)
    shape = truth.shape[:2]
    errors = {name: np.full(shape, np.nan) for name in runners}
    tracked = {name: np.zeros(shape, np.bool_) for name in runners}
    ms = {name: np.zeros(shape[0] - 1) for name in runners}
    for name, runner in runners.items():
        runner.track(drive.images[0])
        runner.add(np.arange(len(features), dtype=np.int64), features.raw)
        tracked[name][0] = True
    for k, image in enumerate(drive.images[1:], start=1):
        for name, runner in runners.items():
            began = time.perf_counter()
            runner.track(image)
            ms[name][k - 1] = 1e3 * (time.perf_counter() - began)
            tracked[name][k, runner.ids] = True
            away = lens.undistort(runner.raw) - truth[k, runner.ids]
            errors[name][k, runner.ids] = np.linalg.norm(away, axis=1)
    in_view = np.asarray(np.isfinite(truth).all(axis=(0, 2)))
    return {name: Outcome(errors[name], in_view, tracked[name], ms[name]) for name in runners}


def figures(outcomes: list[Outcome]) -> dict[str, Any]:
    """The figures of one tracker in one kind of scene."""
    rows = [np.concatenate([o.errors_px[k] for o in outcomes]) for k in range(len(outcomes[0].errors_px))]
    seen = np.concatenate([row[np.isfinite(row)] for row in rows[1:]])
    lasting = np.concatenate([o.tracked[-1, o.in_view] for o in outcomes])
    return {
        "rms_px": {str(age): _rms(rows[age]) for age in AGES if age < len(rows)},
        "rms_all_px": _rms(seen),
        "median_px": _rounded(np.median(seen)) if len(seen) else None,
        "wrong": _rounded(np.mean(seen > WRONG_PX)) if len(seen) else None,
        "lost": _rounded(1.0 - lasting.mean()) if len(lasting) else None,
        "points": _rounded(np.mean([o.tracked[1:].sum(axis=1).mean() for o in outcomes])),
        "ms": _rounded(np.median(np.concatenate([o.ms for o in outcomes]))),
    }


def _rms(errors: Array) -> float | None:
    right = errors[errors <= WRONG_PX]
    return _rounded(np.sqrt(np.mean(right**2))) if len(right) else None


def _rounded(value: np.floating[Any] | float) -> float:
    return round(float(value), 4)


def measure(seed: int, count: int, frames: int, console: Console) -> dict[str, Any]:
    """All figures, by scene and tracker."""
    by_scene: dict[str, dict[str, list[Outcome]]] = {scene: {} for scene in SCENES}
    for scene, drive in track(drives(seed, count, frames), "drives", total=2 * count, console=console):
        for name, outcome in follow(drive).items():
            by_scene[scene].setdefault(name, []).append(outcome)
    return {
        scene: {name: figures(outcomes) for name, outcomes in by_name.items()}
        for scene, by_name in by_scene.items()
    }


def table(scene: str, result: dict[str, Any]) -> Table:
    """For people."""
    shown = Table("figure", *result, title=scene)
    for key, first in next(iter(result.values())).items():
        if isinstance(first, dict):
            for age in first:
                shown.add_row(f"{key} after {age}", *(f"{one[key][age]}" for one in result.values()))
        else:
            shown.add_row(key, *(f"{one[key]}" for one in result.values()))
    return shown


def main() -> None:
    """Run and print."""
    parser = command_line("tracking", __doc__, "changes scenes and ways", whole=True)
    parser.add_argument("--drives", type=int, default=8, help="of each kind of scene (default 8)")
    parser.add_argument("--frames", type=int, default=160, help="of a drive (default 160)")
    arguments = parser.parse_args()
    if arguments.drives < 1 or arguments.frames < LEAST_FRAMES:
        print(f"tracking: at least 1 drive, {LEAST_FRAMES} frames and seed 0 are needed", file=sys.stderr)
        raise SystemExit(1)
    cv2.setNumThreads(1)
    console = Console(stderr=arguments.json)
    result = measure(arguments.seed, arguments.drives, arguments.frames, console)
    for scene in SCENES:
        console.print(table(scene, result[scene]))
    if arguments.json:
        asked = {"seed": arguments.seed, "drives": arguments.drives, "frames": arguments.frames}
        print(json.dumps({**asked, **result}))

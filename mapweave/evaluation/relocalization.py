"""Examine a recording by what it holds: two robots with odometry, or photographs and what each shows."""

import csv
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from mapweave.agent.drivers.replay import Replay
from mapweave.agent.recordings.camera_file import read_camera
from mapweave.agent.recordings.image_folder import images_of
from mapweave.agent.recordings.splits import robots_of
from mapweave.agent.settings import AgentSettings
from mapweave.evaluation.asking_again import LostDrive, trial_figures
from mapweave.evaluation.drive import DriveMap
from mapweave.evaluation.photographs import AppearanceMap, Photographs, photograph_trials, step_of
from mapweave.evaluation.pieces import check_folder, say
from mapweave.evaluation.truth import Truth
from mapweave.evaluation.verdict import JudgedAnswer, figures
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import DeviceError
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.storage.image_file import read_grey
from mapweave.terminal import tracked
from mapweave.vision.lens import NO_DISTORTION, Distortion

STAND_IN_HEIGHT = 0.8
"""Of a camera of which only the focal length is known, m: bearings do not depend on it."""


@dataclass(frozen=True)
class RelocalizationEvaluation:
    """What came of it.

    Attributes:
        about: the recording, in figures.
        verified: how places were verified: by `depths`, or by their `looks`.
        verdicts: of each question.
        trials: of robots that ask again while they drive.
    """

    about: dict[str, Any]
    verified: str
    verdicts: list[JudgedAnswer]
    trials: list[LostDrive]

    def report(self) -> dict[str, Any]:
        """All figures, for `json.dumps`."""
        return {
            **self.about, "verified": self.verified, **figures(self.verdicts), **trial_figures(self.trials),
        }  # fmt: skip

    def write(self, folder: Path) -> list[Path]:
        """A table of the verdicts; returns where."""
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"answers-{self.verified}.csv"
        with path.open("w", newline="", encoding="utf-8") as file:
            rows = [asdict(verdict) for verdict in self.verdicts]
            table = csv.DictWriter(file, list(rows[0]) if rows else ["query"])
            table.writeheader()
            table.writerows(rows)
        return [path]


def evaluate_relocalization(
    folder: Path,
    camera_file: Path | None,
    focal_px: float | None,
    settings: AgentSettings,
    console: Console,
) -> RelocalizationEvaluation:
    """Map from one pass, ask from the others.

    Args:
        folder: the recording.
        camera_file: another than its camera.toml, for photographs.
        focal_px: instead of either, for photographs.
        settings: of the pipeline that maps a drive.
        console: shows progress.

    Raises:
        DeviceError: the folder lacks what is needed, or a file is wrong.
    """
    check_folder(folder, "images/, and odometry.csv and splits.toml or lap_truth.csv")
    if (folder / "odometry.csv").exists() and (folder / "splits.toml").exists():
        if camera_file is not None or focal_px is not None:
            raise DeviceError(f"{folder}: a drive has its camera.toml; leave --camera and --focal out")
        return _examine_drive(folder, settings, console)
    if (folder / "lap_truth.csv").exists():
        return _examine_photographs(folder, camera_file, focal_px, console)
    raise DeviceError(
        f"{folder}: two passes cannot be told apart; a folder with images/ needs odometry.csv and "
        "splits.toml with two robots, or lap_truth.csv. Other recordings cannot be scored"
    )


def _examine_drive(folder: Path, settings: AgentSettings, console: Console) -> RelocalizationEvaluation:
    names = robots_of(folder / "splits.toml")
    if len(names) < 2:
        raise DeviceError(
            f"{folder / 'splits.toml'}: one robot maps, another asks; there is only {len(names)}"
        )
    truth = Truth.read(folder / "truth.csv")
    mapping, asking = Replay(folder, names[0]), [Replay(folder, name) for name in names[1:]]
    say(mapping.recording.notes, console)
    ticks = tracked(range(len(mapping)), f"{names[0]} maps", console=console)
    drive = DriveMap.of_pass(mapping, truth, settings, ticks)
    evaluation = _ask(folder, drive, asking, truth, console)
    say((line for robot in (mapping, *asking) for line in robot.damage), console)
    return evaluation


def evaluate_map(
    folder: Path, robot: str | None, merged: MergedMap, console: Console
) -> RelocalizationEvaluation:
    """Ask a map that is there where each image of a drive was taken.

    Args:
        folder: the recording of the drive, with odometry. Its truth.csv tells also where the map's nodes are,
            by their stamps; without it nothing is scored.
        robot: one of its splits.toml; None: the whole recording.
        merged: the map.
        console: shows progress.

    Raises:
        DeviceError: the folder lacks what is needed, or a file is wrong.
    """
    truth = Truth.read(folder / "truth.csv")
    asking = Replay(folder, robot)
    say(asking.recording.notes, console)
    evaluation = _ask(folder, DriveMap.of_map(merged, truth), [asking], truth, console)
    say(asking.damage, console)
    return evaluation


def _ask(
    folder: Path, drive: DriveMap, asking: Sequence[Replay], truth: Truth, console: Console
) -> RelocalizationEvaluation:
    questions = (verdict for robot in asking for verdict in drive.questions(robot))
    verdicts = list(tracked(questions, "asking", total=sum(map(len, asking)), console=console))
    about = {"folder": folder.name, "nodes": drive.nodes, "truth": bool(truth.poses)}
    return RelocalizationEvaluation(about, "depths", verdicts, drive.trials)


def _examine_photographs(
    folder: Path, camera_file: Path | None, focal_px: float | None, console: Console
) -> RelocalizationEvaluation:
    photographs = Photographs(folder)
    camera, distortion = _camera_of(folder, camera_file, focal_px)
    places = AppearanceMap(camera, distortion, step_of(photographs.places))
    for number, image in tracked(list(photographs.places.items()), "first pass", console=console):
        places.add(number, image)
    verdicts = [
        places.ask(number, image, photographs.references[number])
        for number, image in tracked(list(photographs.questions.items()), "questions", console=console)
    ]
    about = {"folder": folder.name, "nodes": len(photographs.places), "focal_px": camera.fx}
    return RelocalizationEvaluation(about, "looks", verdicts, photograph_trials(verdicts))


def _camera_of(folder: Path, camera_file: Path | None, focal_px: float | None) -> tuple[Camera, Distortion]:
    if camera_file is not None and focal_px is not None:
        raise DeviceError("give --camera or --focal, not both")
    if focal_px is None:
        return read_camera(camera_file or folder / "camera.toml")
    first: Sequence[Path] = images_of(folder)[:1]
    height, width = read_grey(first[0]).shape
    middle = 0.5 * (width - 1), 0.5 * (height - 1)
    return Camera(width, height, focal_px, focal_px, *middle, STAND_IN_HEIGHT), NO_DISTORTION

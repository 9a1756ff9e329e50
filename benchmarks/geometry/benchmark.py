"""What a wrongly declared geometry costs a map, with online calibration.

    python -m benchmarks.geometry --recording FOLDER [--robot NAME] [--seed N] [--json]

The recording is replayed with the right geometry and with each parameter declared wrongly: camera 1 m too
far ahead, looking 2 degrees aside, 3 degrees down, wheels 5 % too large, 50 ms of delay. The right geometry
is the recording's own where nothing contradicts it, else what least squares over all of it show. The error
is that of the trajectory of all images against truth.csv after one rigid alignment; while the robot does not
know where it is the wheels lead on. error_ratio is the worst error over that with the right geometry,
wheels_ratio the worst error over that of dead reckoning by the wheels with the same declared geometry,
rpe_m and wheels_rpe_m the error of the motion over each metre, root mean square, diagnosed whether every
wrong parameter was named while mapping. When the wheels' scale is corrected, the map is scaled, and the
trajectory with it; a map that was left before keeps its own.

With --seed the wheels are simulated: the increments of truth.csv with 2 % of noise a step and 1 % a drive on
the way, 0.15 degrees a step and 0.01 degrees a step all along on the turn.
"""

import argparse
import json
import math
import os
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.command_line import failing_in_one_line
from mapweave.agent.calibration.correction import OdometryCorrection, declaring, geometry_of
from mapweave.agent.calibration.recorded_drive import calibrate
from mapweave.agent.calibration.report import Cause, causes
from mapweave.agent.drive_geometry import DriveGeometry, Parameter
from mapweave.agent.drivers.replay import Replay
from mapweave.agent.mission import Carried
from mapweave.agent.observation import RobotDescription
from mapweave.agent.pipeline import Pipeline
from mapweave.agent.recordings.recording import Recording
from mapweave.evaluation.replaying import errors
from mapweave.evaluation.truth import Truth
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.pose import Pose2

P = Parameter
WRONG = {
    "camera 1 m forward": (P.FORWARD, 1.0),
    "heading 2 deg": (P.HEADING, math.radians(2.0)),
    "pitch 3 deg": (P.PITCH, math.radians(3.0)),
    "wheel scale 5 %": (P.WHEEL_SCALE, math.log(1.05)),
    "delay 50 ms": (P.DELAY, 0.05),
}

SCALE, STEP_SHARE, STEP_TURN, DRIFT = 0.01, 0.02, math.radians(0.15), math.radians(0.01)
"""Standard deviations of drawn wheels: of a drive's scale, of a step's way as a share, of a step's turn, and
of a turn that is the same in each step, rad."""


@dataclass(frozen=True)
class ReplayResult:
    """One replay.

    Attributes:
        error: root mean square of the positions of all images, m.
        relative: root mean square error of the motion over each metre, m.
        wheels: the error by the wheels alone, with what is declared of them, m.
        relative_wheels: the same of the relative one.
        used: share of the images that were mapped with.
        nodes: in all maps.
        maps: how many were begun.
        causes: that were named.
    """

    error: float
    relative: float
    wheels: float
    relative_wheels: float
    used: float
    nodes: int
    maps: int
    causes: tuple[Cause, ...]


def replay(robot: Replay, description: RobotDescription, truth: Truth, lever: float) -> ReplayResult:
    """Map a recording as an agent does.

    Args:
        robot: the recording, at its beginning.
        description: what is declared of it.
        truth: of the camera, for scoring alone.
        lever: m, of the camera ahead of the axle in truth.
    """
    pipeline = Pipeline(MapId("map", 1), description)
    pipeline.set_mission(Carried())
    here, first_from_map, maps, nodes, used = Pose2(), Pose2(), 1, 0, 0
    reckoned, correction, declared = Pose2(), OdometryCorrection(), geometry_of(description)
    mapped, by_wheels, true = list[Pose2](), list[Pose2](), list[Pose2]()
    count = begun = 0
    while (observation := robot.sense()) is not None:
        count += 1
        here = here @ observation.odometry.motion()
        reckoned = reckoned @ correction.step(observation, declared).odometry.motion()
        if pipeline.lost:
            # As an agent does: the next map begins where the wheels have brought the robot.
            nodes += len(pipeline.map.nodes)
            maps += 1
            pipeline = Pipeline(MapId("map", maps), description, calibration=pipeline.calibration)
            pipeline.set_mission(Carried())
            first_from_map, begun = here, len(mapped)
        step = pipeline.step(observation)
        status = step.status
        if step.way_moved is not None:
            moved = step.way_moved.seen_from(first_from_map)
            # Maps that were left before keep their lengths, and end where this one begins.
            along = moved.apply(first_from_map) @ first_from_map.inverse()
            left = [along @ pose for pose in mapped[:begun]]
            mapped = left + [moved.apply(pose) for pose in mapped[begun:]]
        if not status.relocalizing and not pipeline.lost and status.doing != "standing still":
            here = first_from_map @ status.map_from_robot
            used += 1
        pose = truth.at(observation.stamp_ns)
        if pose is not None:
            mapped.append(here)
            by_wheels.append(reckoned)
            true.append(pose)
    if len(true) < 2:
        raise InvalidValue("the recording has no truth.csv for its images: there is no error to compute")
    pipeline.finish()
    nodes += len(pipeline.map.nodes)
    causes = tuple(pipeline.calibration.causes)
    scored = (*_errors(mapped, true, lever), *_errors(by_wheels, true, lever))
    return ReplayResult(*scored, used / count, nodes, maps, causes)


def _errors(robot: list[Pose2], camera: list[Pose2], lever: float) -> tuple[float, float]:
    """Error of (N,) positions after one rigid alignment, and of the motion over a metre, m."""
    at, there = (
        np.array([pose.vector for pose in poses])
        for poses in ([pose @ Pose2(lever) for pose in robot], camera)
    )
    absolute, relative, _ = errors(at, there, np.zeros(len(at)))
    return (math.nan if absolute is None else absolute), (math.nan if relative is None else relative)


def drawn_wheels(recording: Recording, truth: Truth, seed: int) -> Recording:
    """The recording with wheels simulated from the truth.

    Raises:
        InvalidValue: an image has no truth.
    """
    rng = np.random.default_rng(seed)
    poses = [pose for stamp in recording.stamps_ns if (pose := truth.at(int(stamp))) is not None]
    if len(poses) < len(recording):
        raise InvalidValue("truth.csv lacks some of the images: no wheels can be drawn from it")
    moved = [before.inverse() @ after for before, after in pairwise(poses)]
    way = (1.0 + SCALE * rng.normal()) * np.array([0.0, *(pose.x for pose in moved)])
    turn = np.array([0.0, *(pose.heading for pose in moved)])
    way *= 1.0 + STEP_SHARE * rng.normal(size=len(way))
    turn[1:] += STEP_TURN * rng.normal(size=len(moved)) + DRIFT * rng.normal()
    return replace(recording, increments=np.column_stack([way, turn]))


def right_geometry(robot: Replay, console: Console) -> DriveGeometry:
    """The recording's own, but for what the whole drive contradicts."""
    declared = geometry_of(robot.describe())
    estimate = calibrate(robot.describe(), iter(robot.sense, None)).estimate
    vector = declared.vector
    for cause in causes(estimate):
        vector[cause.parameter] = estimate.vector[cause.parameter]
        console.print(f"right geometry: {cause}")
    return DriveGeometry.of(vector)


def run(
    folder: Path, name: str | None, seed: int | None, only: list[str], console: Console
) -> dict[str, object]:
    """All replays; returns figures."""
    truth = Truth.read(folder / "truth.csv")

    def opened() -> Replay:
        robot = Replay(folder, name)
        if seed is not None:
            robot.recording = drawn_wheels(robot.recording, truth, seed)
        return robot

    right = right_geometry(opened(), console)
    description = declaring(opened().describe(), right)
    table = Table("declared", "error, m", "ratio", "wheels alone, m", "over 1 m", "wheels", "used",
                  "nodes", "maps", "named")  # fmt: skip
    base = replay(opened(), description, truth, right.forward)

    def row(label: str, result: ReplayResult) -> None:
        named = ", ".join(
            f"{c.parameter.name.lower()} {c.estimated:.3f} ({c.declared:.3f})" for c in result.causes
        )
        ratio = result.error / base.error
        table.add_row(
            label, f"{result.error:.2f}", f"{ratio:.2f}", f"{result.wheels:.2f}",
            f"{result.relative:.4f}", f"{result.relative_wheels:.4f}", f"{result.used:.3f}",
            str(result.nodes), str(result.maps), named or "-",
        )  # fmt: skip
        console.print(f"{label}: error {result.error:.2f} m, used {result.used:.3f}, named: {named or '-'}")

    row("right", base)
    results = {}
    for label, (parameter, amount) in WRONG.items():
        if only and label not in only:
            continue
        vector = right.vector
        vector[parameter] += amount
        wrong = declaring(description, DriveGeometry.of(vector))
        results[label] = replay(opened(), wrong, truth, right.forward)
        row(label, results[label])
    console.print(table)
    replays = {"right": base, **results}
    named = {
        label: any(c.parameter is WRONG[label][0] for c in result.causes) for label, result in results.items()
    }
    ratios = {label: round(result.error / base.error, 3) for label, result in results.items()}
    return {
        "error_ratio": max(ratios.values()),
        "frames_used": round(min(result.used for result in (base, *results.values())), 4),
        "diagnosed": all(named.values()),
        "wheels_ratio": round(max(r.error / r.wheels for r in (base, *results.values())), 3),
        "rpe_m": {label: round(r.relative, 4) for label, r in replays.items()},
        "wheels_rpe_m": {label: round(r.relative_wheels, 4) for label, r in replays.items()},
        "right_m": round(base.error, 3),
        "ratios": ratios,
        "named": named,
    }


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.geometry", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--recording", type=Path, required=True, metavar="FOLDER", help="with truth.csv")
    parser.add_argument("--robot", metavar="NAME", help="one robot of its splits.toml (default: all frames)")
    parser.add_argument(
        "--seed", type=int, metavar="N", help="simulate the wheels by the truth (default: as recorded)"
    )
    parser.add_argument("--only", nargs="+", choices=tuple(WRONG), default=[], help="these alone")
    parser.add_argument("--json", action="store_true", help="last line of output: one JSON object")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    console = Console(stderr=arguments.json)
    with failing_in_one_line("geometry"):
        figures = run(arguments.recording, arguments.robot, arguments.seed, arguments.only, console)
    console.print(figures)
    if arguments.json:
        print(json.dumps(figures))

"""How well a recording is mapped: error of every frame beside the wheels alone, and which were not used."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from mapweave.agent.calibration.online import OnlineCalibration
from mapweave.agent.drivers.replay import Replay
from mapweave.agent.mapping.way_correction import WayCorrection
from mapweave.agent.mission import Carried
from mapweave.agent.pipeline import Pipeline
from mapweave.agent.recordings.recording import Stamps
from mapweave.agent.recordings.trajectory_file import TrajectoryFile, tum_line
from mapweave.agent.settings import AgentSettings
from mapweave.evaluation.map_score import align
from mapweave.evaluation.truth_files import read_truth
from mapweave.evaluation.verdict import shown
from mapweave.hybridmap.errors import DeviceError
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.storage.map_file import MapFile, pack_map_file

RPE_M = 1.0
"""Relative errors are taken over so long a way, m."""
SAME_STAMP_NS = 20_000_000
"""A true pose further from a frame in time is another one's; between two poses the truth is interpolated."""


@dataclass(frozen=True)
class ReplayedFrame:
    """One observation.

    Attributes:
        stamp_ns: of it.
        part: number of the map that was made then, from 0.
        map_from_robot: where the robot believed to be, moved as a whole where the geometry was corrected
            later (`TickResult.way_moved`); None if the frame was not used.
        wheels: dead reckoning from the first observation.
        reason: why it was not used; empty if it was.
    """

    stamp_ns: int
    part: int
    map_from_robot: Pose2 | None
    wheels: Pose2
    reason: str


@dataclass(frozen=True)
class ReplayEvaluation:
    """What came of a replay.

    Attributes:
        name: of the recording.
        frames: all, in order.
        maps: that were made.
        truth: (N, 3) pose of each frame, NaN where unknown.
        notes: what is wrong with the declared geometry or the odometry, a line each.
    """

    name: str
    frames: Sequence[ReplayedFrame]
    maps: Sequence[HybridMap]
    truth: Array
    notes: Sequence[str] = field(default_factory=tuple)

    def report(self) -> dict[str, Any]:
        """Figures by name; None without truth."""
        used = [frame.map_from_robot is not None for frame in self.frames]
        parts = np.array([frame.part for frame in self.frames])
        estimated = np.array(
            [(math.nan,) * 3 if f.map_from_robot is None else f.map_from_robot.vector for f in self.frames]
        )
        wheels = np.array([frame.wheels.vector for frame in self.frames])
        # The wheels are scored on the same frames, cut at the same places.
        compared = np.isfinite(estimated[:, 0]) & np.isfinite(self.truth[:, 0])
        scored: dict[str, float | None] = {}
        for name, poses in (("", estimated), ("wheels_", wheels)):
            ate, rpe, turn = errors(poses[compared], self.truth[compared], parts[compared])
            scored |= {f"{name}ate_m": ate, f"{name}rpe_m": rpe, f"{name}rpe_deg": turn}
        reasons = Counter(frame.reason for frame in self.frames if frame.reason)
        return {
            "recording": self.name,
            "frames": len(self.frames),
            "frames_used": round(sum(used) / max(len(used), 1), 4),
            "not_used": dict(reasons.most_common(5)),
            "maps": len(self.maps),
            "nodes": sum(len(one.nodes) for one in self.maps),
            "edges": sum(len(one.edges) for one in self.maps),
            "bytes": sum(
                len(pack_map_file(MapFile("agent", "map", tuple(one.contents())))) for one in self.maps
            ),
            "truth": bool(compared.any()),
            **{key: None if value is None else round(value, 4) for key, value in scored.items()},
        }

    def write(self, folder: Path) -> list[Path]:
        """The trajectory of each map, and that of the wheels, as evo reads them."""
        folder.mkdir(parents=True, exist_ok=True)
        out = []
        for part in range(len(self.maps)):
            path = folder / f"map{part}.tum"
            path.unlink(missing_ok=True)
            trajectory = TrajectoryFile(path)
            for before, frame in pairwise([self.frames[0], *self.frames]):
                if frame.part == part:
                    motion = before.wheels.inverse() @ frame.wheels
                    trajectory.add(frame.stamp_ns, motion, frame.map_from_robot)
            trajectory.close()
            out.append(path)
        wheels = folder / "wheels.tum"
        wheels.write_text("".join(tum_line(frame.stamp_ns, frame.wheels) for frame in self.frames))
        return [*out, wheels]


def errors(poses: Array, true: Array, parts: Array) -> tuple[float | None, float | None, float | None]:
    """Absolute and relative errors of a trajectory.

    Args:
        poses: (N, 3) estimated, each part in a frame of its own.
        true: (N, 3).
        parts: (N,) to which part each belongs.

    Returns:
        Root mean square of the positions' errors after one rigid alignment a part, m; root mean square
        errors of the motion over each metre, m and degrees (Sturm et al., IROS 2012). None without poses.
    """
    squares, relative = list[float](), list[tuple[float, float]]()
    for part in np.unique(parts):
        rows = parts == part
        mine, truth = poses[rows], true[rows]
        moved = align(mine[:, :2], truth[:, :2]).apply(mine[:, :2])
        squares += ((moved - truth[:, :2]) ** 2).sum(axis=1).tolist()
        way = np.concatenate([[0.0], np.hypot(*np.diff(truth[:, :2], axis=0).T).cumsum()])
        ends = np.searchsorted(way, way + RPE_M)
        for a, b in enumerate(ends.tolist()):
            if b < len(mine):
                step = Pose2.from_vector(mine[a]).inverse() @ Pose2.from_vector(mine[b])
                real = Pose2.from_vector(truth[a]).inverse() @ Pose2.from_vector(truth[b])
                off = real.inverse() @ step
                relative.append((math.hypot(off.x, off.y), math.degrees(off.heading)))
    if not squares:
        return None, None, None
    ate = math.sqrt(sum(squares) / len(squares))
    if not relative:
        return ate, None, None
    rpe, turn = np.sqrt((np.array(relative) ** 2).mean(axis=0)).tolist()
    return ate, rpe, turn


def evaluate_replay(
    replay: Replay,
    settings: AgentSettings,
    truth: Path | None,
    on_frame: Callable[[ReplayedFrame], None] = lambda frame: None,
) -> ReplayEvaluation:
    """Map a recording as `mapweave replay` does, and score it.

    Args:
        replay: read to its end.
        settings: of the pipeline.
        truth: see `read_truth`; None scores nothing.
        on_frame: called after each frame.

    Raises:
        DeviceError: the truth is missing or wrong; or no image can be read.
    """
    # A wrong file is reported before the recording is mapped.
    true_poses(truth, replay.recording.path, np.zeros(0, np.int64))
    description = replay.describe()
    pipelines = [_pipeline(0, description, settings)]
    frames, wheels = list[ReplayedFrame](), Pose2()
    while (observation := replay.sense()) is not None:
        if pipelines[-1].lost:
            calibration = pipelines[-1].calibration
            pipelines.append(_pipeline(len(pipelines), description, settings, calibration))
        step = pipelines[-1].step(observation)
        status = step.status
        if step.way_moved is not None:
            frames = [_moved(frame, step.way_moved, len(pipelines) - 1) for frame in frames]
        wheels = wheels @ observation.odometry.motion()
        pose = status.map_from_robot if status.located else None
        reason = "" if status.located else status.detail.partition(":")[0] or status.doing
        frames.append(ReplayedFrame(observation.stamp_ns, len(pipelines) - 1, pose, wheels, reason))
        on_frame(frames[-1])
    pipelines[-1].finish()
    stamps = np.array([frame.stamp_ns for frame in frames], np.int64)
    maps = [pipeline.map for pipeline in pipelines]
    notes = list(dict.fromkeys(line for pipeline in pipelines for line in pipeline.complaints))
    true = true_poses(truth, replay.recording.path, stamps)
    return ReplayEvaluation(str(replay.recording.path), frames, maps, true, notes)


def _moved(frame: ReplayedFrame, moved: WayCorrection, part: int) -> ReplayedFrame:
    """A frame after the geometry was corrected, moved if it is of that map."""
    pose = frame.map_from_robot
    return frame if pose is None or frame.part != part else replace(frame, map_from_robot=moved.apply(pose))


def true_poses(path: Path | None, recording: Path, stamps_ns: Stamps) -> Array:
    """(N, 3) true poses at stamps, NaN where the truth says nothing.

    Raises:
        DeviceError: the file is missing or wrong.
    """
    out = np.full((len(stamps_ns), 3), math.nan)
    if path is None:
        return out
    known, poses = read_truth(path, recording)
    if not len(known):
        raise DeviceError(f"{path}: no poses")
    after = np.clip(np.searchsorted(known, stamps_ns), 1, len(known) - 1) if len(known) > 1 else None
    if after is None:
        return out
    at = stamps_ns - known[0]
    inside = (stamps_ns >= known[0] - 1_000_000) & (stamps_ns <= known[-1] + 1_000_000)
    nearest = np.minimum(np.abs(stamps_ns - known[after]), np.abs(stamps_ns - known[after - 1]))
    close = inside & (nearest <= SAME_STAMP_NS)
    for k, column in enumerate((poses[:, 0], poses[:, 1], np.unwrap(poses[:, 2]))):
        out[close, k] = np.interp(at[close], known - known[0], column)
    return out


def _pipeline(
    number: int, description: Any, settings: AgentSettings, calibration: OnlineCalibration | None = None
) -> Pipeline:
    pipeline = Pipeline(MapId("replay", number + 1), description, settings, calibration=calibration)
    pipeline.set_mission(Carried())
    return pipeline


def rows(report: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """The report for people: each figure beside the wheels' where there is one."""
    out = list[tuple[str, ...]]()
    for name, value in report.items():
        if name.startswith("wheels_"):
            continue
        if isinstance(value, dict):
            words = "; ".join(f"{count} {reason}" for reason, count in value.items()) or "none"
        else:
            words = f"{100 * value:g} %" if name == "frames_used" else shown(value)
        wheels = report.get(f"wheels_{name}")
        out.append((name, words if wheels is None else f"{words} (wheels alone {wheels:g})"))
    return out

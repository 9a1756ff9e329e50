"""How well a recording without odometry is mapped by its images: up to scale, as such a map has none."""

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mapweave.agent.recordings.recording import Recording
from mapweave.evaluation.replaying import true_poses
from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.errors import DeviceError
from mapweave.hybridmap.pose import Array
from mapweave.storage.map_file import MapFile, pack_map_file
from mapweave.terminal import working
from mapweave.visual_mapping import VisualMap, keyframes, nothing_mapped, visual_maps
from mapweave.visual_trajectory import ImagePose, tum_lines

INTERPOLATED = "too few features of its keyframe are left: interpolated"
NO_MAP = "its keyframe is in no map: nothing in common with its neighbours, or no depth"
UNREADABLE = "it cannot be read"


@dataclass(frozen=True)
class VisualEvaluation:
    """What came of it.

    Attributes:
        name: of the recording.
        stamps_ns: (N,) of its images.
        maps: that were made.
        unreadable: images that cannot be read.
        truth: (N, 3) pose of each image, NaN where unknown.
        damage: a line each.
    """

    name: str
    stamps_ns: Sequence[int]
    maps: Sequence[VisualMap]
    unreadable: int
    truth: Array
    damage: Sequence[str]

    def report(self) -> dict[str, Any]:
        """Figures by name; None without truth."""
        poses = [pose for one in self.maps for pose in one.trajectory]
        found = sum(pose.found for pose in poses)
        reasons = Counter(
            {
                INTERPOLATED: len(poses) - found,
                NO_MAP: len(self.stamps_ns) - len(poses) - self.unreadable,
                UNREADABLE: self.unreadable,
            }
        )
        changes = [change for one in self.maps for change in one.changes]
        true = dict(zip(self.stamps_ns, self.truth, strict=True))
        squares = np.concatenate([_squares(one.trajectory, true) for one in self.maps] or [np.zeros(0)])
        return {
            "recording": self.name,
            "frames": len(self.stamps_ns),
            "frames_used": round(found / max(len(self.stamps_ns), 1), 4),
            "not_used": {reason: count for reason, count in reasons.most_common() if count},
            "maps": len(self.maps),
            "nodes": sum(isinstance(change, NodePut) for change in changes),
            "edges": sum(isinstance(change, EdgePut) for change in changes),
            "bytes": sum(len(pack_map_file(MapFile("agent", "map", tuple(o.changes)))) for o in self.maps),
            "truth": bool(len(squares)),
            "ate_up_to_scale_m": round(math.sqrt(float(squares.mean())), 4) if len(squares) else None,
        }

    def write(self, folder: Path) -> list[Path]:
        """The trajectory of each map, as evo reads it; compare with `--correct_scale`."""
        folder.mkdir(parents=True, exist_ok=True)
        out = []
        for part, one in enumerate(self.maps):
            out.append(folder / f"map{part}.tum")
            out[-1].write_text(tum_lines(one.trajectory))
        return out


def evaluate_images(recording: Recording, frames: Iterable[int], truth: Path | None) -> VisualEvaluation:
    """Map a recording without odometry as `mapweave replay` does, and score it.

    Args:
        recording: of a walk.
        frames: numbers of its images, in their order; going through them shows progress.
        truth: see `read_truth`; None scores nothing.

    Raises:
        DeviceError: the truth is missing or wrong; or nothing can be mapped.
    """
    # A wrong file is reported before the recording is mapped.
    true_poses(truth, recording.path, np.zeros(0, np.int64))
    numbers = list[int]()

    def noted() -> Iterable[int]:
        for frame in frames:
            numbers.append(frame)
            yield frame

    walk, damage = keyframes(recording, noted())
    with working("finding where the images were taken"):
        maps = visual_maps(walk, recording.camera, "replay", 1)
    if not maps:
        raise DeviceError(nothing_mapped(recording.path, walk, damage))
    stamps = recording.stamps_ns[numbers]
    read = sum(1 + len(keyframe.followed) for keyframe in walk)
    true = true_poses(truth, recording.path, stamps)
    return VisualEvaluation(str(recording.path), stamps.tolist(), maps, len(numbers) - read, true, damage)


def _squares(trajectory: Sequence[ImagePose], true: dict[int, Array]) -> Array:
    """(N,) m^2, of positions after the one similarity that brings them nearest to the truth."""
    pairs = [
        (pose.map_from_robot.vector[:2], true[pose.stamp_ns][:2])
        for pose in trajectory
        if pose.found and pose.stamp_ns in true
    ]
    both = np.array(pairs, np.float64).reshape(-1, 2, 2)
    both = both[np.isfinite(both).all(axis=(1, 2))]
    if len(both) < 2:
        return np.zeros(0)
    centred = both - both.mean(axis=0)
    mine, there = (centred[:, side, 0] + 1j * centred[:, side, 1] for side in (0, 1))
    size = float(np.abs(mine.conj() @ mine))
    fit = (mine.conj() @ there) / size if size > 0.0 else 0.0
    return np.asarray(np.abs(fit * mine - there) ** 2, np.float64)

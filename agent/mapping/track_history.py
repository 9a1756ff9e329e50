"""Where each track was seen from, since the anchor view: what landmarks are triangulated from."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.arrays import among
from mapweave.hybridmap.pose import Array, Pose2


class TrackHistory:
    """Pixels of tracks with the poses from which they were seen.

    An observation is kept when the robot has moved enough since the last one: standing still adds nothing.
    """

    def __init__(self, step: float = 0.02, turn_step: float = 0.02, most: int = 80) -> None:
        """Set how far apart observations are.

        Args:
            step: m.
            turn_step: rad.
            most: observations kept; of more, every second one is dropped.
        """
        self._step = step
        self._turn_step = turn_step
        self._most = most
        self._poses: list[Pose2] = []
        self._ids: list[NDArray[np.int64]] = []
        self._pixels: list[Array] = []
        self._moved: tuple[Pose2, NDArray[np.int64]] | None = None

    def record(
        self, anchor_from_robot: Pose2, ids: NDArray[np.int64], pixels: Array, force: bool = False
    ) -> None:
        """Keep an observation, ids (N,) and pixels (N, 2) px, if the robot has moved or it is forced."""
        self._express()
        if self._poses and not force:
            moved = self._poses[-1].inverse() @ anchor_from_robot
            if math.hypot(moved.x, moved.y) < self._step and abs(moved.heading) < self._turn_step:
                return
        self._poses.append(anchor_from_robot)
        self._ids.append(ids.copy())
        self._pixels.append(pixels.copy())
        if len(self._poses) > self._most:
            for column in (self._poses, self._ids, self._pixels):
                del column[1::2]

    def snapshot(self) -> TrackHistory:
        """The history as it is now, which later observations do not change."""
        self._express()
        copy = TrackHistory(self._step, self._turn_step, self._most)
        copy._poses, copy._ids, copy._pixels = self._poses.copy(), self._ids.copy(), self._pixels.copy()
        return copy

    def observations(self, ids: NDArray[np.int64]) -> tuple[Array, Array]:
        """All observations of some tracks.

        Args:
            ids: (N,) tracks.

        Returns:
            Poses (T, 3) [x m, y m, heading rad] in the anchor's frame, and pixels (T, N, 2), NaN where
            a track was not seen.
        """
        self._express()
        pixels = np.full((len(self._poses), len(ids), 2), np.nan)
        if len(ids) and self._poses:
            # One table for all images: a search in each costs several times as much.
            lowest, highest = int(ids.min()), int(ids.max())
            column_of = np.full(highest - lowest + 1, -1, np.int64)
            column_of[ids - lowest] = np.arange(len(ids))
            seen = np.concatenate(self._ids)
            row = np.repeat(np.arange(len(self._ids)), [len(track_ids) for track_ids in self._ids])
            asked = np.flatnonzero((seen >= lowest) & (seen <= highest))
            column = column_of[seen[asked] - lowest]
            hit = asked[column >= 0]
            pixels[row[hit], column[column >= 0]] = np.concatenate(self._pixels)[hit]
        poses = np.array([p.vector for p in self._poses]).reshape(-1, 3)
        return poses, pixels

    def reanchor(self, old_from_new: Pose2, alive: NDArray[np.int64]) -> None:
        """Express everything in a new anchor's frame and keep only observations of the present tracks.

        That is done when the history is next used, in the tick after: see `Tracker.templates`.
        """
        self._express()
        self._moved = old_from_new, alive

    def _express(self) -> None:
        """Do what the last `reanchor` has left."""
        if self._moved is None:
            return
        (old_from_new, alive), self._moved = self._moved, None
        new_from_old = old_from_new.inverse()
        poses, ids, pixels = self._poses, self._ids, self._pixels
        self._poses, self._ids, self._pixels = [], [], []
        ends = np.cumsum([len(track_ids) for track_ids in ids], dtype=np.intp)
        masks = np.split(among(np.concatenate(ids), alive), ends[:-1]) if ids else []
        for pose, track_ids, at, mask in zip(poses, ids, pixels, masks, strict=True):
            if mask.any():
                self._poses.append(new_from_old @ pose)
                self._ids.append(track_ids[mask])
                self._pixels.append(at[mask])

"""Trajectories as TUM's benchmark and evo read them: `stamp x y z qx qy qz qw`, s and m, one pose a line."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mapweave.agent.mapping.way_correction import WayCorrection
from mapweave.hybridmap.pose import Pose2
from mapweave.storage.atomic_file import read_whole, unwritable, write_whole
from mapweave.storage.os_errors import reason_of

BY_WHEELS = "# not localized: by the wheels alone from here\n"
LOCALIZED = "# localized from here\n"


def tum_line(stamp_ns: int, pose: Pose2) -> str:
    """One pose. The stamp keeps its nanoseconds, which a float64 would not."""
    return _line(f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}", pose)


def _line(seconds: str, pose: Pose2) -> str:
    half = pose.heading / 2
    return f"{seconds} {pose.x:.6f} {pose.y:.6f} 0 0 0 {math.sin(half):.9f} {math.cos(half):.9f}\n"


class TrajectoryFile:
    """Writes a pose for each frame. Where the robot is not localized the wheels carry the pose on.

    Comments say which poses are the wheels' alone; TUM's tools and evo skip them.
    """

    def __init__(self, path: Path) -> None:
        """Begin or go on: what was there before is kept.

        Raises:
            OSError: it cannot be written.
        """
        self._path = path
        self._file = path.open("a", encoding="ascii", newline="\n")
        self._begin = self._file.tell()
        # Where in the file the way before is to be moved, in bytes, and by what.
        self._moves: list[tuple[int, WayCorrection]] = []
        self._pose = Pose2()
        self._localized: bool | None = None
        # Frames before the first at which the robot is localized, in the frame of the first of them.
        self._waiting: list[tuple[int, Pose2]] = []

    def add(self, stamp_ns: int, motion: Pose2, pose: Pose2 | None) -> None:
        """Add a frame.

        Args:
            stamp_ns: of it.
            motion: by the wheels, since the frame before.
            pose: in the map; None if the robot is not localized.

        Raises:
            InvalidFile: the disk does not take it.
        """
        carried = self._pose @ motion
        if self._localized is None and pose is None:
            self._waiting.append((stamp_ns, carried))
        else:
            with self._writing():
                if pose is not None:
                    self._write_waiting(pose @ carried.inverse())
                self._write(stamp_ns, carried if pose is None else pose, pose is not None)
        self._pose = carried if pose is None else pose

    def move(self, moved: WayCorrection) -> None:
        """Move all poses that were added until now, at the end: a tick has no time for it."""
        self._moves.append((self._file.tell(), moved))
        self._pose = moved.apply(self._pose)

    def close(self) -> None:
        """Finish the file.

        Raises:
            InvalidFile: the disk does not take it; where poses are moved, the file stays as it was.
        """
        with self._writing():
            self._write_waiting(Pose2())
            self._file.close()
        moves, self._moves = self._moves, []
        if moves:
            self._rewrite(moves)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise unwritable(self._path, reason_of(error)) from None

    def _rewrite(self, moves: list[tuple[int, WayCorrection]]) -> None:
        at, out = 0, list[bytes]()
        for line in read_whole(self._path).splitlines(keepends=True):
            later = [moved for end, moved in moves if self._begin <= at < end]
            at += len(line)
            if later and not line.startswith(b"#"):
                stamp, x, y, *_, sine, cosine = line.decode("ascii").split()
                pose = Pose2(float(x), float(y), 2.0 * math.atan2(float(sine), float(cosine)))
                for moved in later:
                    pose = moved.apply(pose)
                line = _line(stamp, pose).encode("ascii")
            out.append(line)
        write_whole(self._path, b"".join(out))

    def _write_waiting(self, map_from_first: Pose2) -> None:
        waiting, self._waiting = self._waiting, []
        for stamp_ns, pose in waiting:
            self._write(stamp_ns, map_from_first @ pose, localized=False)

    def _write(self, stamp_ns: int, pose: Pose2, localized: bool) -> None:
        if localized != self._localized and (self._localized is not None or not localized):
            self._file.write(LOCALIZED if localized else BY_WHEELS)
        self._localized = localized
        self._file.write(tum_line(stamp_ns, pose))

"""What a robot has learned of its geometry is kept beside its journal, and used when it is started again."""

import threading
from collections.abc import Callable
from datetime import date
from pathlib import Path

from mapweave.agent.calibration.learned import LearnedGeometry
from mapweave.agent.calibration.online import OnlineCalibration
from mapweave.agent.drive_geometry import DriveGeometry
from mapweave.agent.observation import RobotDescription
from mapweave.agent.recordings.learned_file import read_learned, write_learned
from mapweave.hybridmap.errors import MapweaveError


class GeometryKeeper:
    """Reads the file at the start, and writes it when the geometry in use has changed, and at the end."""

    def __init__(self, path: Path, say: Callable[[str], None]) -> None:
        """Take the file."""
        self._path, self._say = path, say
        self._kept: LearnedGeometry | None = None
        self._used: DriveGeometry | None = None
        self._on: date | None = None
        self._writing: threading.Thread | None = None

    def calibration(self, description: RobotDescription) -> OnlineCalibration:
        """The calibration with which a robot starts; says what of an earlier drive is used, or why not."""
        learned = None
        try:
            read = read_learned(self._path)
        except MapweaveError as error:
            self._say(f"{error}; it is not used")
            read = None
        if read is not None:
            learned, self._on = read
            if learned.fits(description):
                self._kept = learned
                self._say(said(learned, self._on, self._path))
            else:
                self._say(
                    f"what was learned of the geometry on {self._on} is not used: another camera or geometry "
                    "is declared since"
                )
        calibration = OnlineCalibration(description, learned)
        self._used = calibration.geometry
        return calibration

    def see(self, calibration: OnlineCalibration) -> None:
        """Keep what a robot uses from now on, once a tick. No tick waits for the disk."""
        if calibration.geometry is self._used:
            return
        self._used = calibration.geometry
        self._join()
        learned = calibration.learned
        self._writing = threading.Thread(target=self._write, args=(learned,), name="learned geometry")
        self._writing.start()

    def close(self, calibration: OnlineCalibration) -> None:
        """Keep what is known at the end, which may be better than what it was when it was put to use."""
        self._join()
        self._write(calibration.learned)

    def _join(self) -> None:
        if self._writing is not None:
            self._writing.join()
            self._writing = None

    def _write(self, learned: LearnedGeometry | None) -> None:
        if learned is None or learned == self._kept:
            return
        try:
            write_learned(self._path, learned, date.today())
            self._kept = learned
        except MapweaveError as error:
            self._say(str(error))


def said(learned: LearnedGeometry, on: date, path: Path) -> str:
    """One line on what is learned, and how to forget it."""
    return f"{', '.join(learned.words())}; learned on {on}; forget with `rm {path}`"

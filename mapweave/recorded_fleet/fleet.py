"""The recorded fleet beside a server: its robots move as long as it is open."""

from __future__ import annotations

import threading
from pathlib import Path
from types import TracebackType

from mapweave.recorded_fleet.recording import recorded_maps
from mapweave.recorded_fleet.robot import RecordedRobot
from mapweave.wire.bus import Bus
from mapweave.wire.keys import Keys

EVERY = 0.5
"""Between two statuses of a robot, s, as with agents."""
STILL_MAPPING = 12
"""Nodes that the last robot of the main building maps before the viewer's eyes."""
MAPPING = "cy"


class RecordedFleet:
    """A context manager."""

    def __init__(self, bus: Bus, keys: Keys, server: str, folder: Path) -> None:
        """Give a server the maps, and begin to move.

        Args:
            bus: the connection; stays the caller's.
            keys: of the fleet.
            server: its name.
            folder: for journals.
        """
        self._stop = threading.Event()
        self._robots = []
        for map_id, changes in recorded_maps().items():
            nodes = len(changes) // 2 + 1
            known = nodes - STILL_MAPPING if map_id.agent == MAPPING else nodes
            self._robots.append(RecordedRobot(bus, keys, server, map_id, changes, folder, known))
        self._thread = threading.Thread(target=self._move, name="recorded fleet", daemon=True)
        self._thread.start()

    def __enter__(self) -> RecordedFleet:
        """Nothing more to do."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the robots."""
        self._stop.set()
        self._thread.join()
        for robot in self._robots:
            robot.close()

    def _move(self) -> None:
        while True:
            for robot in self._robots:
                robot.step(EVERY)
            if self._stop.wait(EVERY):
                return

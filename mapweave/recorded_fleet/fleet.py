"""The recorded fleet beside a server: its robots move as long as it is open."""

from __future__ import annotations

import shutil
import threading
import time
from contextlib import closing
from pathlib import Path

from mapweave.agent.replication.journal import Journal
from mapweave.hybridmap.change import ChangeBody
from mapweave.hybridmap.ids import MapId
from mapweave.mapserver.http.last_shown import LastShown
from mapweave.mapserver.log.entry import ReceivedChange
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.mapserver.log.store import CHOICE_KEY, HISTORY
from mapweave.mapserver.merging.verification_cache_keeper import SUFFIX
from mapweave.recorded_fleet.recording import VERDICTS, recorded_maps
from mapweave.recorded_fleet.robot import ReplayedRobot
from mapweave.wire.bus import Bus
from mapweave.wire.keys import Keys
from mapweave.wire.messages import KeptHistory, encode

EVERY = 0.5
"""Between two statuses of a robot, s, as with agents."""
MAPPING, STILL = "cy", 12
"""This robot maps so many nodes while the viewer looks on. Each is a node and the edge that leads to it."""


def prepare(folder: Path, store: Path, shown: LastShown) -> None:
    """Make the robots' journals, and a store that has what they have: a server shows the maps at once.

    Beside the store is what comparing the nodes has found.

    Args:
        folder: for the journals.
        store: of the server.
        shown: by the server that recorded them; its history goes on.

    Raises:
        MapweaveError: the disk does not take it.
    """
    with closing(SqliteStore(store)) as filled:
        for map_id, changes in recorded_maps().items():
            with closing(Journal(_journal(folder, map_id), map_id.agent)) as journal:
                journal.open_map(map_id.epoch)
                written = journal.append(map_id, split(map_id, changes)[0], time.time_ns())
                rows = journal.rows(map_id, 1, journal.head(map_id))
                entries = [ReceivedChange(*row, change) for row, change in zip(rows, written, strict=True)]
                filled.apply(map_id, journal.log_id(map_id), entries)
        # As where nothing is left to chance: else other pairs would be compared than have been.
        filled.put_result(CHOICE_KEY, b"")
        if VERDICTS.exists():
            shutil.copyfile(VERDICTS, store.with_name(store.name + SUFFIX))
        if shown:
            filled.put_result(HISTORY, encode(KeptHistory(shown.history, tuple(shown.parts))))


def replayed_robots(bus: Bus, keys: Keys, server: str, folder: Path) -> list[ReplayedRobot]:
    """The robots, announced, at the beginnings of their recordings; for the arguments see `RecordedFleet`."""
    return [
        ReplayedRobot(bus, keys, server, map_id, *split(map_id, changes), _journal(folder, map_id))
        for map_id, changes in recorded_maps().items()
    ]


class RecordedFleet:
    """A context manager."""

    def __init__(self, bus: Bus, keys: Keys, server: str, folder: Path) -> None:
        """Announce the robots, and begin to move.

        Args:
            bus: the connection; stays the caller's.
            keys: of the fleet.
            server: its name.
            folder: with the journals, see `prepare`.
        """
        self._stop = threading.Event()
        self._robots = replayed_robots(bus, keys, server, folder)
        self._thread = threading.Thread(target=self._move, name="recorded fleet", daemon=True)
        self._thread.start()

    def __enter__(self) -> RecordedFleet:
        """Nothing more to do."""
        return self

    def __exit__(self, *_: object) -> None:
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


def _journal(folder: Path, map_id: MapId) -> Path:
    return folder / f"journal-{map_id.agent}.sqlite"


def split(map_id: MapId, changes: list[ChangeBody]) -> tuple[list[ChangeBody], list[ChangeBody]]:
    """What of a recorded map is mapped already, and what is still to be mapped."""
    known = len(changes) - (2 * STILL if map_id.agent == MAPPING else 0)
    return changes[:known], changes[known:]

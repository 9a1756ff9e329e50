"""How long something took, without the time in which other programs of a busy computer had its cores."""

import subprocess
import time
from pathlib import Path


class CoreTime:
    """The time of a process since this was made, s, less the longest that one of its threads stood ready to
    run and had no core: on a quiet computer it is the time by the clock. Linux counts that.
    """

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        """Begin."""
        self._pid, self._begun = process.pid, time.monotonic()
        self._before = self._waits()
        self._longest = 0.0

    def look(self) -> float:
        """The time until now; after the end of the process its waits count as seen last."""
        passed = time.monotonic() - self._begun
        waits = self._waits()
        since = (waited - self._before.get(thread, 0.0) for thread, waited in waits.items())
        self._longest = max(self._longest, *since, 0.0)
        return passed - self._longest

    def _waits(self) -> dict[str, float]:
        """By thread, s."""
        waits = {}
        for path in Path(f"/proc/{self._pid}/task").glob("*/schedstat"):
            try:
                waits[path.parent.name] = int(path.read_text().split()[1]) * 1e-9
            except (OSError, IndexError):
                continue  # it has ended
        return waits

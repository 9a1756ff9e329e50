"""Processor time and memory of processes, by what Linux tells of their threads."""

import contextlib
import ctypes
import gc
import os
import re
import resource
from collections.abc import Iterable
from pathlib import Path

ZENOH = re.compile(r"^(acc|app|net|rx|tx)-\d+$")
"""Names of Zenoh's own threads."""
HZ = os.sysconf("SC_CLK_TCK")


class Usage:
    """Processor time of a process. Zenoh begins and ends threads as it likes: take it often."""

    def __init__(self, pid: int) -> None:
        """Begin with the threads that are there."""
        self._pid = pid
        self._zenoh: dict[tuple[str, int], float] = {}
        """What Zenoh's threads had used when they were last seen, s, by number and start."""
        self.take()

    def take(self) -> tuple[float, float]:
        """What it has used, s: by its own threads and by those of Zenoh, also those that have ended."""
        for task in Path(f"/proc/{self._pid}/task").iterdir():
            try:
                name, used, start = _stat(task / "stat")
            except (FileNotFoundError, ProcessLookupError):  # it has just ended
                continue
            if ZENOH.match(name):
                self._zenoh[task.name, start] = used
        zenoh = sum(self._zenoh.values())
        return used_by(self._pid) - zenoh, zenoh


def used_by(pid: int) -> float:
    """What all threads of a process have used, s, also those that have ended."""
    return _stat(Path(f"/proc/{pid}/stat"))[1]


def _stat(path: Path) -> tuple[str, float, int]:
    """Name of a thread or process, what it has used, s, and when it began."""
    name, _, rest = path.read_text().partition("(")[2].rpartition(")")
    fields = rest.split()
    return name, (int(fields[11]) + int(fields[12])) / HZ, int(fields[19])


def resident_mb(pid: int | None = None) -> float:
    """Memory that a process has now, this one by default, MB."""
    return _memory_mb(pid, "VmRSS")


def peak_mb(pid: int | None = None) -> float:
    """Most memory that a process has had, this one by default, MB.

    The peak of `getrusage` is at least that of the parent, as it was when it started the process.
    """
    return _memory_mb(pid, "VmHWM")


def _memory_mb(pid: int | None, which: str) -> float:
    status = Path(f"/proc/{pid or 'self'}/status").read_text()
    return int(status.split(f"{which}:")[1].split()[0]) * 1024 / 1e6


def held_bytes() -> int:
    """Memory of this process, without garbage and what the allocator holds in reserve."""
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def total(pids: Iterable[int]) -> float:
    """Processor time of all threads of all processes, s."""
    return sum(map(used_by, pids))

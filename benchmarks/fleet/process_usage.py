"""Processor time and memory of processes, by what Linux tells of their threads."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path

ZENOH = re.compile(r"^(acc|app|net|rx|tx)-\d+$")
"""Names of Zenoh's own threads."""
HZ = os.sysconf("SC_CLK_TCK")


def cpu_seconds(pid: int) -> tuple[float, float]:
    """What a process has used, s: by its own threads, also those that have ended, and by Zenoh's in it."""
    zenoh = 0.0
    for task in Path(f"/proc/{pid}/task").iterdir():
        try:
            name, used = _used(task / "stat")
        except FileNotFoundError:  # it has just ended
            continue
        zenoh += used if ZENOH.match(name) else 0.0
    return _used(Path(f"/proc/{pid}/stat"))[1] - zenoh, zenoh


def _used(stat: Path) -> tuple[str, float]:
    """Name of a thread or process, and what it has used, s."""
    name, _, rest = stat.read_text().partition("(")[2].rpartition(")")
    fields = rest.split()
    return name, (int(fields[11]) + int(fields[12])) / HZ


def resident_mb(pid: int) -> float:
    """Memory that a process has now, MB."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0]) / 1024


def total(pids: Iterable[int]) -> float:
    """Of all threads of all processes, s."""
    return sum(sum(cpu_seconds(pid)) for pid in pids)

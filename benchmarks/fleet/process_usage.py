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
    """What a process has used, s: by its own threads, and by those of Zenoh in it."""
    own = zenoh = 0.0
    for task in Path(f"/proc/{pid}/task").iterdir():
        name, _, rest = (task / "stat").read_text().partition("(")[2].rpartition(")")
        fields = rest.split()
        used = (int(fields[11]) + int(fields[12])) / HZ
        if ZENOH.match(name):
            zenoh += used
        else:
            own += used
    return own, zenoh


def resident_mb(pid: int) -> float:
    """Memory that a process has now, MB."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0]) / 1024


def total(pids: Iterable[int]) -> float:
    """Of all threads of all processes, s."""
    return sum(sum(cpu_seconds(pid)) for pid in pids)

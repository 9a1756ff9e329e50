"""The robot's computer: its clock, and the disk that the map goes to."""

import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from mapweave.doctor.finding import Finding, good, skipped, warning, wrong

LEAST_FREE = 100e6
"""bytes; a map of 1 000 nodes takes 5 MB, a minute of recording 60 MB."""
LITTLE_FREE = 1e9
"""bytes, of which the examination warns: a quarter of an hour of recording."""
SYNCS = 8
"""Writes whose time is taken."""
SLOW_SYNC = 0.5
"""s. A node is made every 5 s, and each is one commit. The agent does not wait for it, but a loss of power
takes what waits."""


def clock() -> Iterator[Finding]:
    """Whether the clock is set, and synchronised."""
    now = time.time()
    words = datetime.fromtimestamp(now, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    if now < Path(__file__).stat().st_mtime - 86400.0:
        yield wrong(
            "clock",
            f"{words} is before Mapweave was installed",
            "connect to a network, or: sudo date -s TIME",
        )
        return
    match _synchronised():
        case "yes":
            yield good("clock", f"{words}, synchronised by the network")
        case "no":
            yield warning(
                "clock",
                f"{words}, not synchronised",
                "robots that share a clock merge better: sudo timedatectl set-ntp true",
            )
        case _:
            yield good("clock", f"{words}; whether it is synchronised is not known here")


def _synchronised() -> str:
    if shutil.which("timedatectl") is None:
        return ""
    command = ["timedatectl", "show", "--property=NTPSynchronized", "--value"]
    try:
        return subprocess.run(
            command, capture_output=True, text=True, timeout=3.0, check=False
        ).stdout.strip()
    except (OSError, subprocess.TimeoutExpired):
        return ""


def disk(folder: Path) -> Iterator[Finding]:
    """Whether the map can be written, and how long a commit takes."""
    there = next(parent for parent in (folder, *folder.resolve().parents) if parent.exists())
    try:
        free = shutil.disk_usage(there).free
        if not folder.exists():
            yield skipped("folder", f"{folder} is not there yet; {there} is examined in its place")
        times = _sync_times(there)
    except OSError as error:
        yield wrong("disk", f"{there}: {error.strerror}", "give another folder with --data, or free this one")
        return
    median = times[len(times) // 2]
    words = (
        f"{there}: {free / 1e9:.1f} GB free, fsync {1e3 * median:.1f} ms, at most {1e3 * times[-1]:.1f} ms"
    )
    if free < LEAST_FREE:
        yield wrong("disk", words, "free some space, or give another folder with --data")
    elif free < LITTLE_FREE:
        yield warning("disk", words, "free some space before you record")
    elif median > SLOW_SYNC:
        yield warning(
            "disk", words, "use another card or disk: this one loses seconds of a map with the power"
        )
    else:
        yield good("disk", words)


def _sync_times(folder: Path) -> list[float]:
    """(SYNCS,) s that it took to write 4 kB through to the disk, ascending."""
    times = []
    with tempfile.TemporaryFile(dir=folder) as file:
        for _ in range(SYNCS):
            file.write(bytes(4096))
            file.flush()
            began = time.perf_counter()
            os.fsync(file.fileno())
            times.append(time.perf_counter() - began)
    return sorted(times)

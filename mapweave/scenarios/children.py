"""Child processes: started, watched, ended in order."""

from __future__ import annotations

import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from mapweave.hybridmap.errors import MapweaveError
from mapweave.processes import parent_watchdog
from mapweave.storage.os_errors import NO_ROOM

LEAST_ROOM = 4096
"""Bytes: less than a block of the disk, so not even a line of a log is written."""


class ChildFailed(MapweaveError):
    """A child process ended although it should not have."""


def free_port() -> int:
    """A free TCP port on loopback."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Children:
    """Runs `mapweave` commands as processes. Their output goes to files; leaving ends them all.

    Should this process be killed, they end by themselves.
    """

    def __init__(self, logs: Path) -> None:
        """Choose the folder for their output."""
        logs.mkdir(parents=True, exist_ok=True)
        self._logs = logs
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Children:
        """Prepare; nothing runs yet."""
        return self

    def __exit__(self, *_: object) -> None:
        """End whatever still runs, last started first."""
        for name in list(self._running)[::-1]:
            self.end(name)

    def start(self, name: str, arguments: Sequence[str]) -> None:
        """Run `mapweave` with arguments."""
        with self._log(name).open("ab") as output:
            self._running[name] = subprocess.Popen(
                [sys.executable, "-m", "mapweave", *arguments],
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=parent_watchdog.environment(),
            )

    def pid(self, name: str) -> int:
        """The process's number."""
        return self._running[name].pid

    def check(self) -> None:
        """Raise ChildFailed if one has ended, with its last line of output."""
        for name, process in self._running.items():
            if process.poll() is not None:
                output = self._log(name).read_text(errors="replace").strip().splitlines()
                last = output[-1] if output else self._silence()
                raise ChildFailed(
                    f"{name} ended with status {process.returncode}: {last} ({self._log(name)})"
                )

    def end(self, *names: str, patience: float = 20.0) -> None:
        """Ask some to end, all at once, wait, and kill those that do not."""
        processes = [self._running.pop(name) for name in names if name in self._running]
        for process in processes:
            process.terminate()
        until = time.monotonic() + patience
        for process in processes:
            with process:
                try:
                    process.wait(max(0.0, until - time.monotonic()))
                except subprocess.TimeoutExpired:
                    process.kill()

    def kill(self, name: str) -> None:
        """End one at once, without a word (SIGKILL)."""
        process = self._running.pop(name, None)
        if process is not None:
            with process:
                process.kill()

    def _silence(self) -> str:
        """Why a process that failed may have printed nothing: it could not be written."""
        full = shutil.disk_usage(self._logs).free < LEAST_ROOM
        return f"it printed nothing; {NO_ROOM}" if full else "it printed nothing"

    def _log(self, name: str) -> Path:
        return self._logs / f"{name}.log"

"""A Ray cluster of several nodes on this machine, as real processes that can be killed."""

from __future__ import annotations

import itertools
import os
import secrets
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from mapweave.scenarios.children import free_port

START = 180.0
"""Longest wait for a node, s."""
STARTED = b"Ray runtime started"
"""What Ray says once a node has joined the cluster."""
STORE_BYTES = 80_000_000
"""Of a node's object store: the least that Ray takes is 75 MB."""


class RayNodes:
    """A head and further nodes, each with one processor. A context manager.

    Attributes:
        address: of the head.
        token: environment of who joins.
    """

    def __init__(self, nodes: int, folder: Path) -> None:
        """Choose how many; nothing runs yet.

        Args:
            nodes: with the head.
            folder: for logs. Ray's own files lie in a short path below /tmp: sockets need one.
        """
        self._count, self._folder = nodes, folder
        self._nodes: list[subprocess.Popen[bytes]] = []
        self._numbers = itertools.count()
        self._port = free_port()
        self.address = f"127.0.0.1:{self._port}"
        self.token = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}

    def __enter__(self) -> RayNodes:
        """Start them."""
        try:
            self.start_head()
            for _ in range(1, self._count):
                self._start(f"--address={self.address}")
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(self, *_: object) -> None:
        """End all that was started here."""
        for node in self._nodes[::-1]:
            self._end(node)

    def start_head(self) -> None:
        """Start a head, the first or another one at the same address."""
        self._start("--head", f"--port={self._port}", "--include-dashboard=false")

    def kill_head(self) -> None:
        """Kill -9 the head with all its processes."""
        self._end(self._nodes.pop(0), signal.SIGKILL)

    def processes(self, title: str) -> list[int]:
        """Ids of processes of these nodes whose title begins so, as Ray sets it."""
        mine = {pid for node in self._nodes for pid in descendants(node.pid)}
        return sorted(pid for pid in mine if _title(pid).startswith(title))

    def _start(self, *how: str) -> None:
        """Start a node, again if Ray gives up waiting for its own processes, as on a busy machine."""
        end = time.monotonic() + START
        while True:
            path = self._folder / f"ray{len(self._nodes)}-{next(self._numbers)}.log"
            with path.open("wb") as output:
                node = subprocess.Popen(
                    [
                        sys.executable, "-m", "ray.scripts.scripts", "start", *how,
                        "--node-ip-address=127.0.0.1", "--num-cpus=1",
                        f"--object-store-memory={STORE_BYTES}", "--block", "--disable-usage-stats",
                    ],
                    stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
                    start_new_session=True, env={**os.environ, **self.token},
                )  # fmt: skip
            while node.poll() is None and time.monotonic() < end:
                if STARTED in path.read_bytes():
                    self._nodes.insert(0 if "--head" in how else len(self._nodes), node)
                    return
                time.sleep(0.2)
            self._end(node)
            if time.monotonic() >= end:
                words = path.read_text(errors="replace").strip().splitlines()[-1:]
                raise SystemExit(f"a node of the cluster does not start in {START:g} s: {' '.join(words)}")

    def _end(self, node: subprocess.Popen[bytes], how: signal.Signals = signal.SIGTERM) -> None:
        known = list(descendants(node.pid))
        with node:
            node.send_signal(how)
            try:
                node.wait(0.1 if how is signal.SIGKILL else 15.0)
            except subprocess.TimeoutExpired:
                node.kill()
            for pid in known:
                _kill(pid)


def descendants(pid: int) -> Iterator[int]:
    """The descendants of a process, by /proc."""
    children: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                parent = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
            except (OSError, IndexError):
                continue
            children.setdefault(parent, []).append(int(entry.name))
    left = children.get(pid, [])
    while left:
        one = left.pop()
        yield one
        left += children.get(one, [])


def _title(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0", 1)[0].decode(errors="replace")
    except OSError:
        return ""


def _kill(pid: int) -> None:
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)

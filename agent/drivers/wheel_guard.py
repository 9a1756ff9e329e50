"""Stops the wheels of a base that does not stop by itself, also when the driver's process is dead or hangs.

A process of its own that shares the open port. Run as a program it reads from its standard input `1` for each
command that moves the robot and `0` for each that does not, and writes the bytes that stop the wheels to its
standard output, the port: when nothing was read for a while after a `1`, and when its input ends.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import subprocess
import sys

SILENCE = 0.3
"""s after the last command until the wheels are stopped; an agent gives one each 0.1 s."""


class WheelGuard:
    """The guard of one open port, seen from the driver."""

    def __init__(self, port: int, stop: bytes) -> None:
        """Start it.

        Args:
            port: file descriptor of the open port.
            stop: bytes that stop the wheels, whatever was written before them.
        """
        # Alone and without site packages it starts in some ten milliseconds. A session of its own: Ctrl-C in
        # the terminal stops the driver, and the guard only then.
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", __file__, stop.hex(), str(SILENCE)],
            stdin=subprocess.PIPE, stdout=port, start_new_session=True,
        )  # fmt: skip
        assert self._process.stdin is not None
        self._pipe = self._process.stdin.fileno()
        os.set_blocking(self._pipe, False)

    def moving(self, moving: bool) -> None:
        """A command has just been given. Never waits."""
        # A full pipe: the guard hangs on the port, and has more to read than it needs.
        with contextlib.suppress(BlockingIOError, BrokenPipeError):
            os.write(self._pipe, b"1" if moving else b"0")

    def close(self) -> None:
        """Let it stop the wheels for the last time, and end."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        try:
            self._process.wait(0.5)
        except subprocess.TimeoutExpired:
            # The port does not take the bytes.
            self._process.kill()
            self._process.wait()


def _write(data: bytes) -> None:
    # A port that has vanished takes the wheels' line with it: nothing is left to be done.
    with contextlib.suppress(OSError):
        os.write(1, data)


def main(stop: bytes, silence: float) -> None:
    """Guard until the input ends."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        # The end of the driver's process is what counts.
        signal.signal(number, signal.SIG_IGN)
    moving = False
    while True:
        ready, _, _ = select.select([0], [], [], silence if moving else None)
        said = os.read(0, 4096) if ready else b"0"
        if not said:
            break
        moving = said[-1:] == b"1"
        if not ready:
            _write(stop)
    _write(stop)


if __name__ == "__main__":
    main(bytes.fromhex(sys.argv[1]), float(sys.argv[2]))

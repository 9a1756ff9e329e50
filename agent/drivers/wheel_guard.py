"""Stops the wheels of a base without hardware watchdog when commands cease or the driver process dies.

The guard is a separate process that shares the open port. It reads `1` from its standard input for each
command that moves the robot and `0` for each that does not. It writes the stop command to its standard
output, the port, when nothing was read for a while after a `1`, and when its input ends.
"""

import contextlib
import os
import select
import signal
import subprocess
import sys
from collections.abc import Callable

SILENCE = 0.3
"""s after the last command until the wheels are stopped; an agent gives one each 0.1 s."""


class WheelGuard:
    """Handle of the guard of one open port."""

    def __init__(self, port: int, stop: bytes) -> None:
        """Start the guard process.

        Args:
            port: file descriptor of the open port.
            stop: bytes that stop the wheels, even after an incomplete command.
        """
        # Without site packages the process starts in some ten milliseconds.
        self._start([sys.executable, "-I", "-S", __file__, stop.hex(), str(SILENCE)], port)

    def _start(self, command: list[str], output: int) -> None:
        """Start the process; its standard output is a file descriptor, or what `subprocess` takes."""
        # A new session: Ctrl-C in the terminal must not end the guard before the driver.
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=output, start_new_session=True
        )
        assert self._process.stdin is not None
        self._pipe = self._process.stdin.fileno()
        os.set_blocking(self._pipe, False)

    def moving(self, moving: bool) -> None:
        """Report a command. Does not block."""
        # The pipe is full if the guard is blocked by the port; then it has enough to read.
        with contextlib.suppress(BlockingIOError, BrokenPipeError):
            os.write(self._pipe, b"1" if moving else b"0")

    def close(self) -> None:
        """Stop the wheels and end the guard process."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        try:
            self._process.wait(0.5)
        except subprocess.TimeoutExpired:
            # The port is blocked.
            self._process.kill()
            self._process.wait()


def _write(data: bytes) -> None:
    # The port has vanished: the wheels cannot be reached.
    with contextlib.suppress(OSError):
        os.write(1, data)


def watch(stop: Callable[[], None], silence: float) -> None:
    """Run until the input ends.

    Args:
        stop: stops the wheels.
        silence: s without a command after which it is called.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        # Only the end of the driver process ends the guard.
        signal.signal(number, signal.SIG_IGN)
    moving = False
    while True:
        ready, _, _ = select.select([0], [], [], silence if moving else None)
        said = os.read(0, 4096) if ready else b"0"
        if not said:
            break
        moving = said[-1:] == b"1"
        if not ready:
            stop()
    stop()


if __name__ == "__main__":
    _stop = bytes.fromhex(sys.argv[1])
    watch(lambda: _write(_stop), float(sys.argv[2]))

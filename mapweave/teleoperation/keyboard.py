"""Velocity commands from the keys of a terminal."""

from __future__ import annotations

import os
import sys
import termios
import tty

from mapweave.hybridmap.errors import DeviceError

HELD = 0.6
"""A terminal says when a key is pressed, not when it is released: it counts as held for so long after it was
pressed or repeated, s; longer than the usual delay before the first repetition, 0.5 s."""
STEP = 0.1
"""By which + and - change the speed, as a share of the limits."""
FORWARD = {b"w": 1.0, b"s": -1.0, b"\x1b[A": 1.0, b"\x1b[B": -1.0, b"\x1bOA": 1.0, b"\x1bOB": -1.0}
TURN = {b"a": 1.0, b"d": -1.0, b"\x1b[D": 1.0, b"\x1b[C": -1.0, b"\x1bOD": 1.0, b"\x1bOC": -1.0}
QUIT = (b"q", b"\x03", b"\x04")
HELP = "arrows or w a s d drive, space stops, + - speed, q quits"


class Keyboard:
    """What the keys want, from the bytes that a terminal sends.

    Attributes:
        quit: whether a key asked for the end.
        speed: share of the robot's limits.
    """

    def __init__(self, speed: float) -> None:
        """No key is held.

        Args:
            speed: share of the robot's limits, 0 to 1.
        """
        self.quit = False
        self.speed = speed
        self._rest = b""
        self._forward = self._turn = (0.0, -HELD)

    def feed(self, data: bytes, now: float) -> None:
        """Take bytes of the terminal; a sequence may come in pieces.

        Args:
            data: read.
            now: s, of any clock that does not jump.
        """
        self._rest += data
        while self._rest:
            length = 1
            if self._rest[:1] == b"\x1b":
                # An arrow key is three bytes; Escape alone is not distinguished from its beginning.
                if len(self._rest) < 3 and self._rest[1:2] in (b"", b"[", b"O"):
                    return
                length = 3 if self._rest[1:2] in (b"[", b"O") else 1
            key, self._rest = self._rest[:length], self._rest[length:]
            self._press(key if length > 1 else key.lower(), now)

    def _press(self, key: bytes, now: float) -> None:
        if key in FORWARD:
            self._forward = FORWARD[key], now
        elif key in TURN:
            self._turn = TURN[key], now
        elif key == b" ":
            self._forward = self._turn = (0.0, now)
        elif key in (b"+", b"="):
            self.speed = min(self.speed + STEP, 1.0)
        elif key == b"-":
            self.speed = max(self.speed - STEP, STEP)
        elif key in QUIT:
            self.quit = True

    def wanted(self, now: float) -> tuple[float, float]:
        """Forward and turn, each a share of the robot's limit, -1 to 1; turn is positive to the left."""
        forward, turn = (
            share if now - pressed < HELD else 0.0 for share, pressed in (self._forward, self._turn)
        )
        return forward * self.speed, turn * self.speed


class RawTerminal:
    """The standard input, key by key and without echo; as it was before at the end."""

    def __init__(self) -> None:
        """Check that it is a terminal.

        Raises:
            DeviceError: it is none.
        """
        if not sys.stdin.isatty():
            raise DeviceError("the keyboard needs a terminal; without one give --gamepad DEVICE")
        self._fd = sys.stdin.fileno()
        self._before = termios.tcgetattr(self._fd)

    def __enter__(self) -> RawTerminal:
        """Take single keys. Ctrl-C stays a signal."""
        tty.setcbreak(self._fd)
        return self

    def __exit__(self, *_: object) -> None:
        """Restore the terminal as it was before, if it is still there."""
        if not self.gone:
            termios.tcsetattr(self._fd, termios.TCSADRAIN, self._before)

    def fileno(self) -> int:
        """The file descriptor for `select`."""
        return self._fd

    @property
    def gone(self) -> bool:
        """Whether it was closed, as by the loss of a connection by ssh."""
        try:
            termios.tcgetattr(self._fd)
        except termios.error:
            return True
        return False

    def read(self) -> bytes:
        """Bytes that are there; none at its end."""
        try:
            return os.read(self._fd, 1024)
        except OSError:
            return b""

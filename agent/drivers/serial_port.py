"""Serial port for drivers: reads with a time limit, errors as one line of text."""

import contextlib
import termios
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import serial

from mapweave.agent.drivers.wheel_guard import WheelGuard
from mapweave.hybridmap.errors import DeviceError

TIMEOUT = 0.3
"""s; the supported robots answer faster."""
LONGEST_LINE = 4096
"""Bytes; longer input without an end of line is discarded as noise."""


@dataclass(frozen=True)
class SerialOptions:
    """The table `[robot.options]` of a robot behind a serial port.

    Attributes:
        port: serial device.
    """

    port: str


class SerialPort:
    """An open port, locked against other processes."""

    def __init__(self, path: str, baud: int, stop_bits: int = 1) -> None:
        """Open the port.

        Args:
            path: of the device, or a URL of pyserial (`socket://host:port`).
            baud: bits a second.
            stop_bits: 1 or 2.

        Raises:
            DeviceError: the port is missing or in use.
        """
        self.path = path
        self._baud = baud
        self._rest = b""
        try:
            self._serial: Any = serial.serial_for_url(
                path, baud, stopbits=stop_bits, timeout=TIMEOUT, write_timeout=TIMEOUT, exclusive=True
            )
        except (serial.SerialException, termios.error, ValueError, OSError) as error:
            raise DeviceError(f"{path}: {_reason(error)}") from error

    @property
    def descriptor(self) -> int:
        """The file descriptor."""
        return int(self._serial.fileno())

    def close(self) -> None:
        """Close the port. Never raises."""
        with contextlib.suppress(serial.SerialException, termios.error, OSError):
            self._serial.close()

    def write(self, data: bytes) -> None:
        """Send bytes.

        Raises:
            DeviceError: the port is gone or blocked.
        """
        with self._failing():
            self._serial.write(data)

    def clear(self) -> None:
        """Discard unread input."""
        with self._failing():
            self._serial.reset_input_buffer()
        self._rest = b""

    def read(self, count: int) -> bytes:
        """Read a number of bytes.

        Raises:
            DeviceError: they do not arrive in time.
        """
        with self._failing():
            data = bytes(self._serial.read(count))
        if len(data) < count:
            raise self._unanswered(len(data))
        return data

    def line(self) -> str:
        """Read the next non-empty line, without its end. CR and LF both end a line.

        Raises:
            DeviceError: none arrives in time.
        """
        end = time.monotonic() + TIMEOUT
        while True:
            if b"\n" in self._rest:
                line, _, rest = self._rest.partition(b"\n")
                self._rest = rest.lstrip(b" \n")
                return line.decode("ascii", "replace").strip()
            if time.monotonic() >= end or len(self._rest) > LONGEST_LINE:
                raise self._unanswered(len(self._rest))
            self._take(1)

    def line_waiting(self) -> bool:
        """Whether a line can be read without waiting."""
        self._take(0)
        return b"\n" in self._rest

    def _take(self, least: int) -> None:
        """Read all input that has arrived, at least this number of bytes."""
        with self._failing():
            came = self._serial.read(max(least, self._serial.in_waiting))
        # Empty lines are skipped.
        self._rest = (self._rest + came).replace(b"\r", b"\n").lstrip(b" \n")

    def _unanswered(self, came: int) -> DeviceError:
        if came:
            return DeviceError(
                f"{self.path}: {came} bytes came, and no whole answer for {TIMEOUT:g} s; "
                f"is the robot at this port, and {self._baud} its baud rate?"
            )
        return DeviceError(
            f"{self.path}: no answer for {TIMEOUT:g} s; is the robot switched on, and at this port?"
        )

    @contextlib.contextmanager
    def _failing(self) -> Iterator[None]:
        try:
            yield
        except (serial.SerialException, termios.error, OSError, TypeError) as error:
            # TypeError: pyserial's, if a port is closed while it is read.
            raise DeviceError(f"{self.path}: {_reason(error)}") from error


def _reason(error: Exception) -> str:
    # The errors of termios have their number as the first argument, and no attribute.
    number = error.args[0] if isinstance(error, termios.error) else getattr(error, "errno", None)
    words = str(error)
    if number == 2 or "No such file" in words:
        return "there is no such port; is the robot connected and switched on?"
    if number == 13 or "Permission denied" in words:
        return "may not be opened: add your user to the group that owns it (often dialout) and log in again"
    if "Inappropriate ioctl" in words or "Is a directory" in words:
        return "is no serial port"
    if number == 11 or "exclusively lock" in words:
        return "is in use by another process"
    if isinstance(error, serial.SerialTimeoutException):
        return f"takes no bytes for {TIMEOUT:g} s"
    gone = number == 5 or "disconnected" in words or "Errno 5" in words
    return "the port is gone" if gone else " ".join(words.split())


class GuardedBase:
    """An open port and the guard that stops the wheels behind it: of bases without a hardware watchdog."""

    def __init__(self, path: str) -> None:
        """Create a base without opening its port."""
        self._path = path
        self._port: SerialPort | None = None
        self._guard: WheelGuard | None = None

    def close(self) -> None:
        """Stop the wheels by the guard, and close the port."""
        if self._guard is not None:
            self._guard.close()
            self._guard = None
        if self._port is not None:
            self._port.close()
            self._port = None

"""Waveshare UGV (Rover, Beast, RaspRover): JSON in lines over the serial port, or one at a time over HTTP."""

import contextlib
import errno
import http.client
import json
import socket
import time
import urllib.parse
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from mapweave.agent.drivers.base import BaseReading, Wheels
from mapweave.agent.drivers.serial_port import SerialPort
from mapweave.agent.drivers.settings import Geometry, RobotSettings
from mapweave.agent.drivers.wheeled import WheeledRobot
from mapweave.hybridmap.errors import DeviceError, SettingsError


class AddressLock:
    """Held until closed, or until the process ends.

    The lock is a name in Linux's abstract namespace of sockets: it leaves no file behind, and holds for all
    users of the machine. Programs on other machines do not see it.
    """

    def __init__(self, host: str, port: int) -> None:
        """Take the lock.

        Args:
            host: IP address of the robot: one robot may have several names.
            port: of its server.

        Raises:
            DeviceError: another driver holds it.
        """
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._socket.bind(f"\0mapweave/robot/{host}/{port}")
        except OSError as error:
            self._socket.close()
            reason = "is in use by another process" if error.errno == errno.EADDRINUSE else error.strerror
            raise DeviceError(f"http://{host}:{port}: {reason}") from error

    def close(self) -> None:
        """Release the lock. May be called twice."""
        self._socket.close()


SPEEDS, FEEDBACK, STREAM, WATCHDOG, INTERVAL, ECHO = 1, 130, 131, 136, 142, 143
"""`T` of the commands."""
BASE_INFO = 1001
"""`T` of the answer."""
WATCHDOG_MS = 300
"""The base stops by itself after this time without a command; the default of the firmware is 3000."""
STREAM_MS = 50
"""Period of the stream."""
FASTEST = 0.5
"""Largest speed of a command, m/s."""
TIMEOUT = 0.5
"""s for an answer over HTTP, and for a line about the wheels."""

LARGEST_SPEED = 5.0
"""m/s; a greater value means a damaged line."""
LARGEST_ODOMETER = 1e9
"""cm."""

Json = dict[str, Any]


class BaseInfo(NamedTuple):
    """State of the base.

    Attributes:
        speeds: measured, m/s.
        odometers: distances since power on, m; None if the firmware has no odometers.
    """

    speeds: Wheels
    odometers: Wheels | None = None


@dataclass(frozen=True)
class WaveshareOptions:
    """The table `[robot.options]`.

    Attributes:
        port: serial device, or the address of its HTTP server: `http://192.168.4.1`.
    """

    port: str


class Line(Protocol):
    """Transport of commands and answers. Each method may raise DeviceError."""

    def send(self, command: Json) -> None:
        """Send a command."""

    def feedback(self) -> BaseInfo:
        """Read the newest state of the wheels."""

    def close(self) -> None:
        """Close the connection."""


class SerialLine:
    """Lines of JSON over a serial port; the base streams its state."""

    def __init__(self, path: str) -> None:
        """Open the port and start the stream."""
        self._port = SerialPort(path, 115200)
        self.send({"T": ECHO, "cmd": 0})
        self.send({"T": INTERVAL, "cmd": STREAM_MS})
        self.send({"T": STREAM, "cmd": 1})

    def send(self, command: Json) -> None:
        """Send a line."""
        self._port.write(json.dumps(command, separators=(",", ":")).encode() + b"\n")

    def feedback(self) -> BaseInfo:
        """Wait for a line; returns the newest."""
        end = time.monotonic() + TIMEOUT
        newest: BaseInfo | None = None
        while newest is None or self._port.line_waiting():
            line = self._port.line()
            newest = parse_info(line) or newest
            if newest is None and time.monotonic() >= end:
                raise DeviceError(f"{self._port.path}: {line[:80]!r} is not what a UGV's base streams")
        return newest

    def close(self) -> None:
        """Close the port."""
        self._port.close()


class HttpLine:
    """Requests to the HTTP server of the base, over one connection. No second driver of this machine may."""

    def __init__(self, address: str) -> None:
        """Connect, without a request.

        Raises:
            DeviceError: no one answers there, or another driver uses the base.
        """
        where = urllib.parse.urlsplit(address)
        self._address = address
        self._connection = http.client.HTTPConnection(where.hostname or "", where.port or 80, timeout=TIMEOUT)
        try:
            self._connection.connect()
            host, port = self._connection.sock.getpeername()[:2]
        except OSError as error:
            raise self._failed(error) from error
        try:
            self._lock = AddressLock(host, port)
        except DeviceError:
            self._connection.close()
            raise

    def send(self, command: Json) -> None:
        """Send a request and ignore its answer."""
        self._ask(command)

    def feedback(self) -> BaseInfo:
        """Request the state."""
        info = parse_info(self._ask({"T": FEEDBACK}))
        if info is None:
            raise DeviceError(f"{self._address}: no state of the base in the answer")
        return info

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()
        self._lock.close()

    def _ask(self, command: Json) -> str:
        query = urllib.parse.urlencode({"json": json.dumps(command, separators=(",", ":"))})
        try:
            self._connection.request("GET", f"/js?{query}")
            return self._connection.getresponse().read().decode("utf-8", "replace")
        except (OSError, http.client.HTTPException) as error:
            raise self._failed(error) from error

    def _failed(self, error: Exception) -> DeviceError:
        self._connection.close()
        reason = getattr(error, "strerror", None) or " ".join(str(error).split()) or type(error).__name__
        return DeviceError(
            f"{self._address}: {reason}; is the robot switched on, and this computer in its network?"
        )


def parse_info(text: str) -> BaseInfo | None:
    """Parse an answer; None if it is incomplete or not about the wheels."""
    try:
        answer = json.loads(text)
    except (ValueError, RecursionError):
        return None
    if not isinstance(answer, dict) or answer.get("T") != BASE_INFO:
        return None
    speeds = _pair(answer, "L", "R", 1.0, LARGEST_SPEED)
    return None if speeds is None else BaseInfo(speeds, _pair(answer, "odl", "odr", 0.01, LARGEST_ODOMETER))


def _pair(answer: Json, left: str, right: str, scale: float, largest: float) -> Wheels | None:
    """Two numbers of an answer times a scale; None if they are missing or out of range."""
    values = [answer.get(left), answer.get(right)]
    numbers = [scale * v for v in values if isinstance(v, int | float) and -largest <= v <= largest]
    return Wheels(*numbers) if len(numbers) == 2 else None


def _is_address(text: str) -> bool:
    """Whether it is the address of an HTTP server."""
    try:
        where = urllib.parse.urlsplit(text)
        return where.scheme == "http" and bool(where.hostname) and where.port != 0
    except ValueError:
        return False


class WaveshareBase:
    """The base. Its firmware has a watchdog."""

    geometry = Geometry(radius=0.15, axle=0.172, max_forward=0.3, max_turn=0.8)

    def __init__(self, port: str) -> None:
        """Create a base without connecting."""
        self._path = port
        self._line: Line | None = None
        self._way = Wheels()
        self._last: tuple[float, Wheels, Wheels | None] | None = None

    def open(self) -> None:
        """Connect, shorten the watchdog and stop the wheels."""
        self._line = HttpLine(self._path) if self._path.startswith("http://") else SerialLine(self._path)
        self._line.send({"T": WATCHDOG, "cmd": WATCHDOG_MS})
        self.drive(Wheels())
        self._last = None

    def close(self) -> None:
        """Stop the wheels and disconnect. If the line has failed, the watchdog stops them."""
        if self._line is not None:
            with contextlib.suppress(DeviceError):
                self.drive(Wheels())
            self._line.close()
            self._line = None

    def nearest(self, speeds: Wheels) -> Wheels:
        """Round to whole mm/s."""
        left, right = (min(max(round(speed, 3), -FASTEST), FASTEST) for speed in speeds)
        return Wheels(left, right)

    def drive(self, speeds: Wheels) -> None:
        """Send speeds."""
        assert self._line is not None
        left, right = self.nearest(speeds)
        self._line.send({"T": SPEEDS, "L": left, "R": right})

    def read(self) -> BaseReading:
        """Read the odometers, or integrate the measured speeds where there are none."""
        assert self._line is not None
        (speeds, odometers), now = self._line.feedback(), time.monotonic()
        if self._last is not None:
            then, before, odometers_before = self._last
            if odometers is not None and odometers_before is not None:
                ways = [odometers[k] - odometers_before[k] for k in (0, 1)]
            else:
                ways = [(speeds[k] + before[k]) / 2 * (now - then) for k in (0, 1)]
            self._way = Wheels(self._way.left + ways[0], self._way.right + ways[1])
        self._last = (now, speeds, odometers)
        return BaseReading(self._way)


class Waveshare(WheeledRobot):
    """Waveshare UGV Rover, Beast and RaspRover over serial or HTTP."""

    def __init__(self, settings: RobotSettings) -> None:
        """Connect to the port or address in the options.

        Raises:
            SettingsError: the address is none.
        """
        options = settings.options_as(WaveshareOptions)
        if "://" in options.port and not _is_address(options.port):
            raise SettingsError(
                f"[robot.options]: port {options.port!r} is neither a serial device nor http://ADDRESS[:PORT]"
            )
        super().__init__(WaveshareBase(options.port), settings)

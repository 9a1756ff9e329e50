"""Waveshare UGV (Rover, Beast, RaspRover): JSON in lines over the serial port, or one at a time over HTTP."""

from __future__ import annotations

import contextlib
import http.client
import json
import time
import urllib.parse
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from mapweave.agent.drivers.base import BaseReading, Wheels
from mapweave.agent.drivers.serial_port import SerialPort
from mapweave.agent.drivers.settings import Geometry, RobotSettings
from mapweave.agent.drivers.wheeled import WheeledRobot
from mapweave.hybridmap.errors import DeviceError
from mapweave.storage.settings_file import build

SPEEDS, FEEDBACK, STREAM, WATCHDOG, INTERVAL, ECHO = 1, 130, 131, 136, 142, 143
"""`T` of the commands."""
BASE_INFO = 1001
"""`T` of the answer."""
WATCHDOG_MS = 300
"""The base stops by itself so long after the last command; 3000 unless it is told."""
STREAM_MS = 50
"""Between two answers of the stream."""
FASTEST = 0.5
"""m/s that a command can say."""
TIMEOUT = 0.5
"""s for an answer over HTTP, which a network carries."""

LARGEST_SPEED = 5.0
"""m/s; more is a line that was damaged."""
LARGEST_ODOMETER = 1e9
"""cm."""

Json = dict[str, Any]


class BaseInfo(NamedTuple):
    """What an answer says.

    Attributes:
        speeds: measured, m/s.
        odometers: ways since the base was switched on, m; None if the firmware has none.
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
    """How commands get there and answers come back. Each method raises DeviceError."""

    def send(self, command: Json) -> None:
        """Send a command."""
        ...

    def feedback(self) -> BaseInfo:
        """The newest answer that says how the wheels turn."""
        ...

    def close(self) -> None:
        """Let go."""
        ...


class SerialLine:
    """Lines of JSON; the base streams."""

    def __init__(self, path: str) -> None:
        """Open the port and begin the stream."""
        self._port = SerialPort(path, 115200)
        self.send({"T": ECHO, "cmd": 0})
        self.send({"T": INTERVAL, "cmd": STREAM_MS})
        self.send({"T": STREAM, "cmd": 1})

    def send(self, command: Json) -> None:
        """A line."""
        self._port.write(json.dumps(command, separators=(",", ":")).encode() + b"\n")

    def feedback(self) -> BaseInfo:
        """The newest line; waits for one."""
        newest: BaseInfo | None = None
        while newest is None or self._port.line_waiting():
            newest = parse_info(self._port.line()) or newest
        return newest

    def close(self) -> None:
        """Close the port."""
        self._port.close()


class HttpLine:
    """Questions to the base's HTTP server, over one connection."""

    def __init__(self, address: str) -> None:
        """Nothing is asked yet."""
        where = urllib.parse.urlsplit(address)
        self._address = address
        self._connection = http.client.HTTPConnection(where.hostname or "", where.port or 80, timeout=TIMEOUT)

    def send(self, command: Json) -> None:
        """Ask and forget the answer."""
        self._ask(command)

    def feedback(self) -> BaseInfo:
        """Ask for it."""
        info = parse_info(self._ask({"T": FEEDBACK}))
        if info is None:
            raise DeviceError(f"{self._address}: no answer about the base")
        return info

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()

    def _ask(self, command: Json) -> str:
        query = urllib.parse.urlencode({"json": json.dumps(command, separators=(",", ":"))})
        try:
            self._connection.request("GET", f"/js?{query}")
            return self._connection.getresponse().read().decode("utf-8", "replace")
        except (OSError, http.client.HTTPException) as error:
            self._connection.close()
            raise DeviceError(
                f"{self._address}: {' '.join(str(error).split()) or type(error).__name__}"
            ) from error


def parse_info(text: str) -> BaseInfo | None:
    """What an answer says of the wheels; None if it is about something else, or half of it."""
    try:
        answer = json.loads(text)
    except (ValueError, RecursionError):
        return None
    if not isinstance(answer, dict) or answer.get("T") != BASE_INFO:
        return None
    speeds = [answer.get(name) for name in ("L", "R")]
    odometers = [answer.get(name) for name in ("odl", "odr")]
    if not all(_is_number(speed, LARGEST_SPEED) for speed in speeds):
        return None
    info = BaseInfo(Wheels(*map(float, speeds)))
    if all(_is_number(centimetres, LARGEST_ODOMETER) for centimetres in odometers):
        info = info._replace(odometers=Wheels(*(float(centimetres) / 100.0 for centimetres in odometers)))
    return info


def _is_number(value: Any, largest: float) -> bool:
    return isinstance(value, int | float) and -largest <= value <= largest


class WaveshareBase:
    """The base. Its firmware has a watchdog."""

    geometry = Geometry(radius=0.15, axle=0.172, max_forward=0.3, max_turn=0.8)

    def __init__(self, port: str) -> None:
        """Nothing is opened yet."""
        self._path = port
        self._line: Line | None = None
        self._way = Wheels()
        self._last: tuple[float, Wheels, Wheels | None] | None = None

    def open(self) -> None:
        """Connect, shorten the watchdog and stand."""
        self._line = HttpLine(self._path) if self._path.startswith("http://") else SerialLine(self._path)
        self._line.send({"T": WATCHDOG, "cmd": WATCHDOG_MS})
        self.drive(Wheels())
        self._last = None

    def close(self) -> None:
        """Stop and let go; should the line have failed, the watchdog stops the wheels."""
        if self._line is not None:
            with contextlib.suppress(DeviceError):
                self.drive(Wheels())
            self._line.close()
            self._line = None

    def nearest(self, speeds: Wheels) -> Wheels:
        """In whole mm/s."""
        left, right = (min(max(round(speed, 3), -FASTEST), FASTEST) for speed in speeds)
        return Wheels(left, right)

    def drive(self, speeds: Wheels) -> None:
        """Send a speed."""
        assert self._line is not None
        left, right = self.nearest(speeds)
        self._line.send({"T": SPEEDS, "L": left, "R": right})

    def read(self) -> BaseReading:
        """Odometers where the firmware has them, else the sum of the measured speeds."""
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
        """Connect to the port or address of the options."""
        options = build(WaveshareOptions, settings.options, "[robot.options]")
        super().__init__(WaveshareBase(options.port), settings)

"""Any two-wheeled robot with a microcontroller and the text protocol of docs/arduino.md."""

import math
import re
import time
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta

from mapweave.agent.drivers.base import BaseReading, Wheels
from mapweave.agent.drivers.serial_base import SerialBase
from mapweave.agent.drivers.serial_port import TIMEOUT, SerialPort
from mapweave.agent.drivers.settings import Geometry, Positive, RobotSettings
from mapweave.agent.drivers.wheeled import WheeledRobot
from mapweave.hybridmap.errors import DeviceError

STATE = re.compile(r"S( -?[0-9]{1,10}){2} [01]( -?[0-9]{1,6}){0,256}")
BOOT = 3.0
"""s that a board may take to start; many boards restart when the port is opened."""


@dataclass(frozen=True)
class ArduinoOptions:
    """The table `[robot.options]`.

    Attributes:
        port: serial device.
        wheel_radius: m.
        counts_per_turn: of a wheel's encoder.
        baud: as set in the sketch.
    """

    port: str
    wheel_radius: Positive
    counts_per_turn: Positive
    baud: Annotated[int, Meta(ge=50, le=10_000_000)] = 115200


class ArduinoBase(SerialBase):
    """The base. The sketch has a watchdog."""

    geometry = Geometry(max_forward=0.3, max_turn=0.8)

    def __init__(self, options: ArduinoOptions, settings: RobotSettings) -> None:
        """Create a base without opening the port; the settings have its proximity sensors."""
        self.baud = options.baud
        self.metres_per_count = math.tau * options.wheel_radius / options.counts_per_turn
        super().__init__(settings)
        self._rangers = len(settings.geometry.ranger_bearings_deg or ())
        self._reach = settings.geometry.ranger_reach or 0.0

    def open(self) -> None:
        """Open the port and wait for the board to start."""
        self._port = SerialPort(self._path, self.baud)
        end = time.monotonic() + BOOT
        while True:
            try:
                self.read()
                break
            except DeviceError:
                if time.monotonic() >= end:
                    raise
        self.drive(Wheels())

    def drive(self, speeds: Wheels) -> None:
        """Send speeds, in mm/s."""
        self.send(f"D {round(speeds.left * 1e3)} {round(speeds.right * 1e3)}")

    def read(self) -> BaseReading:
        """Wait for a line of the stream; returns the newest. Incomplete lines are skipped."""
        assert self._port is not None
        end = time.monotonic() + TIMEOUT
        newest: list[int] | None = None
        while newest is None or self._port.line_waiting():
            line = self._port.line()
            newest = parse_state(line) or newest
            if newest is None and time.monotonic() >= end:
                raise DeviceError(
                    f"{self._path}: {line!r} is not 'S left right bumped cm ...'; "
                    f"is {self.baud} the baud rate of the sketch?"
                )
        left, right, bumped, *centimetres = newest
        if len(centimetres) != self._rangers:
            raise DeviceError(
                f"{self._path}: {len(centimetres)} distances, but [robot.geometry] has "
                f"{self._rangers} ranger_bearings_deg"
            )
        distances = np.array(centimetres, dtype=np.float64) / 100.0
        proximity = np.where(distances < 0.0, self._reach, np.minimum(distances, self._reach))
        return BaseReading(self.way(left, right), proximity, bool(bumped))


def parse_state(line: str) -> list[int] | None:
    """Parse left and right count, bumper and centimetres; None for any other line."""
    return [int(part) for part in line.split()[1:]] if STATE.fullmatch(line) else None


class Arduino(WheeledRobot):
    """Any Arduino with ten lines of text protocol (docs/arduino.md)."""

    def __init__(self, settings: RobotSettings) -> None:
        """Connect to the port in the options."""
        super().__init__(ArduinoBase(settings.options_as(ArduinoOptions), settings), settings)

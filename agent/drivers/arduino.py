"""Any two-wheeled robot with a microcontroller and the text protocol of docs/arduino.md."""

from __future__ import annotations

import contextlib
import math
import re
import time
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta

from mapweave.agent.drivers.base import BaseReading, WheelCounter, Wheels
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


class ArduinoBase:
    """The base. The sketch has a watchdog."""

    geometry = Geometry(max_forward=0.3, max_turn=0.8)

    def __init__(self, options: ArduinoOptions, geometry: Geometry) -> None:
        """Create a base without opening the port.

        Args:
            options: port and wheels.
            geometry: proximity sensors of the settings.
        """
        self._options = options
        self._rangers = len(geometry.ranger_bearings_deg or ())
        self._reach = geometry.ranger_reach or 0.0
        self._port: SerialPort | None = None
        scale = math.tau * options.wheel_radius / options.counts_per_turn
        self._counters = [WheelCounter(scale, 32, 3.0) for _ in range(2)]

    def open(self) -> None:
        """Open the port and wait for the board to start."""
        self._port = SerialPort(self._options.port, self._options.baud)
        end = time.monotonic() + BOOT
        while True:
            try:
                self.read()
                break
            except DeviceError:
                if time.monotonic() >= end:
                    raise
        self.drive(Wheels())

    def close(self) -> None:
        """Stop the wheels and close the port."""
        if self._port is not None:
            with contextlib.suppress(DeviceError):
                self.drive(Wheels())
            self._port.close()
            self._port = None

    def nearest(self, speeds: Wheels) -> Wheels:
        """Round to whole mm/s."""
        return Wheels(round(speeds.left * 1e3) / 1e3, round(speeds.right * 1e3) / 1e3)

    def drive(self, speeds: Wheels) -> None:
        """Send speeds."""
        assert self._port is not None
        self._port.write(f"D {round(speeds.left * 1e3)} {round(speeds.right * 1e3)}\n".encode())

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
                    f"{self._options.port}: {line!r} is not 'S left right bumped cm ...'; "
                    f"is {self._options.baud} the baud rate of the sketch?"
                )
        left, right, bumped, *centimetres = newest
        if len(centimetres) != self._rangers:
            raise DeviceError(
                f"{self._options.port}: {len(centimetres)} distances, but [robot.geometry] has "
                f"{self._rangers} ranger_bearings_deg"
            )
        now = time.monotonic()
        way = Wheels(self._counters[0].update(left, now), self._counters[1].update(right, now))
        distances = np.array(centimetres, dtype=np.float64) / 100.0
        proximity = np.where(distances < 0.0, self._reach, np.minimum(distances, self._reach))
        return BaseReading(way, proximity, bool(bumped))


def parse_state(line: str) -> list[int] | None:
    """Parse left and right count, bumper and centimetres; None for any other line."""
    return [int(part) for part in line.split()[1:]] if STATE.fullmatch(line) else None


class Arduino(WheeledRobot):
    """Any Arduino with ten lines of text protocol (docs/arduino.md)."""

    def __init__(self, settings: RobotSettings) -> None:
        """Connect to the port in the options."""
        options = settings.options_as(ArduinoOptions)
        super().__init__(ArduinoBase(options, settings.geometry), settings)

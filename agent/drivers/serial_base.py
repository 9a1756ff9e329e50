"""A base that is asked in lines of text over a serial port: what drivers of such boards share."""

import contextlib
import time
from abc import ABC, abstractmethod
from typing import ClassVar

from mapweave.agent.drivers.base import BaseReading, WheelCounter, Wheels
from mapweave.agent.drivers.serial_port import SerialPort
from mapweave.agent.drivers.settings import Geometry, RobotSettings
from mapweave.hybridmap.errors import DeviceError, SettingsError


class SerialBase(ABC):
    """The port, wheel counters, and checks of answers. A driver adds `drive` and `read`, and these values.

    Attributes:
        geometry: dimensions and limits that the driver knows.
        baud: of the port.
        metres_per_count: way of a wheel for one count of its encoder, m.
        count_bits: width of the counters, after which they begin again.
        speed_step: speeds are sent in multiples of this, m/s.
    """

    geometry: Geometry = Geometry()
    baud: int = 115200
    metres_per_count: float
    count_bits: ClassVar[int] = 32
    speed_step: ClassVar[float] = 0.001

    def __init__(self, settings: RobotSettings) -> None:
        """Take the `port` of `[robot.options]`; it is opened later.

        Raises:
            SettingsError: there is none.
        """
        port = settings.options.get("port")
        if not isinstance(port, str):
            raise SettingsError('[robot.options] lacks the port; give port = "/dev/ttyUSB0"')
        self._path = port
        self._port: SerialPort | None = None
        self._counters = [WheelCounter(self.metres_per_count, self.count_bits, 3.0) for _ in range(2)]

    @abstractmethod
    def drive(self, speeds: Wheels) -> None:
        """Drive at these speeds."""

    @abstractmethod
    def read(self) -> BaseReading:
        """Read encoders and sensors."""

    def open(self) -> None:
        """Open the port and stop the wheels."""
        self._port = SerialPort(self._path, self.baud)
        self.drive(Wheels())

    def close(self) -> None:
        """Stop the wheels and close the port."""
        if self._port is not None:
            with contextlib.suppress(DeviceError):
                self.drive(Wheels())
            self._port.close()
            self._port = None

    def nearest(self, speeds: Wheels) -> Wheels:
        """Round to what can be sent."""
        step = self.speed_step
        return Wheels(round(speeds.left / step) * step, round(speeds.right / step) * step)

    def send(self, line: str) -> None:
        """Send a line."""
        assert self._port is not None
        self._port.write(f"{line}\n".encode())

    def ask(self, line: str, word: str, numbers: int) -> list[int]:
        """Send a line; returns the numbers of the answer, `WORD NUMBER NUMBER ...`.

        Raises:
            DeviceError: the answer is another one, or none comes in time.
        """
        assert self._port is not None
        self._port.clear()
        self.send(line)
        answer = self._port.line()
        first, *rest = answer.split() or [""]
        with contextlib.suppress(ValueError):
            if first == word and len(rest) == numbers:
                return [int(number) for number in rest]
        raise DeviceError(f"{self._path}: {answer[:80]!r} is no answer to {line!r}")

    def way(self, left: int, right: int) -> Wheels:
        """Distance of each wheel, m, after these counts of their encoders."""
        now = time.monotonic()
        return Wheels(*(c.update(n, now) for c, n in zip(self._counters, (left, right), strict=True)))

"""K-Team Koala over RS-232. Its two generations share the form of commands, not their letters or units."""

import math
import re
import time
from dataclasses import dataclass

import numpy as np

from mapweave.agent.drivers.base import BaseReading, WheelCounter, Wheels
from mapweave.agent.drivers.serial_port import GuardedBase, SerialOptions, SerialPort
from mapweave.agent.drivers.settings import Geometry, RobotSettings
from mapweave.agent.drivers.wheel_guard import WheelGuard
from mapweave.agent.drivers.wheeled import WheeledRobot
from mapweave.hybridmap.errors import DeviceError
from mapweave.hybridmap.pose import Array

NUMBER = re.compile(r"-?[0-9]{1,10}")
INFRARED_REACH = 0.2
"""m; range of the infrared sensors."""
INFRARED_AT_REACH = 20.0
"""Value of an infrared sensor at its reach, slightly above the noise; 1023 is the largest value. The
reflected light falls with the square of the distance."""
ULTRASONIC_REACH = 2.5
"""m; manual of the Koala 2.5, section 4.1."""
ULTRASONIC_OFF = 2000
"""Value of a sensor that is switched off."""


@dataclass(frozen=True)
class Generation:
    """Protocol and dimensions of one generation.

    Attributes:
        baud: bits a second.
        stop_bits: 1 or 2.
        end: end of a command.
        position: command that reads the encoders.
        proximity: command that reads the proximity sensors.
        metres_per_count: distance of a wheel for one encoder pulse.
        fastest_units: largest speed of a command; a unit is one pulse in 10 ms.
        geometry: dimensions, limits and sensors.
    """

    baud: int
    stop_bits: int
    end: bytes
    position: str
    proximity: str
    metres_per_count: float
    fastest_units: int
    geometry: Geometry

    @property
    def unit(self) -> float:
        """Speed of a wheel for one unit, m/s."""
        return self.metres_per_count / 0.01

    def distances(self, values: list[int]) -> Array:
        """Convert proximity values to (K,) m. Raises DeviceError for a wrong number of values."""
        expected = len(self.geometry.ranger_bearings_deg or ())
        if len(values) != expected:
            raise DeviceError(f"{len(values)} proximity values instead of {expected}")
        given = np.array(values, dtype=np.float64)
        if self is SILVER:
            return INFRARED_REACH * np.sqrt(INFRARED_AT_REACH / np.maximum(given, INFRARED_AT_REACH))
        # 0 means nearer than 25 cm, possibly touching. A sensor that is off has no reading.
        reach = np.where(given == ULTRASONIC_OFF, np.nan, ULTRASONIC_REACH)
        return np.where(given / 100.0 < ULTRASONIC_REACH, given / 100.0, reach)


SILVER = Generation(
    baud=38400, stop_bits=2, end=b"\n", position="H", proximity="N",
    metres_per_count=0.045e-3, fastest_units=127,
    # The order of the answer: eight sensors of the left side from the front, then eight of the right.
    geometry=Geometry(
        radius=0.22, axle=0.25, max_forward=0.3, max_turn=0.8, ranger_reach=INFRARED_REACH,
        ranger_bearings_deg=(
            6.0, 18.0, 35.0, 55.0, 75.0, 105.0, 135.0, 170.0,
            -6.0, -18.0, -35.0, -55.0, -75.0, -105.0, -135.0, -170.0,
        ),
    ),
)  # fmt: skip
KOALA_2_5 = Generation(
    baud=115200, stop_bits=1, end=b"\r", position="P", proximity="G",
    metres_per_count=math.pi * 82.5e-3 / 23400, fastest_units=1000,
    # Left rear, left front, front left, front, front right, right front, right rear, back right, back left.
    geometry=Geometry(
        radius=0.22, axle=0.25, max_forward=0.3, max_turn=0.8, ranger_reach=ULTRASONIC_REACH,
        ranger_bearings_deg=(110.0, 70.0, 35.0, 0.0, -35.0, -70.0, -110.0, -160.0, 160.0),
    ),
)  # fmt: skip


class KoalaBase(GuardedBase):
    """The base of a Koala. It has no watchdog, so a `WheelGuard` stops its wheels."""

    def __init__(self, port: str) -> None:
        """Create a base without opening the port."""
        super().__init__(port)
        self._generation = SILVER
        self._counters: tuple[WheelCounter, ...] = ()

    @property
    def geometry(self) -> Geometry:
        """Dimensions of the generation that has answered."""
        return self._generation.geometry

    def open(self) -> None:
        """Detect the generation and stop the wheels."""
        for generation in (KOALA_2_5, SILVER):
            port = SerialPort(self._path, generation.baud, generation.stop_bits)
            self._port, self._generation = port, generation
            try:
                # Ends what the probe for the other generation may have left in the input of the robot.
                port.write(generation.end)
                version = self._ask("B")
            except DeviceError:
                port.close()
                self._port = None
                continue
            # The 2.5 answers with a letter and a number, the silver edition with two numbers.
            if version[:1].isalpha() == (generation is KOALA_2_5):
                break
            port.close()
            self._port = None
        if self._port is None:
            raise DeviceError(
                f"{self._path}: no Koala answers; is it switched on, and set to its serial line?"
            )
        if not self._counters:
            g = self._generation
            fastest = g.fastest_units * g.unit
            self._counters = tuple(WheelCounter(g.metres_per_count, 32, fastest) for _ in range(2))
        # The end of line before it ends an incomplete command.
        stop = self._generation.end + self._drive_command(0, 0)
        self._guard = WheelGuard(self._port.descriptor, stop)
        self.drive(Wheels())

    def nearest(self, speeds: Wheels) -> Wheels:
        """Round to whole units."""
        units, unit = self._units(speeds), self._generation.unit
        return Wheels(units[0] * unit, units[1] * unit)

    def drive(self, speeds: Wheels) -> None:
        """Send speeds."""
        assert self._port is not None
        assert self._guard is not None
        left, right = self._units(speeds)
        self._ask_bytes(self._drive_command(left, right))
        self._guard.moving(bool(left or right))

    def read(self) -> BaseReading:
        """Read encoders and proximity sensors."""
        left, right = self._numbers(self._ask(self._generation.position), 2)
        now = time.monotonic()
        way = Wheels(self._counters[0].update(left, now), self._counters[1].update(right, now))
        values = self._numbers(self._ask(self._generation.proximity))
        return BaseReading(way, self._generation.distances(values))

    def _units(self, speeds: Wheels) -> tuple[int, int]:
        most, unit = self._generation.fastest_units, self._generation.unit
        left, right = (min(max(round(speed / unit), -most), most) for speed in speeds)
        return left, right

    def _drive_command(self, left: int, right: int) -> bytes:
        return f"D,{left},{right}".encode() + self._generation.end

    def _ask(self, command: str) -> str:
        return self._ask_bytes(command.encode() + self._generation.end)

    def _ask_bytes(self, command: bytes) -> str:
        """Send a command; returns its answer without the letter."""
        assert self._port is not None
        letter = chr(command.strip()[0]).lower()
        self._port.clear()
        self._port.write(command)
        for _ in range(4):
            line = self._port.line()
            # Other lines are answers to the guard or to an incomplete command.
            if line[:1] == letter:
                return line[1:].lstrip(",")
        raise DeviceError(f"{self._path}: {command.decode().strip()!r} was answered by {line!r}")

    def _numbers(self, text: str, count: int | None = None) -> list[int]:
        numbers = parse_numbers(text)
        if numbers is None or (count is not None and len(numbers) != count):
            raise DeviceError(f"{self._path}: {text!r} is not {count or 'a list of'} numbers")
        return numbers


def parse_numbers(text: str) -> list[int] | None:
    """Parse integers separated by commas; None for any other text."""
    parts = text.split(",")
    if not all(NUMBER.fullmatch(part) for part in parts):
        return None
    return [int(part) for part in parts]


class Koala(WheeledRobot):
    """K-Team Koala over RS-232, silver edition and 2.5."""

    def __init__(self, settings: RobotSettings) -> None:
        """Connect to the port in the options."""
        options = settings.options_as(SerialOptions)
        super().__init__(KoalaBase(options.port), settings)

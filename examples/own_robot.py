"""A driver of your own: `mapweave agent r0 --settings robot.toml --robot examples/own_robot.py:OwnRobot`.

This robot's motor board takes `V left right` (mm/s), answers `R` with `R left right` (encoder steps), and
stops the wheels by itself 250 ms after the last `V`. A board that does not do so needs a `WheelGuard`.
The settings give `[robot.options]`, `[robot.camera]` and `[robot.geometry]`, see docs/drivers.md.
"""

import time

from mapweave.agent.drivers.base import BaseReading, WheelCounter, Wheels
from mapweave.agent.drivers.serial_port import SerialPort
from mapweave.agent.drivers.settings import Geometry, RobotSettings
from mapweave.agent.drivers.wheeled import WheeledRobot
from mapweave.hybridmap.errors import DeviceError, SettingsError

METRES_PER_STEP = 0.0002


class Board:
    """The wheels; WheeledRobot adds the camera, the stamps and a thread for this class."""

    geometry = Geometry(radius=0.12, axle=0.15, max_forward=0.3, max_turn=0.8)

    def __init__(self, port: str) -> None:
        self.path, self.port = port, None
        self.counters = [WheelCounter(METRES_PER_STEP, bits=32, fastest=1.0) for _ in range(2)]

    def open(self) -> None:
        self.port = SerialPort(self.path, baud=57600)
        self.drive(Wheels(0.0, 0.0))

    def close(self) -> None:
        if self.port is not None:
            self.port.close()

    def nearest(self, speeds: Wheels) -> Wheels:
        return Wheels(round(speeds.left, 3), round(speeds.right, 3))

    def drive(self, speeds: Wheels) -> None:
        self.port.write(f"V {1000 * speeds.left:.0f} {1000 * speeds.right:.0f}\n".encode())

    def read(self) -> BaseReading:
        self.port.clear()
        self.port.write(b"R\n")
        word, *steps = self.port.line().split()
        if word != "R" or len(steps) != 2:
            raise DeviceError(f"{self.path}: the board answers {word!r}")
        ways = (c.update(int(s), time.monotonic()) for c, s in zip(self.counters, steps, strict=True))
        return BaseReading(Wheels(*ways))


class OwnRobot(WheeledRobot):
    """My robot."""

    def __init__(self, settings: RobotSettings) -> None:
        if "port" not in settings.options:
            raise SettingsError('[robot.options] lacks the port; give port = "/dev/ttyUSB0"')
        super().__init__(Board(settings.options["port"]), settings)

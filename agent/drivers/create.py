"""iRobot Create 2 and Roomba 500 to 900 over the serial Open Interface."""

import math
import struct
import time

from mapweave.agent.drivers.base import BaseReading, WheelCounter, Wheels
from mapweave.agent.drivers.serial_port import GuardedBase, SerialOptions, SerialPort
from mapweave.agent.drivers.settings import Geometry, RobotSettings
from mapweave.agent.drivers.wheel_guard import WheelGuard
from mapweave.agent.drivers.wheeled import WheeledRobot
from mapweave.hybridmap.errors import DeviceError

START, SAFE, DRIVE_DIRECT, QUERY_LIST = 128, 131, 145, 149
"""Opcodes of the iRobot Create 2 Open Interface Specification, as all numbers here."""
BUMPS, CHARGE, CAPACITY, MODE, LEFT_COUNTS, RIGHT_COUNTS = 7, 25, 26, 35, 43, 44
"""Sensor packets; their sizes are 1, 2, 2, 1, 2 and 2 bytes. Charge and capacity are in mAh."""
WHEEL_DROPS = 0b1100
"""Bits of both wheels in the packet of the bumper."""
PASSIVE = 1
"""Mode without wheel control; a cliff, a wheel drop or the charger ends the Safe mode."""
LARGEST_BUMPS, LARGEST_MODE = 0b1111, 3
"""Of these packets, by the specification. Answers have no checksum."""
METRES_PER_COUNT = math.pi * 72e-3 / 508.8
"""Wheels of 72 mm, 508.8 counts a revolution (the specification, packets 43 and 44)."""
FASTEST_MM = 500
"""mm/s, of a wheel (the specification, opcode 145)."""
QUERY = bytes([QUERY_LIST, 6, BUMPS, CHARGE, CAPACITY, MODE, LEFT_COUNTS, RIGHT_COUNTS])
STOP = struct.pack(">Bhh", DRIVE_DIRECT, 0, 0)


class CreateBase(GuardedBase):
    """The base. It has no watchdog, so a `WheelGuard` stops its wheels."""

    geometry = Geometry(radius=0.175, axle=0.235, max_forward=0.3, max_turn=0.8)

    def __init__(self, port: str) -> None:
        """Create a base without opening the port."""
        super().__init__(port)
        self._passive = False
        self._counters = [WheelCounter(METRES_PER_COUNT, 16, FASTEST_MM / 1e3) for _ in range(2)]

    def open(self) -> None:
        """Enter Safe mode, in which the robot stops at cliffs and when it is lifted."""
        self._port = SerialPort(self._path, 115200)
        # An earlier incomplete command takes up to four bytes; opcode 0 is ignored.
        self._port.write(bytes(4) + bytes([START, SAFE]))
        # An incomplete command takes up to four bytes of the first stop; the second is complete.
        self._guard = WheelGuard(self._port.descriptor, STOP * 2)
        self.drive(Wheels())
        self.read()

    def nearest(self, speeds: Wheels) -> Wheels:
        """Round to whole mm/s."""
        left, right = _millimetres(speeds)
        return Wheels(left / 1e3, right / 1e3)

    def drive(self, speeds: Wheels) -> None:
        """Send speeds; the right wheel comes first."""
        assert self._port is not None
        assert self._guard is not None
        left, right = _millimetres(speeds)
        if self._passive and (left or right):
            self._port.write(bytes([SAFE]))
        self._port.write(struct.pack(">Bhh", DRIVE_DIRECT, right, left))
        self._guard.moving(bool(left or right))

    def read(self) -> BaseReading:
        """Read encoders, bumper, battery and mode.

        Raises:
            DeviceError: it does not answer in time, or as no Create does.
        """
        assert self._port is not None
        self._port.clear()
        self._port.write(QUERY)
        bumps, charge, capacity, mode, left, right = struct.unpack(">BHHBHH", self._port.read(10))
        if bumps > LARGEST_BUMPS or mode > LARGEST_MODE:
            raise DeviceError(
                f"{self._path}: no Create or Roomba answers so; is another device at this port?"
            )
        self._passive = mode == PASSIVE
        now = time.monotonic()
        way = Wheels(self._counters[0].update(left, now), self._counters[1].update(right, now))
        battery = min(charge / capacity, 1.0) if capacity else None
        # One wheel drops at a threshold, too.
        lifted = bumps & WHEEL_DROPS == WHEEL_DROPS
        return BaseReading(way, bumped=bool(bumps & 0b11), battery=battery, kidnapped=lifted)


def _millimetres(speeds: Wheels) -> tuple[int, int]:
    left, right = (min(max(round(speed * 1e3), -FASTEST_MM), FASTEST_MM) for speed in speeds)
    return left, right


class Create(WheeledRobot):
    """iRobot Create 2 and Roomba over the serial Open Interface."""

    def __init__(self, settings: RobotSettings) -> None:
        """Connect to the port in the options."""
        options = settings.options_as(SerialOptions)
        super().__init__(CreateBase(options.port), settings)

"""Protocol of a robot base: two wheels and proximity sensors behind a serial or network line."""

from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.drivers.settings import Geometry


class Wheels(NamedTuple):
    """Left and right wheel: speeds in m/s, or distances in m."""

    left: float = 0.0
    right: float = 0.0


@dataclass(frozen=True, eq=False)
class BaseReading:
    """State of a base at one moment.

    Attributes:
        way: distance of each wheel since the driver was made, m.
        proximity: (K,) m from the robot's edge; the reach where nothing is near.
        bumped: whether the bumper is pressed.
        battery: charge, as a share; None if the base does not tell.
        kidnapped: whether the base notices that it has been lifted off the floor.
        stamp_ns: when it was measured, as `clock.now_ns`; None if it was while it was read.
    """

    way: Wheels
    proximity: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    bumped: bool = False
    battery: float | None = None
    kidnapped: bool = False
    stamp_ns: int | None = None


class Base(Protocol):
    """Wheels and proximity sensors. One thread calls all methods but `nearest`; they may block.

    `open`, `drive` and `read` raise DeviceError when the line fails; then the base is closed and reopened.
    """

    @property
    def geometry(self) -> Geometry:
        """Dimensions and limits known to the driver; valid after the first `open`."""

    def open(self) -> None:
        """Connect, with the wheels stopped. Called again after each failure."""

    def close(self) -> None:
        """Stop the wheels if possible, and release the line. Never raises."""

    def nearest(self, speeds: Wheels) -> Wheels:
        """The speeds that the hardware would drive for these speeds. Called from any thread."""

    def drive(self, speeds: Wheels) -> None:
        """Drive at these speeds. A base without a hardware watchdog informs its `WheelGuard`."""

    def read(self) -> BaseReading:
        """Read encoders and sensors."""


class WheelCounter:
    """Distance of a wheel from an encoder count that wraps around and restarts at zero."""

    def __init__(self, metres_per_count: float, bits: int, fastest: float) -> None:
        """Create a counter without a reading.

        Args:
            metres_per_count: distance of the wheel for one count.
            bits: width of the counter.
            fastest: largest speed of the wheel, m/s; a greater jump means that the counter was reset.
        """
        self._scale = metres_per_count
        self._range = 1 << bits
        self._fastest = fastest
        self._last: tuple[int, float] | None = None
        self.way = 0.0

    def update(self, count: int, now: float) -> float:
        """Add a reading.

        Args:
            count: the reading.
            now: monotonic time, s.

        Returns:
            Distance since the first reading, m.
        """
        if self._last is not None:
            before, then = self._last
            counts = (count - before + self._range // 2) % self._range - self._range // 2
            way = counts * self._scale
            # 0.1 m of tolerance, for a base that coasts and for the delay between reading and clock.
            if abs(way) <= self._fastest * (now - then) + 0.1:
                self.way += way
        self._last = (count, now)
        return self.way

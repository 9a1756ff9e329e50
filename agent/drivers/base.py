"""What a driver of two wheels writes: how its protocol says "drive" and "where are the wheels"."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.drivers.settings import Geometry


class Wheels(NamedTuple):
    """Left and right wheel: speeds in m/s, or ways in m."""

    left: float = 0.0
    right: float = 0.0


@dataclass(frozen=True, eq=False)
class BaseReading:
    """What a base says of itself at one moment.

    Attributes:
        way: of each wheel since the driver was made, m.
        proximity: (K,) m from the robot's edge; the reach where nothing is near.
        bumped: whether the bumper is pressed.
    """

    way: Wheels
    proximity: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    bumped: bool = False


class Base(Protocol):
    """Wheels and proximity sensors behind a line. One thread calls it; any call may take its time.

    Each method but `nearest` raises DeviceError when the line fails; it is then closed and opened again.
    """

    @property
    def geometry(self) -> Geometry:
        """The body as far as the driver knows it; asked after the first `open`."""
        ...

    def open(self) -> None:
        """Connect; the wheels stand. Called again after each failure."""
        ...

    def close(self) -> None:
        """Stop the wheels if they can be reached, and let go. Never raises."""
        ...

    def nearest(self, speeds: Wheels) -> Wheels:
        """The speeds that the base would really drive if these were asked for. Called from any thread."""
        ...

    def drive(self, speeds: Wheels) -> None:
        """Drive at these speeds. A base that does not stop by itself tells its `WheelGuard` of each one."""
        ...

    def read(self) -> BaseReading:
        """Ask for the wheels and the sensors."""
        ...


class WheelCounter:
    """The way of a wheel from an encoder's count that wraps around, and begins at zero after a restart."""

    def __init__(self, metres_per_count: float, bits: int, fastest: float) -> None:
        """No count was read yet.

        Args:
            metres_per_count: way of the wheel for a count.
            bits: width of the counter.
            fastest: no wheel turns faster, m/s; a greater leap is a counter that was set back.
        """
        self._scale = metres_per_count
        self._range = 1 << bits
        self._fastest = fastest
        self._last: tuple[int, float] | None = None
        self.way = 0.0

    def update(self, count: int, now: float) -> float:
        """Take a count.

        Args:
            count: as it was read.
            now: of a clock that only grows, s.

        Returns:
            The way since the first count, m.
        """
        if self._last is not None:
            before, then = self._last
            counts = (count - before + self._range // 2) % self._range - self._range // 2
            way = counts * self._scale
            # A tenth of a metre more, for a base that coasts and for clocks that are read between.
            if abs(way) <= self._fastest * (now - then) + 0.1:
                self.way += way
        self._last = (count, now)
        return self.way

"""Sensors that fail for a while: what they then return instead of the truth."""

from collections.abc import Sequence

import numpy as np

from mapweave.agent.observation import Odometry
from mapweave.hybridmap.pose import Array
from mapweave.sim.events import Fail


class SensorFaults:
    """Faults of one robot's sensors. Healthy sensors pass unchanged."""

    def __init__(self, axle: float, seed: Sequence[int]) -> None:
        """Start without faults.

        Args:
            axle: nominal distance of the wheels, m.
            seed: of random wrong readings.
        """
        self._axle = axle
        self._rng = np.random.default_rng(seed)
        self._until: dict[tuple[str, str], int] = {}
        self._amounts: dict[tuple[str, str], float] = {}
        self._jump = 0.0

    def begin(self, fault: Fail, tick: int, ticks: int) -> None:
        """Add a fault.

        Args:
            fault: what.
            tick: now.
            ticks: for how many ticks from the next on.
        """
        key = (fault.sensor, fault.how)
        if key == ("encoders", "spike"):
            self._jump += fault.size
            return
        self._until[key] = tick + ticks
        self._amounts[key] = fault.size

    def active(self, sensor: str, how: str, tick: int) -> bool:
        """Whether a sensor fails in this way in a tick."""
        return tick <= self._until.get((sensor, how), -1)

    def covered(self, tick: int) -> int | None:
        """Grey of a cover of the lens, if any."""
        if not self.active("camera", "blocked", tick):
            return None
        return round(self._amounts["camera", "blocked"])

    def odometry(self, true: Odometry, tick: int) -> Odometry:
        """What the encoders return."""
        jump, self._jump = self._jump, 0.0
        wheels = np.array([-0.5, 0.5]) * self._axle * true.turn + true.forward
        if self.active("encoders", "scale", tick):
            wheels *= 1.0 + self._amounts["encoders", "scale"]
        both = self.active("encoders", "zero", tick)
        for wheel, how in enumerate(("zero_left", "zero_right")):
            if both or self.active("encoders", how, tick):
                wheels[wheel] = 0.0
        if not jump and not self._any("encoders", tick):
            return true
        left, right = wheels.tolist()
        return Odometry((left + right) / 2 + jump, (right - left) / self._axle)

    def ranges(self, true: Array, reach: float, tick: int) -> Array:
        """What the rangers return, (K,) m."""
        if self.active("rangers", "drop", tick):
            return np.full(len(true), reach)
        if not self.active("rangers", "spike", tick):
            return true
        wrong = self._rng.random(len(true)) < self._amounts["rangers", "spike"]
        return np.where(wrong, true * self._rng.random(len(true)), true)

    def bumped(self, true: bool, tick: int) -> bool:
        """What the bumper returns."""
        if self.active("bumper", "stuck", tick):
            return True
        return true and not self.active("bumper", "dead", tick)

    def _any(self, sensor: str, tick: int) -> bool:
        return any(tick <= until for (failed, _), until in self._until.items() if failed == sensor)


def describe(fault: Fail) -> str:
    """One line for people."""
    if (fault.sensor, fault.how) == ("encoders", "spike"):
        return f"the encoders of {fault.robot} jump by {fault.size:g} m"
    verb = "fail" if fault.sensor.endswith("s") else "fails"
    amount = f", {fault.size:g}" if fault.size else ""
    return f"the {fault.sensor} of {fault.robot} {verb} ({fault.how}{amount}) for {fault.seconds:g} s"

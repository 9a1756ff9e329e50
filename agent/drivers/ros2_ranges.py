"""Free distances around the robot from ROS messages: LaserScan, Range, or the Create 3's infrared sensors."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.ros_messages.values import Mount
from mapweave.hybridmap.errors import DeviceError
from mapweave.hybridmap.pose import Array

SCAN_TYPE, RANGE_TYPE = "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/Range"
INFRARED_TYPE = "irobot_create_msgs/msg/IrIntensityVector"
KINDS = (SCAN_TYPE, RANGE_TYPE, INFRARED_TYPE)
SECTOR = math.radians(15.0)
"""A scan becomes one reading for each sector of this width, the nearest in it."""
BORDER = 1e-3
"""rad; a ray on the border of two sectors counts in both."""
MOST_REACH = 5.0
"""m; what a scanner sees beyond is no matter."""
BODY = 0.05
"""m; a scanner's points this far inside the robot's outline are parts of the robot."""
INFRARED_BEARINGS = {
    "side_left": 1.309, "left": 0.873, "front_left": 0.436, "front_center_left": 0.0,
    "front_center_right": -0.436, "front_right": -0.873, "right": -1.309,
}  # fmt: skip
"""rad; the last parts of the sensors' frames, and where these point in the Create 3's description."""
INFRARED_STRENGTH, INFRARED_DECAY = 3500.0, 26.831568
"""A reading is strength * exp(-decay * m) in front of a bright surface (create3_sim, from experiments)."""
INFRARED_REACH = 0.2
"""m; the reading is down to 16 there."""


class Ranger:
    """One topic's readings: bearings, reach, and distances from the robot's edge."""

    def __init__(self, kind: str, message: Any, mount: Mount | None, radius: float) -> None:
        """Take the directions from a first message.

        Args:
            kind: type of the messages.
            message: the first.
            mount: of the sensor; None if it is unknown.
            radius: of the robot, m.

        Raises:
            DeviceError: the message gives no directions.
        """
        self._radius, self._mount, self._kind = radius, mount, kind
        self.bearings: tuple[float, ...] = ()
        if kind == SCAN_TYPE:
            self._mount = mount or Mount(0.0, 0.0, 0.0, 0.0)
            self.reach = min(float(message.range_max), MOST_REACH)
            self.bearings = self._sectors(message)
        elif kind == RANGE_TYPE:
            self.reach = float(message.max_range)
            self.bearings = () if mount is None else (mount.heading,)
        else:
            self.reach = INFRARED_REACH
            self.bearings = tuple(INFRARED_BEARINGS.values())
        if not 0.0 < self.reach < math.inf:
            raise DeviceError(f"a sensor cannot reach {self.reach:g} m")

    def distances(self, message: Any, bearings: Sequence[float]) -> NDArray[np.float64]:
        """(K,) m, free distance from the robot's edge along each bearing, at most `reach`."""
        if self._kind == SCAN_TYPE:
            return self._scanned(message, np.array(bearings))
        if self._kind == RANGE_TYPE:
            # Minus infinity is an object that is too near to be measured (REP 117).
            value = float(message.range)
            free = self.reach if math.isnan(value) else min(max(value, 0.0), self.reach)
            if self._mount is not None and free < self.reach:
                m = self._mount
                x, y = m.forward + free * math.cos(m.heading), m.left + free * math.sin(m.heading)
                free = max(math.hypot(x, y) - self._radius, 0.0)
            return np.array([free])
        values = {reading.header.frame_id: float(reading.value) for reading in message.readings}
        return np.array([_infrared(values, name) for name in INFRARED_BEARINGS])

    def _sectors(self, message: Any) -> tuple[float, ...]:
        """Middles of the sectors, rad, positive to the left, from right to left."""
        angles = self._angles(message)
        if len(angles) < 2 or not np.isfinite(angles).all():
            raise DeviceError("a scan of fewer than two rays")
        span = float(np.ptp(angles))
        if span > math.tau - SECTOR:
            count = round(math.tau / SECTOR)
            middles = -math.pi + math.tau * (np.arange(count) + 0.5) / count
        else:
            count = max(round(span / SECTOR), 1)
            middles = float(angles.min()) + span * (np.arange(count) + 0.5) / count
        return tuple(float(bearing) for bearing in wrapped(middles))

    def _angles(self, message: Any) -> Array:
        """(N,) rad, of the rays in the robot."""
        assert self._mount is not None
        first, step = float(message.angle_min) + self._mount.heading, float(message.angle_increment)
        angles: Array = first + step * np.arange(len(message.ranges), dtype=np.float64)
        return angles

    def _scanned(self, message: Any, bearings: Array) -> NDArray[np.float64]:
        assert self._mount is not None
        ranges = np.asarray(message.ranges, np.float64)
        # Scanners report what they do not see as infinite, not a number, or zero.
        seen = np.isfinite(ranges) & (ranges >= max(float(message.range_min), 1e-6))
        seen &= ranges <= float(message.range_max)
        angles = self._angles(message)[seen]
        x = self._mount.forward + ranges[seen] * np.cos(angles)
        y = self._mount.left + ranges[seen] * np.sin(angles)
        free = np.hypot(x, y) - self._radius
        outside = free > -BODY
        free, towards = np.maximum(free[outside], 0.0), np.arctan2(y, x)[outside]
        # Bearings that are nearer to each other than sectors each have the rays about them, at least one.
        between = float(np.min(np.abs(wrapped(np.diff(bearings))), initial=SECTOR))
        width = max(between, abs(float(message.angle_increment)))
        aside = np.abs(wrapped(towards - bearings[:, None]))
        near = np.where(aside <= width / 2 + BORDER, free, self.reach)
        return np.asarray(near.min(axis=1, initial=self.reach), np.float64)


def wrapped(angles: Array) -> Array:
    """The same angles within half a turn, rad."""
    return np.asarray((angles + math.pi) % math.tau - math.pi)


def _infrared(values: dict[str, float], name: str) -> float:
    """m, by an intensity; the reach if the sensor says nothing."""
    value = next((v for frame, v in values.items() if frame.endswith(f"ir_intensity_{name}")), 0.0)
    if value <= 0.0:
        return INFRARED_REACH
    return min(max(math.log(INFRARED_STRENGTH / value) / INFRARED_DECAY, 0.0), INFRARED_REACH)

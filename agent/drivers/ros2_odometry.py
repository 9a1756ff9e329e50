"""The way of the wheels from ROS messages: Odometry, JointState, or the Create 3's WheelTicks."""

import math
from typing import Any

from mapweave.agent.drivers.base import Wheels
from mapweave.agent.observation import Odometry
from mapweave.agent.ros_messages.values import ODOMETRY_TYPE, pose_of
from mapweave.hybridmap.errors import DeviceError

JOINTS_TYPE, TICKS_TYPE = "sensor_msgs/msg/JointState", "irobot_create_msgs/msg/WheelTicks"
KINDS = (ODOMETRY_TYPE, JOINTS_TYPE, TICKS_TYPE)
TICKS_PER_TURN = 508.8
"""Of a wheel of iRobot's Create 3, by its documentation, and of the Create 2."""
TICKS_RANGE = 1 << 32
"""After so many ticks the counter begins again: `WheelTicks` has int32."""
CREATE_3_RADIUS = 0.03575
"""Of its wheels, m, by create3_sim."""
FASTEST = 5.0
"""m/s; a greater step means that the robot counts from zero again."""
COASTING = 0.1
"""m that a step may be longer: messages may be late."""


class WheelOdometry:
    """Adds up what the wheels do between messages."""

    def __init__(self, axle: float, wheel_radius: float | None, joints: tuple[str, str]) -> None:
        """Start at zero.

        Args:
            axle: m.
            wheel_radius: m; needed for joint states.
            joints: names of the left and right wheel's joint.
        """
        self._axle, self._radius, self._joints = axle, wheel_radius, joints
        self._last: tuple[str, tuple[float, ...], int] | None = None
        self.way = Wheels()

    def update(self, kind: str, message: Any, stamp_ns: int) -> Wheels:
        """Take a message; returns the way of each wheel so far, m.

        Raises:
            DeviceError: it is not finite, or lacks a wheel.
        """
        state = self._state(kind, message)
        if not all(map(math.isfinite, state)):
            raise DeviceError("odometry is not finite, or its quaternion is all zeros")
        if self._last is not None and self._last[0] == kind:
            left, right = self._step(kind, self._last[1], state)
            longest = FASTEST * abs(stamp_ns - self._last[2]) / 1e9 + COASTING
            if max(abs(left), abs(right)) <= longest:
                self.way = Wheels(self.way.left + left, self.way.right + right)
        self._last = kind, state, stamp_ns
        return self.way

    def _state(self, kind: str, message: Any) -> tuple[float, ...]:
        if kind == ODOMETRY_TYPE:
            return pose_of(message)
        if kind == TICKS_TYPE:
            return float(message.ticks_left), float(message.ticks_right)
        if self._radius is None:
            raise DeviceError("joint states need [robot.options] wheel_radius, m")
        positions = dict(zip(message.name, message.position, strict=False))
        missing = [name for name in self._joints if name not in positions]
        if missing:
            there = ", ".join(message.name) or "none"
            raise DeviceError(f"no joint {missing[0]!r} (there are {there}); give [robot.options] joints")
        return tuple(self._radius * float(positions[name]) for name in self._joints)

    def _step(self, kind: str, before: tuple[float, ...], now: tuple[float, ...]) -> tuple[float, float]:
        """Way of the left and right wheel between two states, m."""
        if kind == ODOMETRY_TYPE:
            odometry = Odometry.between(before, now)
            half = odometry.turn * self._axle / 2
            return odometry.forward - half, odometry.forward + half
        steps = [b - a for a, b in zip(before, now, strict=True)]
        if kind == TICKS_TYPE:
            scale = math.tau * (self._radius or CREATE_3_RADIUS) / TICKS_PER_TURN
            half_range = TICKS_RANGE // 2
            steps = [scale * ((step + half_range) % TICKS_RANGE - half_range) for step in steps]
        return steps[0], steps[1]

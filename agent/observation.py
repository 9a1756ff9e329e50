"""Observations, commands and the description of a robot: plain values."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.ranges import Ranges


@dataclass(frozen=True, slots=True)
class Odometry:
    """Motion of the wheels since the observation before.

    Attributes:
        forward: u1 of the paper, way of the middle of the axle, m.
        turn: u2 of the paper, rad, counter-clockwise.
    """

    forward: float
    turn: float

    def motion(self) -> Pose2:
        """`before_from_after`, a chord at half the turn as in the paper's prediction."""
        return Pose2(
            self.forward * float(np.cos(self.turn / 2)),
            self.forward * float(np.sin(self.turn / 2)),
            self.turn,
        )


@dataclass(frozen=True, eq=False)
class Observation:
    """A robot's sensor readings of one tick (0.1 s).

    Attributes:
        stamp_ns: time of the image.
        odometry: since the observation before.
        image: (H, W) uint8 grey as it comes from the camera (lens distortion still in it), or None if
            this tick has no frame.
        proximity: (K,) m, free distance along each of the robot's rangers from the robot's edge; the
            ranger's maximum where nothing is in reach. Empty if the robot has none.
        bumped: whether the bumper is pressed.
    """

    stamp_ns: int
    odometry: Odometry
    image: NDArray[np.uint8] | None = None
    proximity: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    bumped: bool = False


@dataclass(frozen=True, slots=True)
class Command:
    """What the wheels shall do until the next command.

    Attributes:
        forward: speed, m/s.
        turn: rate, rad/s, counter-clockwise.
    """

    forward: float = 0.0
    turn: float = 0.0


@dataclass(frozen=True)
class RobotDescription:
    """What the agent must know of the robot that it drives.

    Attributes:
        camera: ideal intrinsics and mount.
        distortion: (k1, k2, p1, p2, k3) of the lens, OpenCV's order.
        radius: of the robot's footprint, m.
        axle: distance between the wheels L, m.
        wheel_noise: standard deviation of a wheel's way, as a share of the way: sigma of the paper.
        side_slip: standard deviation of the slip aside in a step, as a share of the way: two wheels never
            quite agree, and no encoder measures that.
        ranger_bearings: (K,) rad, directions of the proximity sensors, 0 ahead, positive to the left.
        ranger_reach: the rangers' maximum, m.
        ranges_see_robots: whether the rangers are low enough to see other robots of the fleet. Then what they
            saw goes with every node, and a merge under which robots should have seen each other is refused.
        max_forward: speed limit, m/s; 0 if the robot is carried and takes no commands.
        max_turn: rate limit, rad/s.
        tick: time between two observations, s.
        clock: name of the clock of the stamps, if other robots' stamps have the same (a network time to well
            under a second, a simulator); empty if unknown.
    """

    camera: Camera
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    radius: float = 0.16
    axle: float = 0.24
    wheel_noise: float = 0.02
    side_slip: float = 0.005
    ranger_bearings: tuple[float, ...] = ()
    ranger_reach: float = 0.0
    max_forward: float = 0.3
    max_turn: float = 0.8
    tick: float = 0.1
    clock: str = ""
    ranges_see_robots: bool = False

    def ranges(self, proximity: NDArray[np.float64]) -> Ranges:
        """Ranger readings to store with a node; empty if the rangers cannot see other robots."""
        if not self.ranges_see_robots:
            return Ranges()
        return Ranges.around(proximity, self.ranger_bearings, self.ranger_reach, self.radius)

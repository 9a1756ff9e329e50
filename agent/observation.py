"""Observations, commands and the description of a robot: plain values."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from mapweave.agent.drive_geometry import DriveGeometry
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.limits import NAME_OR_NOTHING, Angle, Share
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.ranges import Ranges
from mapweave.vision.lens import NO_DISTORTION, Distortion

MAX_RANGERS = 256
"""Of a robot. A limit for messages: one each 1.4 degrees."""
FARTHEST = 1e4
"""No ranger reaches farther, m."""
FASTEST = 1e3
"""No robot drives or turns faster, m/s and rad/s."""

Length = Annotated[float, Meta(ge=1e-3, le=100.0)]
Reach = Annotated[float, Meta(ge=0.0, le=FARTHEST)]
Speed = Annotated[float, Meta(ge=0.0, le=FASTEST)]


@dataclass(frozen=True, slots=True)
class Odometry:
    """Motion of the wheels since the observation before.

    Attributes:
        forward: u1 of the paper, way of the middle of the axle, m.
        turn: u2 of the paper, rad, counter-clockwise.
    """

    forward: float
    turn: float

    @staticmethod
    def between(before: Sequence[float], after: Sequence[float]) -> Odometry:
        """Motion between two poses, each x m, y m, heading rad; inverse of `motion`."""
        turn = (after[2] - before[2] + math.pi) % math.tau - math.pi
        middle = before[2] + turn / 2
        dx, dy = after[0] - before[0], after[1] - before[1]
        return Odometry(dx * math.cos(middle) + dy * math.sin(middle), turn)

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
            ranger's maximum where nothing is in reach, 0 where something is too near to be measured.
            Empty if the robot has none.
        bumped: whether the bumper is pressed.
        battery: charge, as a share; None if the robot does not tell.
        kidnapped: whether the robot notices that it has been lifted. The wheels have not measured how it is
            moved; once this ends, it is at an unknown place.
        left_out: (K, 4) px in the ideal image, regions of it in which other robots may stand, so that
            nothing there is a landmark: left, top, right, bottom. No driver gives it.
        silent: why the robot's base does not answer, so that the robot stands; empty while it does.
    """

    stamp_ns: int
    odometry: Odometry
    image: NDArray[np.uint8] | None = None
    proximity: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    bumped: bool = False
    battery: float | None = None
    kidnapped: bool = False
    left_out: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 4)))
    silent: str = ""


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
        distortion: of the lens.
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
        geometry: mount's angles and offsets, and scales and delay of the wheels, where they are known. Its
            forward and height do not count: the camera has them.
    """

    camera: Camera
    distortion: Distortion = NO_DISTORTION
    radius: Length = 0.16
    axle: Length = 0.24
    wheel_noise: Share = 0.02
    side_slip: Share = 0.005
    ranger_bearings: Annotated[tuple[Angle, ...], Meta(max_length=MAX_RANGERS)] = ()
    ranger_reach: Reach = 0.0
    max_forward: Speed = 0.3
    max_turn: Speed = 0.8
    tick: Annotated[float, Meta(ge=1e-4, le=3600.0)] = 0.1
    clock: Annotated[str, Meta(pattern=NAME_OR_NOTHING)] = ""
    ranges_see_robots: bool = False
    geometry: DriveGeometry | None = None

    def ranges(self, proximity: NDArray[np.float64]) -> Ranges:
        """Ranger readings to store with a node; empty if the rangers cannot see other robots."""
        if not self.ranges_see_robots:
            return Ranges()
        return Ranges.around(proximity, self.ranger_bearings, self.ranger_reach, self.radius)

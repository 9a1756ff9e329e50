"""The blind zone of proximity sensors: a reading of 0 says that something is near, not how near.

An ultrasonic sensor hears no echo from nearer than some 25 cm and reads 0 there. Taken for a touch, that
keeps a robot from every place along a wall, and leaves phantoms at its edge wherever it turns. But the robot
has come from farther off, where the sensors measured: what they saw then is remembered, and fills in. Where
nothing is remembered, the thing is not where the robot itself has just been. A robot that is carried off
believes what it remembers until its sensors look through it, or until it is noticed: see `forget`.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.observation import Observation, RobotDescription
from mapweave.hybridmap.pose import Array, Pose2

DEEPEST = 0.3
"""No sensor is blind farther than this from the robot's edge, m: ultrasonic ones are to 0.25 m."""
SHALLOW = 0.1
"""A zone that is less deep than this, m, is none: robots keep about as much away from things."""
CONE = math.radians(20.0)
"""What is this far aside of a bearing is in the beam: half the opening of an ultrasonic sensor."""
CORE = math.radians(6.0)
"""A reading proves that nothing nearer is this far aside of its bearing,"""
SURE = 0.1
"""by more than this, m."""
WITHIN = 1.5
"""Points farther than this from the robot are forgotten, m: drift makes them useless."""
CELL = 0.05
"""Two points in one square of this side are one, m: the later one."""
STEP = 0.01
"""Of the way along a beam, and between two positions of the robot that are kept, m;"""
POSES = 100
"""of which there are so many: a metre."""
SLACK = 0.03
"""What is remembered is off by up to this, m: noise of a reading, and the wheels."""


class BlindZone:
    """Remembers where the proximity sensors measured something, in the odometry frame.

    How deep the zone is shows by itself: nothing nearer than that is ever measured. Sensors that measure down
    to a touch soon have none, and what they read is left as it is.
    """

    def __init__(self, description: RobotDescription) -> None:
        """Remember nothing."""
        self._bearings = np.array(description.ranger_bearings)
        self._directions = np.stack([np.cos(self._bearings), np.sin(self._bearings)], axis=1)
        self._radius, self._reach = description.radius, description.ranger_reach
        self._odom_from_robot = Pose2()
        self._points: Array = np.zeros((0, 2))
        self._stood: Array = np.zeros((0, 2))
        self._least = DEEPEST

    def fill(self, observation: Observation) -> Observation:
        """The observation with distances, m, for readings of 0 that are explained by what was seen before."""
        if self._least < SHALLOW:
            return observation
        self._odom_from_robot = self._odom_from_robot @ observation.odometry.motion()
        readings = observation.proximity
        if observation.kidnapped:
            self.forget()
        if not len(readings) or len(readings) != len(self._bearings):
            return observation
        remembered = self._odom_from_robot.inverse().apply(self._points)
        distances, angles = np.hypot(*remembered.T), np.arctan2(remembered[:, 1], remembered[:, 0])
        aside = np.abs(_within_turn(angles - self._bearings[:, None] + math.pi) - math.pi)
        measured = np.isfinite(readings) & (readings > 0.0)
        seen_through = (aside < CORE) & measured[:, None]
        seen_through &= distances < (readings + self._radius - SURE)[:, None]
        kept = (distances < WITHIN) & ~seen_through.any(axis=0)
        hits = measured & (readings < self._reach - 1e-6)
        self._least = min(self._least, float(readings[hits].min(initial=math.inf)))
        self._remember(kept, (readings[hits] + self._radius)[:, None] * self._directions[hits])
        blind = readings == 0.0
        if not blind.any():
            return observation
        near = np.where(kept & (aside < CONE), distances - self._radius, math.inf)
        free = np.maximum(near.min(axis=1, initial=math.inf), 0.0)
        free[blind] = [
            f if f <= self._least + SLACK else self._driven(b)
            for f, b in zip(free[blind], self._bearings[blind], strict=True)
        ]
        return replace(observation, proximity=np.where(blind, free, readings))

    def forget(self) -> None:
        """Remember nothing: the robot may be elsewhere than the wheels say. The zone's depth stays known."""
        self._points, self._stood = self._points[:0], self._stood[:0]

    def _driven(self, bearing: float) -> float:
        """How far from its edge along a bearing the robot has just been, m.

        0 if it has been all over the blind zone: then the thing has come in since.
        """
        along = np.arange(0.0, self._least + SLACK, STEP)
        beam = (self._radius + along)[:, None] * np.array([math.cos(bearing), math.sin(bearing)])
        apart = self._odom_from_robot.apply(beam)[:, None] - self._stood
        beyond = np.hypot(apart[..., 0], apart[..., 1]).min(axis=1, initial=math.inf) >= self._radius
        first = int(beyond[1:].argmax())
        return float(along[first]) if beyond[1:].any() else 0.0

    def _remember(self, kept: NDArray[np.bool_], fresh: Array) -> None:
        """Keep some of the points, and (N, 2) m in robot."""
        points = np.concatenate([self._odom_from_robot.apply(fresh), self._points[kept]])
        cells = np.round(points / CELL).astype(np.int64)
        _, latest = np.unique(cells[:, 0] * 2**32 + cells[:, 1], return_index=True)
        self._points = points[np.sort(latest)]
        at = np.array([self._odom_from_robot.x, self._odom_from_robot.y])
        if not len(self._stood) or np.hypot(*(self._stood[-1] - at)) > STEP:
            self._stood = np.concatenate([self._stood, at[None]])[-POSES:]


def _within_turn(angles: Array) -> Array:
    """Angles in [0, 2 pi), in place: the remainder is slow, and most are there already."""
    outside = (angles < 0.0) | (angles >= math.tau)
    angles[outside] %= math.tau
    return angles

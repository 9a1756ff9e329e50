"""Several beginnings of one trail, of which the way itself shows the right one.

Two views of a few landmarks can often be explained in more than one way. Each is followed as a trail of its
own until the pixels speak against it, or until it has become the same as the best.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from agent.homing.trail import Trail, TrailSettings
from agent.observation import Odometry, RobotDescription
from hybridmap.camera import Camera
from hybridmap.pose import Array, Pose2, PoseGaussian, wrap_angle
from hybridmap.recognising.bearings import BearingFix

DIRECTIONS = (math.pi, 0.75 * math.pi, -0.75 * math.pi, 0.5 * math.pi, -0.5 * math.pi, 0.0)
"""rad, from the place: where else the search for the first posture begins."""

MANY, SHARP = 30, 0.1
"""Inliers, and a standard deviation of the direction, rad, that leave nothing to guess."""

SIDES = (None, math.pi, 0.5 * math.pi, -0.5 * math.pi, 0.25 * math.pi, -0.25 * math.pi)
"""rad, about the place, by which another beginning is turned from the best; None: where it was believed."""

DOUBT = 0.5
"""m of way on which other beginnings are tried: then nothing is ambiguous any more."""

ROUNDS, MOST = 8, 4
"""Rounds that another beginning gets, and trails that are followed at most."""

UNLIKELY = 10.0
"""nats by which a guess must be worse than the best to be dropped."""

SAME = (0.05, 0.03)
"""Two guesses nearer than this, as a share of the way to the place, and rad, have become one."""


class Guesses:
    """Trails that began differently; the best of them speaks for all."""

    def __init__(
        self,
        description: RobotDescription,
        place: Camera,
        pixels_at_place: NDArray[np.floating],
        fixes: list[BearingFix],
        prior: PoseGaussian,
        settings: TrailSettings | None = None,
    ) -> None:
        """Begin one trail for each fix.

        Args:
            description: of the robot that drives.
            place: camera of the place's view.
            pixels_at_place: (N, 2) px, where the landmarks are there.
            fixes: of the first image, at least one; see hybridmap.recognising.bearings.relate_all.
            prior: place_from_robot by anything but these bearings, however uncertain.
            settings: of each trail.
        """
        reach = max(math.hypot(prior.mean.x, prior.mean.y), 0.5 * math.sqrt(float(prior.covariance[0, 0])))
        starts = [_start(fix, reach, prior.mean) for fix in fixes]
        if not _clear(fixes[0]):
            starts += [
                Pose2(reach * math.cos(angle), reach * math.sin(angle), fix.heading)
                for fix in fixes[:2]
                for angle in DIRECTIONS
            ]
        self._believed, self._way, self._tries = prior.mean, 0.0, 0
        self._trails = [
            Trail(description, place, pixels_at_place, prior, settings, start) for start in starts
        ]

    @property
    def trail(self) -> Trail:
        """The best."""
        return self._trails[0]

    @property
    def agreed(self) -> bool:
        """Whether only one is left."""
        return len(self._trails) == 1

    def move(self, odometry: Odometry) -> None:
        """Take one step of the wheels."""
        self._way += abs(odometry.forward)
        for trail in self._trails:
            trail.move(odometry)

    def see(self, ids: NDArray[np.int64], pixels: Array) -> None:
        """Take one image; see Trail. On the first metres, one more beginning is tried with each."""
        for trail in self._trails:
            trail.see(ids, pixels)
        if 0.0 < self._way < DOUBT:
            self._trails.append(self.trail.restarted(self._elsewhere(), ROUNDS))
        ranked = sorted(self._trails, key=lambda trail: trail.cost)
        kept: list[Trail] = []
        for trail in ranked:
            likely = trail.cost - ranked[0].cost < UNLIKELY
            if likely and len(kept) < MOST and not any(_same(trail, other) for other in kept):
                kept.append(trail)
        self._trails = kept

    def _elsewhere(self) -> Pose2:
        """Where else the way may have begun: where it was believed to, or on another side of the place."""
        first = self.trail.first
        self._tries += 1
        angle = SIDES[self._tries % len(SIDES)]
        if angle is None:
            return Pose2(self._believed.x, self._believed.y, first.heading)
        c, s = math.cos(angle), math.sin(angle)
        return Pose2(c * first.x - s * first.y, s * first.x + c * first.y, first.heading)

    def forget(self, ids: NDArray[np.int64]) -> None:
        """Landmarks that turned out to be wrong."""
        for trail in self._trails:
            trail.forget(ids)


def _clear(fix: BearingFix) -> bool:
    """Whether a fix is so sure that looking further makes no sense."""
    return fix.directed and int(fix.inliers.sum()) >= MANY and fix.covariance[1, 1] < SHARP**2


def _start(fix: BearingFix, reach: float, believed: Pose2) -> Pose2:
    if not fix.directed:
        return Pose2(believed.x, believed.y, fix.heading)
    return Pose2(reach * math.cos(fix.direction), reach * math.sin(fix.direction), fix.heading)


def _same(one: Trail, other: Trail) -> bool:
    a, b = one.pose.mean, other.pose.mean
    near = SAME[0] * math.hypot(b.x, b.y) + 0.01
    return a.distance(b) < near and abs(wrap_angle(a.heading - b.heading)) < SAME[1]

"""Whether odometry has the unit and the signs that it must have, by the image.

Turns are in radians and positive to the left, ways positive forward. That belongs to a driver or a recording
and does not change on the way. So it is held against the image only until enough images agree with one
convention.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.observation import Observation
from mapweave.agent.vision.visual_odometry import reduced, visual_motion
from mapweave.hybridmap.camera import Camera

STRIDE = 0.18
"""s, least time between two images that are compared."""
LONGEST = 1.0
"""s, most time: after it the two show too little in common."""
REPORTED = (0.005, 0.01)
"""m and rad; where the odometry is less, images are not compared: a robot that stands has no work with it."""
TURNED = 0.03
"""rad, least turn by the image that says something of the odometry's."""
EXPANDED = 0.01
"""Least way over depth by the image that says something of the odometry's. Of 1250 such pairs of images with
right odometry (five explorations in simulation, and KITTI 03) none goes the other way."""
FACTOR = 2.0
"""Turns agree up to this factor. Of 565 pairs of images with right turns (eight explorations in simulation,
and KITTI 03) the ratio is 0.72 to 2 in 99 %, at most 3.4 in the others, and never negative."""
ENOUGH = 8
"""Pairs that must agree with a convention,"""
SHARE = 0.75
"""and their share of all pairs that have agreed with one."""

DEGREES = math.degrees(1.0)
TURNS = {
    1.0: "",
    -1.0: "the image turns the other way than the odometry: turns are positive to the left. Is their sign "
    "reversed, are left and right wheel exchanged, or the image mirrored or upside down?",
    DEGREES: "the odometry turns 57 times as far as the image: it is in degrees and must be in radians",
    -DEGREES: "the odometry turns 57 times as far as the image, and the other way: it is in degrees and must "
    "be in radians, positive to the left",
}
"""Turn by the odometry over that by the image, and what to say of it."""
WAYS = {
    1.0: "",
    -1.0: "the image moves back where the odometry moves forward: ways are positive forward. Is their sign "
    "reversed, or does the camera face backward?",
}
"""Sign of the odometry's way where the image moves forward, likewise."""


class _Ballot:
    """Counts which convention pairs of images agree with."""

    def __init__(self, lines: Mapping[float, str]) -> None:
        """Take what to say of each convention."""
        self.line: str | None = None
        self._lines = lines
        self._votes = Counter[float]()

    def add(self, ratio: float) -> None:
        for convention in self._lines:
            if self.line is None and 1.0 / FACTOR < ratio / convention < FACTOR:
                self._votes[convention] += 1
                if self._votes[convention] >= max(ENOUGH, SHARE * self._votes.total()):
                    self.line = self._lines[convention]


class OdometryConvention:
    """Watches a robot, or a recording, until it has moved enough."""

    def __init__(self, camera: Camera) -> None:
        """Take the camera of the images."""
        self._camera = camera
        self._turns, self._ways = _Ballot(TURNS), _Ballot(WAYS)
        self._way = self._turn = 0.0
        self._stamp_ns = 0
        self._image: NDArray[np.uint8] | None = None

    @property
    def complaints(self) -> list[str]:
        """What is wrong with the odometry as far as is known, a line each."""
        return [ballot.line for ballot in (self._turns, self._ways) if ballot.line]

    def see(self, observation: Observation) -> None:
        """Take in odometry and image, once a tick."""
        if self._turns.line is not None and self._ways.line is not None:
            self._image = None
            return
        self._way += observation.odometry.forward
        self._turn += observation.odometry.turn
        if observation.image is None:
            return
        seconds = (observation.stamp_ns - self._stamp_ns) * 1e-9
        if self._image is not None and 0.0 <= seconds < STRIDE:
            return
        image = reduced(observation.image)
        if self._image is not None and 0.0 < seconds <= LONGEST:
            self._compare(self._image, image)
        self._image, self._stamp_ns, self._way, self._turn = image, observation.stamp_ns, 0.0, 0.0

    def _compare(self, before: NDArray[np.uint8], now: NDArray[np.uint8]) -> None:
        drives = self._ways.line is None and abs(self._way) > REPORTED[0]
        turns = self._turns.line is None and abs(self._turn) > REPORTED[1]
        motion = visual_motion(before, now, self._camera) if drives or turns else None
        if motion is None:
            return
        if turns and abs(motion.turn) > TURNED:
            self._turns.add(self._turn / motion.turn)
        if drives and abs(motion.expansion) > EXPANDED:
            self._ways.add(math.copysign(1.0, self._way * motion.expansion))

"""Whether the wheels report turns as the image shows them: in radians, and positive to the left.

Unit and sign belong to a driver or a recording and do not change on the way. So they are held against the
image only until enough turns agree with one of four conventions.
"""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.observation import Observation
from mapweave.agent.vision.visual_odometry import reduced, visual_motion
from mapweave.hybridmap.camera import Camera

STRIDE = 0.18
"""s, least time between two images that are compared."""
LONGEST = 1.0
"""s, most time: after it the two show too little in common."""
REPORTED = 0.01
"""rad; where the wheels report less, images are not compared, so a robot that stands has no work with it."""
SEEN = 0.03
"""rad, least turn by the image that says something of the wheels' one."""
FACTOR = 2.0
"""Turns agree up to this factor. Of 565 pairs of images with right turns (eight explorations in simulation,
and KITTI 03) the ratio is 0.72 to 2 in 99 %, at most 3.4 in the others, and never negative."""
ENOUGH = 8
"""Pairs that must agree with a convention,"""
SHARE = 0.75
"""and their share of all pairs that have agreed with one."""

DEGREES = math.degrees(1.0)
CONVENTIONS = {
    1.0: "",
    -1.0: "the image turns the other way than the odometry, so the map is wrong: turns are positive to the "
    "left. Is their sign reversed, are left and right wheel exchanged, or the image mirrored or upside down?",
    DEGREES: "the odometry turns 57 times as far as the image, so the map is wrong: it is in degrees and "
    "must be in radians",
    -DEGREES: "the odometry turns 57 times as far as the image, and the other way, so the map is wrong: it "
    "is in degrees and must be in radians, positive to the left",
}
"""What the wheels report over what they turn, and what to say of it."""


class TurnConvention:
    """Watches a robot, or a recording, until it has turned enough.

    Attributes:
        complaint: what is wrong with the reported turns, in one line; empty if nothing is as far as
            is known.
    """

    def __init__(self, camera: Camera) -> None:
        """Take the camera of the images."""
        self.complaint = ""
        self._camera = camera
        self._votes = Counter[float]()
        self._settled = False
        self._turn = 0.0
        self._stamp_ns = 0
        self._image: NDArray[np.uint8] | None = None

    def see(self, observation: Observation) -> None:
        """Take in what the wheels report and the image, once a tick."""
        if self._settled:
            return
        self._turn += observation.odometry.turn
        if observation.image is None:
            return
        seconds = (observation.stamp_ns - self._stamp_ns) * 1e-9
        if self._image is not None and 0.0 <= seconds < STRIDE:
            return
        image, turn = reduced(observation.image), self._turn
        if self._image is not None and abs(turn) > REPORTED and 0.0 < seconds <= LONGEST:
            motion = visual_motion(self._image, image, self._camera)
            if motion is not None and abs(motion.turn) > SEEN:
                self._vote(turn / motion.turn)
        self._image, self._stamp_ns, self._turn = image, observation.stamp_ns, 0.0

    def _vote(self, ratio: float) -> None:
        for convention in CONVENTIONS:
            if 1.0 / FACTOR < ratio / convention < FACTOR:
                self._votes[convention] += 1
                if self._votes[convention] >= max(ENOUGH, SHARE * self._votes.total()):
                    self.complaint, self._settled, self._image = CONVENTIONS[convention], True, None

"""Whether odometry has the unit, the signs and the times that it must have, by the image.

Turns are in radians and positive to the left, ways in metres and positive forward. That belongs to a driver
or a recording and does not change on the way. So it is held against the image only until enough images
agree with one convention.
"""

import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.agent.observation import Observation
from mapweave.agent.sensor_health.turn_agreement import TurnAgreement
from mapweave.agent.vision.visual_odometry import LEAST_POINTS, POINTS, reduced, visual_motion
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
TOO_FAR = 7.0
"""Turns by the odometry that are so many times those by the image have another unit. Rates at ten images a
second are 10 times as far."""
BELOW = 15.0
"""What is seen below the horizon is at most as low as the floor. Where the odometry makes it so many times as
low, its ways are in another unit. With right ones three of four pairs in eight were never beyond 6.8 (28
explorations in simulation with six cameras, and KITTI 03); in centimetres the median is 46 or more."""
SLOPE = 0.1
"""Of rays to what is seen there: above them, pitching moves the image as much as driving does."""
FLOOR_SLOPE = 0.75
"""The floor expands as what is at this share of the lowest ray's slope: its points weigh by their slopes."""
LITTLE = 0.1
"""rad; a pair that turns less, and drives less than the height of the camera, shows much in common."""
CORNERS, CONTRAST = 3 * LEAST_POINTS, 10.0
"""Corners and standard deviation of an image in which something could be followed. In those explorations none
of 7000 pairs of such images had nothing in common; with shuffled images 75 % or more in 17 of 21."""
ENOUGH, ENOUGH_LITTLE = 8, 40
"""Pairs that must agree with a convention, and those that must (not) show anything in common,"""
SHARE = 0.75
"""and their share of all pairs that have agreed with one."""

DEGREES = math.degrees(1.0)
RIGHT = ""
REVERSED, FAR, FAR_REVERSED = "reversed", "far", "far and reversed"
TURNS = {
    RIGHT: (1.0 / FACTOR, FACTOR), REVERSED: (-FACTOR, -1.0 / FACTOR),
    FAR: (TOO_FAR, math.inf), FAR_REVERSED: (-math.inf, -TOO_FAR),
}  # fmt: skip
"""Between which ratios of the turn by the odometry to that by the image a convention is."""
WAYS = {RIGHT: (0.0, math.inf), REVERSED: (-math.inf, 0.0)}
"""Sign of the odometry's way where the image moves forward, likewise."""
SCALES = {RIGHT: (0.0, BELOW), FAR: (BELOW, math.inf)}
"""Of the depth of what is seen to that of the floor, likewise."""
COMMON = {RIGHT: (0.5, 1.5), REVERSED: (-0.5, 0.5)}
"""1 where the two images show something in common, 0 where not."""
TURNS_REVERSED = (
    "the image turns the other way than the odometry: turns are positive to the left. Is their sign "
    "reversed, are left and right wheel exchanged, or the image mirrored or upside down?"
)
WAYS_REVERSED = (
    "the image moves back where the odometry moves forward: ways are positive forward. Is their sign "
    "reversed, or does the camera face backward?"
)
METRES = (
    "ways since the image before and the height of the camera must be in metres. Are the ways in "
    "centimetres, or speeds?"
)
NOTHING_COMMON = (
    "show nothing in common, though by the odometry the robot has hardly moved between them: are the images "
    "in the wrong order, or of another drive?"
)


class _Ballot:
    """Counts which convention pairs of images agree with."""

    def __init__(self, conventions: Mapping[str, tuple[float, float]], enough: int = ENOUGH) -> None:
        """Take the bounds of each."""
        self.found: str | None = None
        self._conventions, self._enough = conventions, enough
        self._votes = defaultdict[str, list[float]](list)

    @property
    def figure(self) -> float:
        """Median size of the ratios that agree with the convention that was found; 0 if none was."""
        return float(np.median(np.abs(self._votes[self.found]))) if self.found is not None else 0.0

    @property
    def share(self) -> float:
        """The share of the pairs that agree with it; 0 if none was."""
        return len(self._votes[self.found]) / self.count if self.found is not None else 0.0

    @property
    def count(self) -> int:
        """How many pairs agreed with any."""
        return sum(map(len, self._votes.values()))

    def add(self, ratio: float) -> None:
        for name, (low, high) in self._conventions.items():
            if self.found is None and low < ratio < high:
                self._votes[name].append(ratio)
                if len(self._votes[name]) >= max(self._enough, SHARE * self.count):
                    self.found = name


class OdometryConvention:
    """Watches a robot, or a recording, until it has moved enough."""

    def __init__(self, camera: Camera) -> None:
        """Take the camera of the images."""
        self._camera = camera
        self._turns, self._ways, self._scales = _Ballot(TURNS), _Ballot(WAYS), _Ballot(SCALES)
        self._common = _Ballot(COMMON, ENOUGH_LITTLE)
        self._agreement = TurnAgreement()
        self._way = self._turn = 0.0
        self._stamp_ns = self._begun_ns = self._ticks = 0
        self._image: NDArray[np.uint8] | None = None

    @property
    def complaints(self) -> list[str]:
        """What is wrong with the odometry as far as is known, a line each."""
        if self._agreement.line:
            return [self._agreement.line]  # what else was found may follow from it
        lines = [self._of_turns()]
        if self._ways.found == REVERSED:
            lines.append(WAYS_REVERSED)
        if self._scales.found == FAR:
            times = f"{self._scales.figure:.0f} times as low as the floor"
            lines.append(f"what is seen below the horizon is {times} by the odometry: {METRES}")
        if self._common.found == REVERSED:
            share = 100.0 * self._common.share
            lines.append(f"{share:.0f} % of {self._common.count} pairs of images {NOTHING_COMMON}")
        return [line for line in lines if line]

    def _of_turns(self) -> str:
        found, times = self._turns.found, self._turns.figure
        if found == REVERSED:
            return TURNS_REVERSED
        if found not in (FAR, FAR_REVERSED):
            return ""
        rate = self._ticks / max(1e-9 * (self._stamp_ns - self._begun_ns), 1e-3)
        units = {DEGREES: "degrees", rate: "rad/s", DEGREES * rate: "degrees/s"}
        unit = units[min(units, key=lambda factor: abs(math.log(times / factor)))]
        since = "" if unit == "degrees" else " since the image before"
        other, left = (", and the other way", ", positive to the left") if found == FAR_REVERSED else ("", "")
        return (
            f"the odometry turns {times:.0f} times as far as the image{other}: it is in {unit} and must "
            f"be in radians{since}{left}"
        )

    def see(self, observation: Observation) -> None:
        """Take in odometry and image, once a tick."""
        if None not in (*(one.found for one in self._ballots()), self._agreement.line):
            self._image = None
            return
        self._agreement.step(observation)
        self._begun_ns = self._begun_ns or observation.stamp_ns
        self._ticks += 1
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

    def _ballots(self) -> tuple[_Ballot, ...]:
        return self._turns, self._ways, self._scales, self._common

    def _compare(self, before: NDArray[np.uint8], now: NDArray[np.uint8]) -> None:
        drives, turns = abs(self._way) > REPORTED[0], abs(self._turn) > REPORTED[1]
        if not (drives or turns):
            return
        motion = visual_motion(before, now, self._camera)
        little = abs(self._turn) < LITTLE and abs(self._way) < self._camera.mount_height
        if little and self._common.found is None and (motion is not None or _distinct(before, now)):
            self._common.add(float(motion is not None))
        if motion is None:
            return
        if turns and abs(motion.turn) > TURNED:
            self._turns.add(self._turn / motion.turn)
        if drives and abs(motion.expansion) > EXPANDED:
            self._ways.add(math.copysign(1.0, self._way * motion.expansion))
        if drives and self._scales.found is None:
            self._scales.add(self._depth_to_floor(before, now))
        if self._agreement.line is None:
            telling = max(abs(motion.turn), abs(self._turn)) > TURNED
            sideways = self._sideways(before, now) if telling else math.nan
            self._agreement.add(self._stamp_ns, self._turn, motion.turn, sideways)

    def _depth_to_floor(self, before: NDArray[np.uint8], now: NDArray[np.uint8]) -> float:
        """Depth of what is seen below the horizon, by the odometry; 0 if it is not seen."""
        camera, scale = self._camera, before.shape[1] / self._camera.width
        lowest = (camera.height - camera.cy) / camera.fy
        row = math.ceil((camera.cy + SLOPE * camera.fy) * scale)
        if not 0 < row < before.shape[0] - 1 or camera.mount_height <= 0.0:
            return 0.0
        lower = replace(camera, height=camera.height - round(row / scale), cy=camera.cy - row / scale)
        motion = visual_motion(before[row:], now[row:], lower)
        if motion is None or abs(motion.expansion) < EXPANDED:
            return 0.0
        return FLOOR_SLOPE * lowest * self._way / motion.expansion / camera.mount_height

    def _sideways(self, before: NDArray[np.uint8], now: NDArray[np.uint8]) -> float:
        """The turn of the images turned by 90 degrees to the left, rad; NaN if they show too little."""
        c = self._camera
        turned = replace(c, width=c.height, height=c.width, fx=c.fy, fy=c.fx, cx=c.cy, cy=c.width - 1 - c.cx)
        motion = visual_motion(np.rot90(before).copy(), np.rot90(now).copy(), turned)
        return math.nan if motion is None else motion.turn


def _distinct(*images: NDArray[np.uint8]) -> bool:
    """Whether much could be followed in each of some images."""
    for image in images:
        corners = cv2.goodFeaturesToTrack(image, POINTS, 0.01, 7)
        if corners is None or len(corners) < CORNERS or float(image.std()) < CONTRAST:
            return False
    return True

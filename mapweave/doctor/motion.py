"""Encoders against the image: do both measure the same motion?"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from mapweave.doctor.finding import Finding, good, skipped, warning, wrong

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from mapweave.agent.observation import Observation, RobotDescription

SUBJECT = "encoders"
CALIBRATE = "mapweave calibrate drive"
LEAST_TURN = 0.25
"""rad, either way, from which turns are compared,"""
LEAST_WAY = 0.08
"""m, and from which ways are."""
STILL = 0.15
"""Of the one, as a share of these, while the other has moved: it stands."""
RATIO = (0.85, 1.18)
"""Turn by the image over that by the encoders; beyond, the geometry is declared wrongly. A right one has 1.00
(office in simulation)."""
EXPANSION = 0.03
"""Sum of way over depth that shows a drive: 0.1 m in a room of 3 m."""


class MotionComparison:
    """Adds up what encoders and image say of each step."""

    def __init__(self, description: RobotDescription) -> None:
        """Nothing has moved."""
        from mapweave.vision.lens import Lens

        self._camera = description.camera
        self._lens = Lens(description.camera, description.distortion)
        self._image: NDArray[np.uint8] | None = None
        self._way = self._turn = 0.0
        self.compared = 0
        # Sums over steps: |wheels|, |image|, wheels * image, wheels^2; of turns and of ways.
        self.turns = [0.0, 0.0, 0.0, 0.0]
        self.ways = [0.0, 0.0, 0.0, 0.0]

    def see(self, observation: Observation) -> None:
        """Take in one observation."""
        from mapweave.agent.vision.visual_odometry import visual_motion

        self._way += observation.odometry.forward
        self._turn += observation.odometry.turn
        if observation.image is None:
            return
        image = self._lens.rectified(observation.image)
        if self._image is not None:
            motion = visual_motion(self._image, image, self._camera)
            if motion is not None:
                self.compared += 1
                pairs = ((self.turns, self._turn, motion.turn), (self.ways, self._way, motion.expansion))
                for sums, wheels, seen in pairs:
                    steps = (abs(wheels), abs(seen), wheels * seen, wheels**2)
                    sums[:] = [total + step for total, step in zip(sums, steps, strict=True)]
        self._image, self._way, self._turn = image, 0.0, 0.0

    @property
    def moved(self) -> bool:
        """Whether encoders or image have moved enough for a judgement of turns and of ways."""
        turned = max(self.turns[0], self.turns[1]) >= LEAST_TURN
        return turned and (self.ways[0] >= LEAST_WAY or self.ways[1] >= EXPANSION)

    def judge(self, stopped: str = "") -> Iterator[Finding]:
        """What the sums say.

        Args:
            stopped: why a robot that drives by itself was held back; empty if it was not.
        """
        wheel_turn, image_turn, product, square = self.turns
        wheel_way, image_way, way_product, _ = self.ways
        words = (
            f"wheels {wheel_way:.2f} m and {wheel_turn:.1f} rad, image {image_turn:.1f} rad, "
            f"by {self.compared} images"
        )
        if not self.compared:
            yield skipped(
                SUBJECT, "the image shows too little to follow", "face a wall with pictures or furniture"
            )
            return
        wheels_moved = wheel_turn >= LEAST_TURN or wheel_way >= LEAST_WAY
        image_moved = image_turn >= LEAST_TURN or image_way >= EXPANSION
        if not wheels_moved and not image_moved:
            yield skipped(SUBJECT, f"nothing has moved: {words}", "push the robot, or let it drive: --drive")
        elif not wheels_moved and wheel_turn < STILL * LEAST_TURN and wheel_way < STILL * LEAST_WAY:
            yield wrong(
                SUBJECT, f"the image moves and the encoders do not count: {words}",
                "check the encoders' cables and [robot.options]; a lifted robot turns no wheel",
            )  # fmt: skip
        elif wheels_moved and image_turn < STILL * LEAST_TURN and image_way < STILL * EXPANSION:
            yield wrong(
                SUBJECT, f"the encoders count and the image stands still: {words}",
                "is it this robot's camera? Do the wheels spin?",
            )  # fmt: skip
        elif wheel_turn >= LEAST_TURN and product < 0.0:
            yield wrong(
                SUBJECT, f"the image turns the other way: {words}",
                "left and right encoder are exchanged, or the image is mirrored",
            )  # fmt: skip
        elif wheel_way >= LEAST_WAY and image_way >= EXPANSION and way_product < 0.0:
            yield wrong(
                SUBJECT, f"forward by the encoders is backward by the image: {words}",
                "exchange the motors' and encoders' signs, or turn the camera to face ahead",
            )  # fmt: skip
        elif wheel_turn >= LEAST_TURN and not RATIO[0] <= product / square <= RATIO[1]:
            yield wrong(
                SUBJECT, f"the image turns {product / square:.2f} times as far as the encoders: {words}",
                f"axle, counts of a turn, wheel radius or fx are wrong, or one encoder is dead: {CALIBRATE}",
            )  # fmt: skip
        elif wheel_turn < LEAST_TURN or wheel_way < LEAST_WAY:
            advice = "drive and turn a little more"
            if stopped:
                advice = f"{stopped}: put the robot where it has half a metre of free floor ahead"
            yield warning(SUBJECT, f"too little motion to compare all: {words}", advice)
        else:
            yield good(SUBJECT, f"agree with the image, turns to {product / square:.2f}: {words}")

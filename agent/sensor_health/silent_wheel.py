"""An encoder that counts nothing while its wheel turns, on a robot that a person drives or carries along.

`encoder_monitor` finds it by the robot's own commands. Without them a wheel that counts nothing may as well
stand: a robot can turn about it. Then the image turns as the wheels say.
"""

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.observation import Observation, RobotDescription
from mapweave.agent.sensor_health.encoder_monitor import MOVES, STRIDE, TURNS_APART, VERDICTS, WINDOW
from mapweave.agent.vision.image_quality import LEAST_CORNERS, strongest_corners
from mapweave.agent.vision.visual_odometry import reduced, visual_motion

NOTHING = 1e-5
"""m; a wheel of less counts nothing. Encoders of no robot are finer."""
LEAST_WAY = 0.1
"""m, of the other wheel in a window."""
SIDES = ("left", "right")


class SilentWheel:
    """Watches wheels and images of a robot whose wheels have no command of its own.

    Attributes:
        complaint: which encoder does not count, in words; empty if none was found.
    """

    def __init__(self, description: RobotDescription) -> None:
        """Nothing was seen."""
        self.complaint = ""
        self._camera = description.camera
        self._half = 0.5 * description.axle
        self._side: int | None = None
        self._forget()

    def _forget(self) -> None:
        self._verdicts = 0
        self._last: tuple[float, NDArray[np.uint8]] | None = None
        self._begin_window()

    def _begin_window(self) -> None:
        self._way = self._seconds = self._seen = self._expansion = 0.0
        # Of the wheels since the last image that was compared: the two must end with the same image.
        self._pending = 0.0

    def see(self, observation: Observation) -> None:
        """Take in one tick, with the odometry as it is read."""
        if self.complaint:
            return
        odometry = observation.odometry
        ways = odometry.forward - self._half * odometry.turn, odometry.forward + self._half * odometry.turn
        counts = [abs(way) >= NOTHING for way in ways]
        side = None if counts[0] == counts[1] else counts.index(False)
        if side != self._side:
            self._side = side
            self._forget()
        if side is None:
            return
        self._pending += ways[1 - side]
        now = 1e-9 * observation.stamp_ns
        if observation.image is None or (self._last is not None and now - self._last[0] < STRIDE):
            return
        image = reduced(observation.image)
        if len(strongest_corners(image)) < LEAST_CORNERS:
            self._forget()
            return
        last, self._last = self._last, (now, image)
        way, self._pending = self._pending, 0.0
        if last is None:
            return
        motion = visual_motion(last[1], image, self._camera)
        if motion is None or now - last[0] > 3.0 * STRIDE:
            self._forget()
            return
        self._way += way
        self._seconds += now - last[0]
        self._seen, self._expansion = self._seen + motion.turn, self._expansion + motion.expansion
        if self._seconds >= WINDOW:
            self._judge(side)

    def _judge(self, side: int) -> None:
        turn = (self._way if side == 0 else -self._way) / (2.0 * self._half)
        moves = abs(self._seen) > MOVES[0] or abs(self._expansion) > MOVES[1]
        apart = abs(self._seen - turn) > TURNS_APART[0] + TURNS_APART[1] * abs(turn)
        self._verdicts = self._verdicts + 1 if moves and apart and abs(self._way) >= LEAST_WAY else 0
        self._begin_window()
        if self._verdicts >= VERDICTS:
            self.complaint = (
                f"the {SIDES[side]} encoder counts nothing while the image shows that its wheel turns: "
                "check its cable"
            )

"""Whether the encoders count what the wheels do, held against the commands and against the image.

No two of the three can tell alone. Wheels that do not obey may be stuck; wheels that count without a command
may be pushed by a person. The image decides: its turn is exact without any map or wheel, and it says whether
the robot has moved at all (`visual_odometry`). It is looked at only where wheels and command contradict each
other, or where the image stands while the wheels count.
"""

import math
from collections import deque
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.agent.observation import Command, Observation, RobotDescription
from mapweave.agent.vision.image_quality import LEAST_CORNERS, strongest_corners
from mapweave.agent.vision.visual_odometry import VisualMotion, reduced, visual_motion
from mapweave.hybridmap.pose import Array

WINDOW = 1.0
"""s over which the three are compared."""
STRIDE = 0.2
"""s between two images that are compared: a turn at 0.8 rad/s moves points by 22 px."""
VERDICTS = 2
"""Windows that must agree, one `STRIDE` apart."""
CONTRADICTS = (0.03, 0.5)
"""A wheel's way contradicts its command from this on, m, and this share of the command: wheels need 0.2 s
to get up to speed."""
DEAD = 0.1
"""A wheel that makes less than this share of its command does not count,"""
LEAST_COMMAND = 0.05
"""if it was to go at least this far, m."""
COUNTS = (0.15, 0.2)
"""Way, m, or turn, rad, from which wheels count clearly."""
TURNS_APART = (0.15, 0.25)
"""Turns of image and wheels contradict each other from this on, rad, and this share of the wheels' turn."""
STILL = (0.02, 0.005)
"""Turn, rad, and way over depth below which the image has stood: 0.15 m up to 30 m away are more."""
MOVES = (0.05, 0.01)
"""The same above which it has moved."""
SMALL_PX = (64, 48)
"""Size to which images are reduced before they are compared: each pixel is the mean of 25 of an image of 320
x 240."""
AT_REST = 3.0
"""Mean difference of two reduced images, grey levels, below which nothing has moved. Noise of 8 grey levels
leaves 2.0; a way of 0.1 m or a turn of 0.1 rad within 4 s leaves 16 and more (office in simulation)."""
JUMP = (2.0, 0.05)
"""So many times its limit, and this much more, m, no wheel gets on in a tick: not by its motor, and hardly by
a person's hand."""
OBEYS = (0.5, 1.6)
"""Wheels whose ways are this share of their commands obey again,"""
ENOUGH = 0.04
"""once both were to go this far, m, to and fro."""


class _Moment(NamedTuple):
    """One tick: wheels (2,) m, left and right, and the image, reduced and reduced further."""

    number: int
    commanded: Array
    measured: Array
    image: NDArray[np.uint8] | None
    small: NDArray[np.float32] | None


class _Seen(NamedTuple):
    """Motion by the images of a window: turn, rad, and way over depth."""

    turn: float
    expansion: float
    gross_turn: float

    @property
    def moves(self) -> bool:
        return abs(self.turn) > MOVES[0] or abs(self.expansion) > MOVES[1]

    @property
    def stands(self) -> bool:
        return abs(self.turn) < STILL[0] and abs(self.expansion) < STILL[1]


class EncoderMonitor:
    """Watches a robot that drives by its own commands.

    Attributes:
        fault: what is wrong, in words; empty if nothing is. It stays until the wheels have obeyed a command
            and the image agrees: a robot that stands must be moved to show that.
    """

    def __init__(self, description: RobotDescription) -> None:
        """Nothing was commanded yet."""
        self.fault = ""
        self._description = description
        tick, half = description.tick, description.axle / 2
        self._stride = max(round(STRIDE / tick), 1)
        self._moments: deque[_Moment] = deque(maxlen=max(round(WINDOW / tick), 2 * self._stride) + 1)
        self._wheels_from_body = np.array([[1.0, -half], [1.0, half]])
        fastest = description.max_forward + half * description.max_turn
        self._most = JUMP[0] * fastest * tick + JUMP[1]
        self._motions: dict[tuple[int, int], VisualMotion | None] = {}
        self._count = 0
        self._suspicions = 0
        self._wait = 0

    def see(self, observation: Observation, command: Command | None, ticks: float = 1.0) -> None:
        """Take in one tick.

        Args:
            observation: of it.
            command: that the wheels had since the observation before; None if they were not the robot's own.
            ticks: for how long they had it.
        """
        if command is None or not self._description.max_forward:
            self._moments.clear()
            self._suspicions = 0
            return
        odometry, image = observation.odometry, observation.image
        seconds = self._description.tick * ticks
        measured = self._wheels_from_body @ [odometry.forward, odometry.turn]
        commanded = self._wheels_from_body @ [command.forward, command.turn] * seconds
        small = None
        if image is not None:
            image = reduced(image)
            small = np.asarray(cv2.resize(image, SMALL_PX, interpolation=cv2.INTER_AREA), np.float32)
        self._count += 1
        self._moments.append(_Moment(self._count, commanded, measured, image, small))
        self._wait = max(self._wait - 1, 0)
        jump = float(np.abs(measured).max())
        if jump > self._most * max(ticks, 1.0):
            self.fault = f"the encoders jump by {jump:.2f} m in {seconds:.1f} s"
            self._moments.clear()
        elif len(self._moments) == self._moments.maxlen and not self._wait:
            self._judge()

    def _judge(self) -> None:
        commanded = np.array([moment.commanded for moment in self._moments])[1:]
        measured = np.array([moment.measured for moment in self._moments])[1:]
        if self.fault:
            if self._obeys(commanded, measured):
                self.fault = ""
            return
        wanted, counted = commanded.sum(axis=0), measured.sum(axis=0)
        apart = np.abs(counted - wanted) > CONTRADICTS[0] + CONTRADICTS[1] * np.abs(wanted)
        if not (apart.any() or (self._counts(counted) and self._looks_still())):
            self._suspicions = 0
            return
        self._wait = self._stride
        seen = self._seen()
        words = "" if seen is None else self._contradiction(wanted, counted, seen)
        self._suspicions = self._suspicions + 1 if words else 0
        if self._suspicions >= VERDICTS:
            self.fault, self._suspicions = words, 0
            self._moments.clear()

    def _contradiction(self, wanted: Array, counted: Array, seen: _Seen) -> str:
        """What image and wheels say that cannot both be true, in words; empty if they can.

        Args:
            wanted: (2,) m, ways of the wheels by their commands.
            counted: (2,) m, by the encoders.
            seen: by the image.
        """
        axle = self._description.axle
        turn, wanted_turn = ((way[1] - way[0]) / axle for way in (counted, wanted))
        dead = (np.abs(wanted) >= LEAST_COMMAND) & (np.abs(counted) < DEAD * np.abs(wanted))
        if dead.all():
            # Who walks past a robot that is stuck does not move the image as its command would.
            sideways = abs(wanted_turn) > TURNS_APART[0]
            along = seen.turn * wanted_turn if sideways else seen.expansion * float(wanted.sum())
            agrees = seen.moves and along > 0.0
            return "the encoders do not count while the image moves: check their cable" if agrees else ""
        if abs(seen.turn - turn) > TURNS_APART[0] + TURNS_APART[1] * abs(turn):
            if dead.any() and abs(seen.turn - wanted_turn) < abs(seen.turn - turn):
                side = "left" if dead[0] else "right"
                return f"the {side} encoder does not count while its wheel drives: check its cable"
            if not seen.stands:
                return (
                    f"the encoders count a turn of {math.degrees(turn):.0f} degrees and the image turns by "
                    f"{math.degrees(seen.turn):.0f}: one of them runs away, or a wheel spins"
                )
        way = float(counted.mean())
        if (np.abs(wanted) >= LEAST_COMMAND).all():
            against = -counted / wanted
            if ((against >= OBEYS[0]) & (against <= OBEYS[1])).all():
                turns = abs(turn) >= TURNS_APART[0]
                if (seen.turn * turn if turns else seen.expansion * way) > 0.0:
                    part = (
                        "left and right motor, or the sign of turns" if turns else "the sign of both motors"
                    )
                    return (
                        "the wheels go the other way than they are commanded, and the image agrees: "
                        f"exchange {part}"
                    )
        stands = seen.stands and self._looks_still()
        if (stands and self._counts(counted)) or (
            abs(way) >= COUNTS[0] and math.copysign(seen.expansion, way * seen.expansion) < STILL[1]
        ):
            return (
                f"the encoders count a way of {way:.2f} m and a turn of {math.degrees(turn):.0f} degrees "
                "that the image does not show: they run away, or the wheels spin"
            )
        return ""

    def _obeys(self, commanded: Array, measured: Array) -> bool:
        """Whether both wheels were commanded to move, and encoders and image say that they did."""
        wanted, counted = np.abs(commanded).sum(axis=0), np.abs(measured).sum(axis=0)
        if (wanted < ENOUGH).any() or not (OBEYS[0] * wanted <= counted).all():
            return False
        if not (counted <= OBEYS[1] * wanted + CONTRADICTS[0]).all():
            return False
        seen = self._seen()
        turned = float(np.abs(measured[:, 1] - measured[:, 0]).sum()) / self._description.axle
        # Where the image shows too little to judge by, as before a bare wall, the wheels are believed.
        return seen is None or abs(seen.gross_turn - turned) <= TURNS_APART[0] + TURNS_APART[1] * turned

    def _counts(self, counted: Array) -> bool:
        turn = abs(counted[1] - counted[0]) / self._description.axle
        return bool(abs(counted.mean()) >= COUNTS[0] or turn >= COUNTS[1])

    def _looks_still(self) -> bool:
        """Whether the image has not changed over the window; the cheap test that comes before any other."""
        seen = [moment.small for moment in self._moments if moment.small is not None]
        if len(seen) < len(self._moments) // 2:
            return False
        # The last first: while the robot moves, it is the one that differs.
        return all(float(np.abs(one - seen[0]).mean()) < AT_REST for one in reversed(seen[1:]))

    def _seen(self) -> _Seen | None:
        """How the robot has moved by its images; None if they show too little."""
        moments = list(self._moments)[:: self._stride]
        for end in (moments[0].image, moments[-1].image):
            # On a bare wall the noise is followed, and that stands.
            if end is None or len(strongest_corners(end)) < LEAST_CORNERS:
                return None
        turn = expansion = gross = 0.0
        for before, now in pairwise(moments):
            motion = self._motion(before, now)
            if motion is None:
                return None
            turn, expansion = turn + motion.turn, expansion + motion.expansion
            gross += abs(motion.turn)
        return _Seen(turn, expansion, gross)

    def _motion(self, before: _Moment, now: _Moment) -> VisualMotion | None:
        """Motion by two images. It is kept: a second verdict judges most of the images of the first."""
        oldest = self._moments[0].number
        self._motions = {pair: motion for pair, motion in self._motions.items() if pair[0] >= oldest}
        if before.image is None or now.image is None:
            return None
        pair = before.number, now.number
        if pair not in self._motions:
            self._motions[pair] = visual_motion(before.image, now.image, self._description.camera)
        return self._motions[pair]

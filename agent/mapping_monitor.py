"""Why a robot that shall map makes no nodes, in words: for the log and for the status line.

Much of it the pipeline says itself (`Status.detail`). The rest is found here, from observations and commands
alone: images that show nothing, wheels and image of which only one moves, wheels that do not obey.
"""

from collections import deque
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.agent.observation import Command, Observation, RobotDescription
from mapweave.agent.sensor_health.clock_monitor import AHEAD
from mapweave.agent.sensor_health.encoder_monitor import AT_REST, SMALL_PX
from mapweave.agent.vision.image_quality import ImageQuality
from mapweave.hybridmap.agent_status import Status

MAPPING = ("explore", "carried")
"""Missions that make nodes."""
WINDOW = 4.0
"""s over which motion of image, wheels and commands is compared."""
QUIET = 5.0
"""s without a new node after which the cause is sought, once a second; it takes as long as a tick."""
PATIENCE = 15.0
"""s without a new node after which the reason is reported; exploring robots need up to 10 s for a node."""
AGAIN = 60.0
"""s until the same reason is reported again."""
MOVING = (0.1, 0.1)
"""Way, m, or turn, rad, within the window from which wheels have moved, or were commanded to."""
STANDING = (0.005, 0.005)
"""Way, m, and turn, rad, within the window below which they stand."""


class MonitoredTick(NamedTuple):
    """One tick.

    Attributes:
        stamp_ns: of the observation.
        way: of the wheels since the tick before, m, not negative.
        turn: likewise, rad.
        commanded_way: m that the command of the tick before asked for.
        commanded_turn: likewise, rad.
        small: the image, reduced; None without one.
    """

    stamp_ns: int
    way: float
    turn: float
    commanded_way: float
    commanded_turn: float
    small: NDArray[np.float32] | None


class MappingMonitor:
    """Watches a robot's ticks, and says why there are no nodes."""

    def __init__(self, description: RobotDescription) -> None:
        """Nothing is seen yet."""
        self._tick = description.tick
        self._driven = description.max_forward > 0.0
        self._moments: deque[MonitoredTick] = deque(maxlen=max(round(WINDOW / description.tick), 2))
        self._command = Command()
        self._fault = ""
        self._nodes = 0
        self._last_node_ns = self._last_look_ns = self._reported_ns = 0
        self._reported = ""

    def see(self, observation: Observation, status: Status, command: Command) -> str:
        """Take in one tick.

        Args:
            observation: of this tick.
            status: of the pipeline after it.
            command: of the pipeline, for the time until the next.

        Returns:
            A line for the log when there has been no node for long; else nothing.
        """
        now = observation.stamp_ns
        step = now - self._moments[-1].stamp_ns if self._moments else 0
        if not 0 <= step <= max(AHEAD, 10.0 * self._tick) * 1e9:
            # The clock has jumped.
            self._last_look_ns = self._last_node_ns = self._reported_ns = 0
        if not self._last_node_ns or status.nodes != self._nodes or status.finished:
            self._nodes, self._last_node_ns, self._reported, self._fault = status.nodes, now, "", ""
        self._remember(observation)
        self._command = command
        if now - self._last_look_ns >= 1e9 and now - self._last_node_ns >= QUIET * 1e9:
            self._last_look_ns = now
            self._fault = self._find_fault(observation.image, status.mission)
        if now - self._last_node_ns < PATIENCE * 1e9 or status.mission not in (*MAPPING, "idle"):
            return ""
        reason = self.reason(status)
        words = " ".join(word for word in reason.split() if word.isalpha())
        if words == self._reported or (self._reported and now - self._reported_ns < AGAIN * 1e9):
            return ""
        self._reported, self._reported_ns = words, now
        return f"no new node for {(now - self._last_node_ns) * 1e-9:.0f} s: {reason}"

    def explained(self, status: Status) -> Status:
        """The status of a robot that maps, with what is wrong with images or wheels."""
        if not self._fault or status.mission not in MAPPING or status.finished:
            return status
        return replace(status, detail="; ".join(part for part in (status.detail, self._fault) if part))

    def reason(self, status: Status) -> str:
        """Why there are no nodes."""
        if status.mission == "idle":
            return "the mission is idle: nothing is mapped; `--mission explore` or `carried` maps"
        return self._fault or status.words

    def _remember(self, observation: Observation) -> None:
        odometry, command, image = observation.odometry, self._command, observation.image
        small = None
        if image is not None:
            reduced = cv2.resize(image, SMALL_PX, interpolation=cv2.INTER_AREA)
            small = np.asarray(reduced, np.float32)
        self._moments.append(
            MonitoredTick(
                observation.stamp_ns, abs(odometry.forward), abs(odometry.turn),
                abs(command.forward) * self._tick, abs(command.turn) * self._tick, small,
            )
        )  # fmt: skip

    def _find_fault(self, image: NDArray[np.uint8] | None, mission: str) -> str:
        if not any(moment.small is not None for moment in self._moments):
            return f"no image for {len(self._moments) * self._tick:.0f} s: is the camera connected?"
        quality = "" if image is None else ImageQuality.of(image).fault
        if quality or len(self._moments) < (self._moments.maxlen or 0):
            return quality
        wheels, commanded = self._moved(1, 2), self._moved(3, 4)
        image_moves = self._image_moves
        if wheels == "moving" and image_moves is False:
            return (
                "the wheels turn and the image stands still: is it this robot's camera, does it deliver new "
                "images, do the wheels spin?"
            )
        if wheels == "standing" and image_moves and commanded == "moving":
            return "the image moves and the encoders do not count: check their cable and [robot.options]"
        if wheels == "standing" and image_moves and commanded == "standing" and mission == "carried":
            # No image can tell these apart: a train that passes looks like a turn of the robot.
            return (
                "the image moves and the wheels count nothing: is the robot carried, does something pass in "
                "front of it, or does neither encoder count (cable, [robot.options])?"
            )
        if wheels == "standing" and image_moves is False and commanded == "moving" and self._driven:
            return "the wheels do not obey: check motor power, emergency stop, and whether the robot is stuck"
        # A robot that explores says itself why it stands.
        if wheels == "standing" and image_moves is False and mission != "explore":
            return "the robot stands still: depths are measured in motion"
        return ""

    def _moved(self, way: int, turn: int) -> str:
        """Whether something has moved, stood, or neither clearly, by two columns of the moments."""
        sums = [sum(float(moment[column] or 0.0) for moment in self._moments) for column in (way, turn)]
        if any(value >= least for value, least in zip(sums, MOVING, strict=True)):
            return "moving"
        return "standing" if all(v <= most for v, most in zip(sums, STANDING, strict=True)) else ""

    @property
    def _image_moves(self) -> bool | None:
        """Whether the image has changed within the window; None if there are too few."""
        seen = [moment.small for moment in self._moments if moment.small is not None]
        if len(seen) < len(self._moments) // 2:
            return None
        first = seen[0]
        steps = max(len(seen) // 8, 1)
        return any(float(np.abs(one - first).mean()) > AT_REST for one in [*seen[::steps], seen[-1]])

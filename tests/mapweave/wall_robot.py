"""A driver of a robot before photographs: `--robot .../wall_robot.py:WallRobot`. It moves as it is commanded.

It writes how far it has driven, m, into the file that `WALL_ROBOT` names. Its clock is ahead by as many s as
the file says that `WALL_ROBOT_CLOCK` names, if there is one.
"""

import math
import os
import time
from pathlib import Path

import numpy as np

from mapweave import Command, Observation, Odometry, Pose2, RobotDescription
from tests.agent.conftest import CAMERA, PhotoWalls

TICK = 0.1
BEARINGS = tuple(np.linspace(-math.pi, math.pi, 16, endpoint=False).tolist())
NOTHING = np.full((CAMERA.height, CAMERA.width), 128, np.uint8)
"""What it sees with the photographs behind it."""


class WallRobot:
    """Nothing is in its way."""

    def __init__(self, settings: object) -> None:
        self._walls, self._rng = PhotoWalls(), np.random.default_rng(0)
        self._pose, self._moved, self._way = Pose2(), Odometry(0.0, 0.0), 0.0
        self._due = time.monotonic()

    def describe(self) -> RobotDescription:
        return RobotDescription(camera=CAMERA, ranger_bearings=BEARINGS, ranger_reach=3.0, tick=TICK)

    def sense(self) -> Observation:
        time.sleep(max(0.0, self._due - time.monotonic()))
        self._due = max(self._due, time.monotonic() - TICK) + TICK
        ahead = abs(self._pose.heading) < 1.0
        here = Pose2(*(round(value, 3) for value in self._pose.vector.tolist()))
        image = self._walls.render(here) if ahead else NOTHING
        noisy = np.clip(image + self._rng.normal(0.0, 2.0, image.shape), 0, 255).astype(np.uint8)
        clock = Path(os.environ.get("WALL_ROBOT_CLOCK", ""))
        ahead_s = float(clock.read_text()) if clock.is_file() else 0.0
        written = Path(os.environ["WALL_ROBOT"])
        new = written.with_suffix(".new")
        new.write_text(f"{self._way}")
        new.replace(written)
        return Observation(time.time_ns() + int(ahead_s * 1e9), self._moved, noisy, np.full(16, 3.0))

    def act(self, command: Command) -> Command:
        self._moved = Odometry(command.forward * TICK, command.turn * TICK)
        self._pose = self._pose @ self._moved.motion()
        self._way += abs(self._moved.forward)
        return command

    def close(self) -> None:
        pass

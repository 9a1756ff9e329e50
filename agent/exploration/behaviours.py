"""The moves of exploration: map the view ahead, turn to the next one, travel along a way."""

import math
from collections.abc import Generator, Iterator
from enum import StrEnum

import numpy as np

from mapweave.agent.clearance import clearance
from mapweave.agent.mapping.episode import EpisodeRequest, Move
from mapweave.agent.mapping.mapper import Mapper
from mapweave.agent.observation import Command, Observation, RobotDescription
from mapweave.agent.servo.image_drive import ImageDrive
from mapweave.agent.servo.leg_controller import clip
from mapweave.agent.settings import ExplorerSettings
from mapweave.hybridmap.pose import Array, Pose2, wrap_angle


class Phase(StrEnum):
    """What the explorer is doing, in words for the status line."""

    LOOKING = "waiting for a first image"
    DRIVING = "driving back and forth to map the view"
    TURNING = "turning to the next view"
    SCANNING = "turning where the map shows everything already"
    TRAVELLING = "travelling to the next place"
    WAITING = "standing: a place could not be reached; trying it again later"
    STUCK = "standing: the wheels do not move the robot"
    DONE = "no new place in reach: exploration is complete"
    NOT_DARED = "standing: the rest cannot be reached over floor that the camera has shown free"


DRIVE = 0.6
"""How far it drives back and forth to map a view, m."""
LEAST_DRIVE = 0.2
"""With less room than this the view is mapped as well as it can be while turning, m."""
LEAST_FEATURES = 10
"""A view with fewer features is not worth a drive."""
LEFT = 4
"""The turn ends when at most this many of the view's features are left (paper: four)."""
LEAST_TURN = 0.45
"""The turn to the next view does not end before this angle, rad."""
MOST_TURN = 1.0
"""The turn to the next view ends at this angle, rad."""
TRAVEL_STEP = 0.8
"""Longest way between two nodes on the way to the next place, m."""
LEAST_MOTION = 0.1
"""A turn that ends before this angle, rad, has not moved the robot."""
STUCK_TURNS = 3
"""After so many of them in a row its wheels are stuck."""
STUCK_PAUSE = (60.0, 600.0)
"""A stuck robot tries another turn after so long, s; later after twice as long each, up to the second."""
USUAL_TICK = 0.1
"""s; durations are bounded by numbers of these."""
PATIENCE = 4.0
"""Time without getting on before a way is given up, s."""


class ExplorationBehaviours:
    """The behaviours of exploration, one generator each: each `yield` is a command for one tick, or a request
    to the mapper that is met before the generator goes on.

    Attributes:
        phase: what it is doing.
        detail: why, in words.
        patience: how many times longer than usual a drive may take.
    """

    def __init__(self, description: RobotDescription, mapper: Mapper, settings: ExplorerSettings) -> None:
        """Take the robot's description, and the mapper that the pipeline keeps up to date."""
        self.phase = Phase.LOOKING
        self.detail = ""
        self.patience = 1.0
        self._description = description
        self._mapper = mapper
        self._settings = settings
        self._drive = ImageDrive(description, settings.drive_speed)
        self._observation: Observation | None = None
        self._without_motion, self._pause = 0, STUCK_PAUSE[0]

    def see(self, observation: Observation) -> None:
        """Begin a tick. The mapper has seen the observation already."""
        self._observation = observation

    def begin(self) -> Iterator[Move]:
        """Stand still until there is a first image to map from."""
        self.phase, self.detail = Phase.LOOKING, ""
        while not self._mapper.started:
            yield EpisodeRequest.BEGIN
            if not self._mapper.started:
                self.detail = "no image from the camera yet"
            yield Command()

    def map_view(self) -> Iterator[Move]:
        """Drive back and forth with the view's features visible until their depths have converged."""
        if self._mapper.anchor_features < LEAST_FEATURES:
            self.detail = f"only {self._mapper.anchor_features} features in view: turning on"
            return
        ahead = self.room(0.0)
        behind = self.room(math.pi)
        reach = min(DRIVE, ahead)
        if reach < LEAST_DRIVE:
            reach = -min(DRIVE, behind)
        if abs(reach) < LEAST_DRIVE:
            self.detail = f"no room to drive: {ahead:.2f} m ahead, {behind:.2f} m behind"
            return
        self.phase = Phase.DRIVING
        self._drive.start(reach)
        far_end = False
        for _ in self._ticks(4 * abs(reach) / USUAL_TICK * self.patience + 40):
            since = self._mapper.anchor_from_robot
            command, done, reason = self._drive.command(
                since.x, since.heading, self._mapper.bearings, self._now.proximity
            )
            self.detail = reason
            if not far_end and abs(since.x) > 0.3 and command.forward * reach < 0:
                far_end = True
                yield EpisodeRequest.ADD_VIEW
            if done:
                return
            yield command

    def turn_to_next_view(self, side: float, phase: Phase = Phase.TURNING) -> Generator[Move, None, float]:
        """Turn on the spot until at most four features of the view are left (paper, section 4.1).

        Args:
            side: 1 turns to the left, -1 to the right.
            phase: what it turns for.

        Returns:
            How far it turned, rad, not negative.
        """
        s = self._settings
        self.phase, self.detail = phase, ""
        start = self._mapper.map_from_robot.mean.heading
        for _ in self._ticks(MOST_TURN / s.turn_rate / USUAL_TICK + 40):
            turned = abs(wrap_angle(self._mapper.map_from_robot.mean.heading - start))
            left = self._mapper.anchored
            if turned >= MOST_TURN or (turned >= LEAST_TURN and left <= LEFT):
                break
            self.detail = f"{left} features of the view left"
            yield Command(0.0, side * s.turn_rate)
        # A still image makes a better node than a moving one.
        yield Command()
        yield Command()
        turned = abs(wrap_angle(self._mapper.map_from_robot.mean.heading - start))
        yield EpisodeRequest.FINISH
        if turned >= LEAST_MOTION:
            self._without_motion, self._pause = 0, STUCK_PAUSE[0]
        else:
            self._without_motion += 1
            if self._without_motion >= STUCK_TURNS:
                yield from self._stand_stuck()
        return turned

    def _stand_stuck(self) -> Iterator[Move]:
        """Stand still for a while, or until a person has moved it. Motors that go on to push get hot."""
        self.phase = Phase.STUCK
        self.detail = (
            f"{self._without_motion} turns in a row had no effect: check motor power, emergency stop and "
            f"what blocks the wheels; it tries again within {self._pause:.0f} s, or once it is moved"
        )
        start = self._mapper.map_from_robot.mean
        for _ in self._ticks(self._pause / USUAL_TICK):
            yield Command()
            moved = start.inverse() @ self._mapper.map_from_robot.mean
            if math.hypot(moved.x, moved.y) > LEAST_MOTION or abs(moved.heading) > LEAST_MOTION:
                break
        self._pause = min(2.0 * self._pause, STUCK_PAUSE[1])

    def travel(self, path: list[Array]) -> Generator[Move, None, bool]:
        """Follow the corners of a way: turn toward each, then drive straight to it, adding nodes.

        Args:
            path: (2,) m in map each.

        Returns:
            Whether the end was reached.
        """
        self.phase = Phase.TRAVELLING
        for corner in path:
            yield from self._face(corner)
            if not (yield from self.drive_to(corner)):
                self.detail = "the way is blocked: looking around here"
                yield EpisodeRequest.FINISH
                return False
        yield EpisodeRequest.FINISH
        return True

    def _face(self, corner: Array) -> Iterator[Move]:
        s = self._settings
        for _ in self._ticks(200):
            error = self._bearing_to(corner)
            if abs(error) < 0.05:
                return
            if self._mapper.anchored <= LEFT and abs(self._mapper.anchor_from_robot.heading) > LEAST_TURN:
                yield Command()
                yield Command()
                yield EpisodeRequest.FINISH
            self.detail = f"turning {math.degrees(error):+.0f} deg toward the way"
            yield Command(0.0, clip(2.0 * error, s.turn_rate))

    def drive_to(self, corner: Array) -> Generator[Move, None, bool]:
        """Returns whether the corner was reached."""
        s = self._settings
        if abs(self._mapper.anchor_from_robot.heading) > 0.2 or self._mapper.anchored <= LEFT:
            yield Command()
            yield EpisodeRequest.FINISH
        best, since_best = math.inf, 0.0
        while True:
            distance = float(np.linalg.norm(corner - self.position))
            error = self._bearing_to(corner)
            if distance < 0.08 or (distance < 0.3 and abs(error) > 1.2):
                return True
            if distance < best - 0.02:
                best, since_best = distance, 0.0
            since_best += self._description.tick
            if since_best > PATIENCE or (self.room(0.0) <= 0.0 and since_best > 1.0):
                return False
            anchor_from_start = self._mapper.anchor_from_robot
            way = math.hypot(anchor_from_start.x, anchor_from_start.y)
            if way > TRAVEL_STEP or (way > 0.3 and self._mapper.anchored < 2 * LEFT):
                yield Command()
                yield EpisodeRequest.FINISH
            self.detail = f"{distance:.1f} m to the next corner"
            speed = min(s.travel_speed, max(0.6 * distance, 0.05)) * max(0.0, 1.0 - abs(error) / 0.5)
            yield Command(speed, clip(1.5 * error, s.turn_rate))

    # Small things

    @property
    def _now(self) -> Observation:
        assert self._observation is not None
        return self._observation

    @property
    def position(self) -> Array:
        """Where the robot is, (2,) m in map."""
        pose = self._mapper.map_from_robot.mean
        return np.array([pose.x, pose.y])

    def _bearing_to(self, point: Array) -> float:
        pose: Pose2 = self._mapper.map_from_robot.mean
        return wrap_angle(math.atan2(point[1] - pose.y, point[0] - pose.x) - pose.heading)

    def room(self, direction: float) -> float:
        """How far the footprint may move in a direction (rad, 0 ahead), m, by the rangers."""
        return clearance(self._description, self._now.proximity, direction, DRIVE)

    def _ticks(self, most: float) -> range:
        """A bound on the duration of a behaviour, in usual ticks."""
        return range(int(most * (USUAL_TICK / self._description.tick)))

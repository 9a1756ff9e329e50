"""Exploration: look around at a place, map each view by driving back and forth, travel to the next place."""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from agent.floor import Floor
from agent.mapper import Mapper
from agent.observation import Command, Observation, RobotDescription
from agent.places import next_place, seen_around
from agent.room import room
from agent.servo.image_drive import ImageDrive, ImageDriveSettings
from hybridmap.change import ChangeBody
from hybridmap.pose import Array, Pose2, wrap_angle


@dataclass(frozen=True)
class ExplorerSettings:
    """How the robot explores.

    Attributes:
        drive: how far it drives back and forth to map a view, m.
        drive_speed: m/s on that drive.
        least_drive: with less room than this the view is mapped as well as it can be while turning.
        least_features: a view with fewer features is not worth a drive.
        left: the turn ends when at most this many of the view's features are left (paper: four).
        least_turn: but not before this angle, rad.
        most_turn: nor after this, rad.
        turn_rate: rad/s.
        travel_speed: m/s.
        travel_step: a new node at least this often on the way, m.
        spacing: places are at least this far from each other, m.
        reach: the longest way to a next place, m.
        sight: what can be seen from a place is judged within this radius, m.
        known_reach: nodes within this of a place show it, m.
        known: a place around which nodes look into this share of all directions is not mapped again.
        patience: seconds without getting on before a way is given up.
    """

    drive: float = 0.6
    drive_speed: float = 0.25
    least_drive: float = 0.2
    least_features: int = 10
    left: int = 4
    least_turn: float = 0.45
    most_turn: float = 1.0
    turn_rate: float = 0.6
    travel_speed: float = 0.26
    travel_step: float = 0.8
    spacing: float = 1.7
    reach: float = 7.0
    sight: float = 1.6
    known_reach: float = 0.7
    known: float = 0.75
    patience: float = 4.0


class Phase(StrEnum):
    """What the explorer is doing, in words for the status line."""

    LOOKING = "waiting for a first image"
    DRIVING = "driving back and forth to map the view"
    TURNING = "turning to the next view"
    SCANNING = "turning where the map shows everything already"
    TRAVELLING = "travelling to the next place"
    DONE = "no new place in reach: exploration is complete"


class Explorer:
    """Drives a robot so that its mapper sees the whole reachable floor.

    Written as one generator a behaviour: each `yield` is a command for one tick, so the order of actions
    can be read from top to bottom.

    Attributes:
        phase: what it is doing.
        detail: why, in words.
        places: where it has looked all around, (x, y) m in map.
    """

    def __init__(
        self,
        description: RobotDescription,
        mapper: Mapper,
        floor: Floor,
        settings: ExplorerSettings | None = None,
        seed: int = 0,
    ) -> None:
        """Take the body, and the mapper and floor that the pipeline keeps up to date."""
        self.phase = Phase.LOOKING
        self.detail = ""
        self.places: list[Array] = []
        self._description = description
        self._mapper = mapper
        self._floor = floor
        self._settings = settings or ExplorerSettings()
        self._drive = ImageDrive(description, ImageDriveSettings(speed=self._settings.drive_speed))
        self._side = 1.0 if np.random.default_rng(seed).random() < 0.5 else -1.0
        self._changes: list[ChangeBody] = []
        self._avoid: list[Array] = []
        self._observation: Observation | None = None
        self._behaviour = self._explore()

    def step(self, observation: Observation) -> tuple[Command, list[ChangeBody]]:
        """One tick. The mapper and the floor have seen the observation already."""
        self._observation = observation
        self._changes = []
        command = next(self._behaviour)
        return command, self._changes

    @property
    def finished(self) -> bool:
        """Whether there is nothing left to explore."""
        return self.phase is Phase.DONE

    def restart(self) -> None:
        """Begin again from where the robot is now: it was lost, and knows its posture again."""
        self.phase, self.detail = Phase.LOOKING, ""
        self._behaviour = self._explore()

    # Behaviours

    def _explore(self) -> Iterator[Command]:
        s = self._settings
        while not self._mapper.started:
            self._mapper.begin(self._now)
            if not self._mapper.started:
                self.detail = "no image from the camera yet"
            yield Command()
        while True:
            if seen_around(self._mapper.map, self._position, s.known_reach) >= s.known:
                yield from self._scan()
            else:
                yield from self._look_around()
            self.places.append(self._position)
            been = np.array(self.places + self._avoid)
            path = next_place(self._floor, self._position, been, s.reach, s.sight, s.spacing)
            if not path:
                break
            yield from self._travel(path)
        self.phase = Phase.DONE
        while True:
            yield Command()

    def _look_around(self) -> Iterator[Command]:
        """Map view after view, turning on the spot between them, all the way around."""
        turned = 0.0
        while True:
            yield from self._map_view()
            before = self._mapper.map_from_robot.mean.heading
            yield from self._turn_to_next_view()
            turned += abs(wrap_angle(self._mapper.map_from_robot.mean.heading - before))
            self._finish()
            if turned > 2 * math.pi - 0.3:
                yield from self._map_view()
                return

    def _scan(self) -> Iterator[Command]:
        """Turn until the rangers have swept all around: the floor may be forgotten, the views are mapped."""
        bearings = np.sort(np.array(self._description.ranger_bearings))
        gaps = np.diff(bearings, append=bearings[:1] + math.tau)
        turned = 0.0
        while turned < (gaps.max() if len(gaps) else math.tau):
            before = self._mapper.map_from_robot.mean.heading
            yield from self._turn_to_next_view()
            self.phase = Phase.SCANNING
            turned += abs(wrap_angle(self._mapper.map_from_robot.mean.heading - before)) + 0.05
            self._finish()

    def _map_view(self) -> Iterator[Command]:
        """Drive back and forth with the view's features in sight until their depths have converged."""
        s = self._settings
        if self._mapper.anchor_features < s.least_features:
            self.detail = f"only {self._mapper.anchor_features} features in view: turning on"
            return
        ahead = self._room(0.0)
        behind = self._room(math.pi)
        reach = min(s.drive, ahead)
        if reach < s.least_drive:
            reach = -min(s.drive, behind)
        if abs(reach) < s.least_drive:
            self.detail = f"no room to drive: {ahead:.2f} m ahead, {behind:.2f} m behind"
            return
        self.phase = Phase.DRIVING
        self._drive.start(reach)
        far_end = False
        for _ in self._ticks(4 * abs(reach) / 0.1 + 40):
            since = self._mapper.anchor_from_robot
            command, done, reason = self._drive.command(
                since.x, since.heading, self._mapper.bearings, self._now.proximity
            )
            self.detail = reason
            if not far_end and abs(since.x) > 0.3 and command.forward * reach < 0:
                far_end = True
                self._mapper.leaf(self._now)
            if done:
                return
            yield command

    def _turn_to_next_view(self) -> Iterator[Command]:
        """Turn on the spot until at most four features of the view are left (paper, section 4.1)."""
        s = self._settings
        self.phase, self.detail = Phase.TURNING, ""
        start = self._mapper.map_from_robot.mean.heading
        for _ in self._ticks(s.most_turn / s.turn_rate / self._description.tick + 40):
            turned = abs(wrap_angle(self._mapper.map_from_robot.mean.heading - start))
            left = self._mapper.anchored
            if turned >= s.most_turn or (turned >= s.least_turn and left <= s.left):
                break
            self.detail = f"{left} features of the view left"
            yield Command(0.0, self._side * s.turn_rate)
        # A still image makes a better node than a moving one.
        yield Command()
        yield Command()

    def _travel(self, path: list[Array]) -> Iterator[Command]:
        """Follow the corners of a way: turn toward each, then drive straight to it, adding nodes."""
        self.phase = Phase.TRAVELLING
        for corner in path:
            yield from self._face(corner)
            if not (yield from self._drive_to(corner)):
                self._avoid.append(path[-1])
                self.detail = "the way is blocked: looking around here"
                break
        self._finish()

    def _face(self, corner: Array) -> Iterator[Command]:
        s = self._settings
        for _ in self._ticks(200):
            error = self._bearing_to(corner)
            if abs(error) < 0.05:
                return
            if self._mapper.anchored <= s.left and abs(self._mapper.anchor_from_robot.heading) > s.least_turn:
                yield Command()
                yield Command()
                self._finish()
            self.detail = f"turning {math.degrees(error):+.0f} deg toward the way"
            yield Command(0.0, float(np.clip(2.0 * error, -s.turn_rate, s.turn_rate)))

    def _drive_to(self, corner: Array) -> Generator[Command, None, bool]:
        """Returns whether the corner was reached."""
        s = self._settings
        if abs(self._mapper.anchor_from_robot.heading) > 0.2 or self._mapper.anchored <= s.left:
            yield Command()
            self._finish()
        best, since_best = math.inf, 0.0
        while True:
            distance = float(np.linalg.norm(corner - self._position))
            error = self._bearing_to(corner)
            if distance < 0.08 or (distance < 0.3 and abs(error) > 1.2):
                return True
            if distance < best - 0.02:
                best, since_best = distance, 0.0
            since_best += self._description.tick
            if since_best > s.patience or (self._room(0.0) <= 0.0 and since_best > 1.0):
                return False
            gone = self._mapper.anchor_from_robot
            way = math.hypot(gone.x, gone.y)
            if way > s.travel_step or (way > 0.3 and self._mapper.anchored < 2 * s.left):
                yield Command()
                self._finish()
            self.detail = f"{distance:.1f} m to the next corner"
            speed = min(s.travel_speed, max(0.6 * distance, 0.05)) * max(0.0, 1.0 - abs(error) / 0.5)
            yield Command(speed, float(np.clip(1.5 * error, -s.turn_rate, s.turn_rate)))

    # Small things

    @property
    def _now(self) -> Observation:
        assert self._observation is not None
        return self._observation

    @property
    def _position(self) -> Array:
        pose = self._mapper.map_from_robot.mean
        return np.array([pose.x, pose.y])

    def _bearing_to(self, point: Array) -> float:
        pose: Pose2 = self._mapper.map_from_robot.mean
        return wrap_angle(math.atan2(point[1] - pose.y, point[0] - pose.x) - pose.heading)

    def _room(self, direction: float) -> float:
        """How far the footprint may move in a direction (rad, 0 ahead), m, by the rangers."""
        return room(self._description, self._now.proximity, direction, self._settings.drive)

    def _ticks(self, most: float) -> range:
        """A bound on the length of a behaviour: nothing may last forever."""
        return range(int(most))

    def _finish(self) -> None:
        self._changes += self._mapper.finish(self._now)

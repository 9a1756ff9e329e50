"""Taking up a map again: look around, and away from here, until the own map is recognised.

A false edge folds the map for good, so a recognition counts once another one agrees with it, see
`agent/agreement.py`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Generator
from dataclasses import dataclass, field

import numpy as np

from agent.agreement import AgreementSettings, Sighting, agree
from agent.observation import Command, Observation, RobotDescription
from agent.recall import exact_enough, recall_all
from agent.room import room
from agent.vision.sift import Features, Sift
from hybridmap.hybrid_map import HybridMap
from hybridmap.node import Node
from hybridmap.pose import Array, Pose2, wrap_angle
from hybridmap.recognition import Recognition

REMEMBERED = 600
"""Readings of the rangers that are kept for the floor, the latest."""


@dataclass(frozen=True)
class ResumptionSettings:
    """How hard a robot tries to find itself on its own map.

    Attributes:
        look_turn: between two looks, rad.
        turn_rate: of that turn, rad/s.
        still: seconds that it stands still before a look.
        turns: whole turns at the first place, and at each further one; one where anything is recognised.
        places: how many places it looks around at.
        move: the most that it drives to the next place, m: toward a node that it has recognised though not
            well enough, else to where there is room.
        least_move: with less room than this it stays, m.
        speed: m/s.
        least_features: a view with fewer cannot be recognised.
        least_views: if fewer looks had a view than this share, it has not looked around: the lens is covered.
        sure: standard deviations up to which it goes on from a recognition, m and rad. A robot that only
            wants to drive asks for less the longer it has looked.
        vague: one that is this many times less exact may still agree with an exact one.
        rival: another node with this share of the best one's inliers has a say too;
        apart: if it puts the robot further away than this, m, two places look the same, and neither counts.
        agreement: when two looks agree.
        carried_pause: seconds between two looks of a robot that somebody else moves.
        carried_looks: how often such a robot looks in vain before it counts as lost.
    """

    look_turn: float = 0.5
    turn_rate: float = 0.6
    still: float = 0.2
    turns: tuple[int, int] = (2, 1)
    places: int = 4
    move: float = 1.0
    least_move: float = 0.2
    speed: float = 0.2
    least_features: int = 8
    least_views: float = 0.25
    sure: tuple[float, float] = (0.03, 0.018)
    vague: float = 3.0
    rival: float = 0.5
    apart: float = 0.5
    agreement: AgreementSettings = field(default_factory=AgreementSettings)
    carried_pause: float = 0.5
    carried_looks: int = 120


@dataclass(frozen=True, eq=False)
class Found:
    """A place of the own map was recognised.

    Attributes:
        node: the place.
        features: of the image.
        recognition: of the node in the features.
    """

    node: Node
    features: Features
    recognition: Recognition


class Resumption:
    """Finds a robot on its own map: one that was started anew, has navigated, or was carried off.

    Attributes:
        found: the place that was recognised in the last observation, after another one that agrees; None
            until then.
        lost: whether it has tried everything in vain.
        detail: what it does and why, in words.
        seen: `odom_from_robot` and readings of the rangers, (K,) m, while it looked around; the wheels' own
            frame begins where it began.
    """

    def __init__(
        self,
        description: RobotDescription,
        sift: Sift,
        own_map: HybridMap,
        drives: bool,
        settings: ResumptionSettings | None = None,
        seed: int = 0,
    ) -> None:
        """Start to look.

        Args:
            description: the body.
            sift: features of an image.
            own_map: with at least one node.
            drives: whether it may turn and drive by itself.
            settings: how hard it tries.
            seed: of the recognition's random samples.
        """
        self.found: Found | None = None
        self.lost = False
        self.detail = ""
        self.seen: deque[tuple[Pose2, Array]] = deque(maxlen=REMEMBERED)
        self._description = description
        self._sift = sift
        self._map = own_map
        self._settings = settings or ResumptionSettings()
        self._rng = np.random.default_rng(seed)
        self._observation: Observation | None = None
        self._odom_from_robot = Pose2()
        self._way = self._turned = 0.0
        self._sightings: list[Sighting] = []
        self._hint: tuple[int, Pose2] | None = None
        self._look_again: Pose2 | None = None
        self._looks = self._views = 0
        self._behaviour = self._search() if drives else self._wait_to_be_carried()

    @property
    def odom_from_robot(self) -> Pose2:
        """Where the wheels have brought the robot since it began to look."""
        return self._odom_from_robot

    def step(self, observation: Observation) -> Command:
        """One tick: returns what the wheels shall do. Once `found` is set there is nothing more to do."""
        self._observation = observation
        odometry = observation.odometry
        self._odom_from_robot = self._odom_from_robot @ odometry.motion()
        self._way, self._turned = self._way + abs(odometry.forward), self._turned + abs(odometry.turn)
        self.seen.append((self._odom_from_robot, observation.proximity))
        return next(self._behaviour)

    # Behaviours: each yields a command a tick, so the order of actions reads from top to bottom.

    def _search(self) -> Generator[Command, None, None]:
        s = self._settings
        place = 1
        while self.found is None and not self.lost:
            self._looks, self._views, self._hint = 0, 0, None
            yield from self._look_around(s.turns[0] if place == 1 else s.turns[1])
            if self.found is not None:
                break
            if self._views < s.least_views * self._looks:
                # With a covered lens, or in the dark, there is nothing to be learnt from going elsewhere.
                continue
            self.lost = place >= s.places or not (yield from self._move())
            place += 1
        if self.lost:
            self.detail = self._verdict(f"at {place - 1} place{'s' if place > 2 else ''}")
        while True:
            yield Command()

    def _look_around(self, turns: int) -> Generator[Command, None, None]:
        start = self._turned
        for _ in range(math.ceil(turns * math.tau / self._settings.look_turn)):
            yield from self._wait(self._settings.still)
            whole = (self._turned - start) / math.tau
            if self._look() or whole >= (turns if self._hint is None else 1):
                return
            again, self._look_again = self._look_again, None
            if again is None:
                yield from self._turn(self._settings.look_turn)
            else:
                yield from self._turn(wrap_angle(again.heading - self._odom_from_robot.heading))

    def _wait_to_be_carried(self) -> Generator[Command, None, None]:
        while not self._look():
            if self._views >= self._settings.carried_looks:
                self.lost, self.detail = True, self._verdict(f"in {self._views} images")
                break
            self.detail = f"waiting to recognise a place of its own map: {self.detail}"
            yield from self._wait(self._settings.carried_pause)
        while True:
            yield Command()

    def _move(self) -> Generator[Command, None, bool]:
        """Drive a little to look from elsewhere; returns whether there was room."""
        s = self._settings
        ways = [
            (min(room(self._description, self._now.proximity, bearing, 0.0), s.move), bearing)
            for bearing in self._description.ranger_bearings
        ]
        way, direction = max(ways, key=lambda one: one[0], default=(0.0, 0.0))
        if self._hint is not None:
            _, odom_from_node = self._hint
            node = self._odom_from_robot.inverse() @ odom_from_node
            toward = math.atan2(node.y, node.x)
            near = min(room(self._description, self._now.proximity, toward, 0.0), math.hypot(node.x, node.y))
            if near >= s.least_move:
                way, direction = min(near, s.move), toward
        if way < s.least_move:
            return False
        self.detail = "moving on to look from elsewhere"
        yield from self._turn(math.remainder(direction, math.tau))
        start = self._odom_from_robot
        for _ in range(math.ceil(2.0 * way / s.speed / self._description.tick)):
            left = way - start.distance(self._odom_from_robot)
            if left < 0.02 or room(self._description, self._now.proximity, 0.0, 0.0) < 0.02:
                break
            yield Command(s.speed, 0.0)
        return True

    # Small things

    def _look(self) -> bool:
        """Try to recognise the current image; sets `found`."""
        s, image = self._settings, self._now.image
        self._looks += 1
        if image is None:
            self.detail = "no image from the camera"
            return False
        features = self._sift.extract(image)
        if len(features) < s.least_features:
            self.detail = f"only {len(features)} features in view"
            return False
        self._views += 1
        recalled = recall_all(self._map, features.view(self._description.camera), self._rng)
        if not recalled:
            self.detail = f"none of {len(self._map.nodes)} nodes is recognised"
            return False
        node, recognition = recalled[0]
        if self._hint is None or recognition.inliers > self._hint[0]:
            odom_from_node = self._odom_from_robot @ recognition.node_from_robot.mean.inverse()
            self._hint = recognition.inliers, odom_from_node
        here = node.map_from_robot.mean @ recognition.node_from_robot.mean
        for other, also in recalled[1:]:
            there = other.map_from_robot.mean @ also.node_from_robot.mean
            if also.inliers >= s.rival * recognition.inliers and here.distance(there) > s.apart:
                self.detail = f"nodes {node.id} and {other.id} look the same"
                return False
        exact = exact_enough(recognition.node_from_robot, s.sure)
        if not exact_enough(recognition.node_from_robot, s.sure, s.vague):
            self.detail = f"node {node.id} is in view, but too far off"
            return False
        self.detail = f"node {node.id}: {recognition.inliers} landmarks agree; another view must, too"
        sighting = Sighting(here, self._odom_from_robot, self._way, self._turned, exact)
        agreeing = [earlier for earlier in self._sightings if agree(earlier, sighting, s.agreement)]
        self._sightings.append(sighting)
        if exact and agreeing:
            self.found = Found(node, features, recognition)
        elif not exact:
            self._look_again = next((one.odom_from_robot for one in agreeing if one.exact), None)
        return self.found is not None

    def _verdict(self, where: str) -> str:
        """Why it is lost, in words."""
        what = "no two views agreed" if self._sightings else "nothing was recognised"
        return f"cannot find itself on its own map of {len(self._map.nodes)} nodes: {what} {where}"

    def _wait(self, seconds: float) -> Generator[Command, None, None]:
        for _ in range(max(1, round(seconds / self._description.tick))):
            yield Command()

    def _turn(self, angle: float) -> Generator[Command, None, None]:
        """Turn by the wheels; a robot that cannot turn gives up after three times the time it takes."""
        turned, rate = 0.0, math.copysign(self._settings.turn_rate, angle)
        for _ in range(math.ceil(3.0 * abs(angle / rate) / self._description.tick) + 1):
            if abs(turned) >= abs(angle):
                break
            yield Command(0.0, rate)
            turned += self._now.odometry.turn

    @property
    def _now(self) -> Observation:
        assert self._observation is not None
        return self._observation

"""Taking up a map again: look around, and away from here, until the own map is recognised.

A false edge folds the map for good, so a recognition counts once another one agrees with it, see
`agent/resuming/agreement.py`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Generator
from dataclasses import dataclass, field

import numpy as np

from agent.localizing.recall import exact_enough, lookalikes, recall_all
from agent.navigating.helm import Behaviour, Helm
from agent.observation import Command, Observation, RobotDescription
from agent.resuming.agreement import AgreementSettings, Sighting, agree
from agent.vision.sift import Features, Sift
from hybridmap.hybrid_map import HybridMap
from hybridmap.node import Node
from hybridmap.pose import Array, Pose2, wrap_angle
from hybridmap.recognising.recognition import Recognition

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
        self._helm = Helm(description)
        self._way = self._turned = 0.0
        self._sightings: list[Sighting] = []
        self._hint: tuple[int, Pose2] | None = None
        self._look_again: Pose2 | None = None
        self._looks = self._views = 0
        self._behaviour = self._search() if drives else self._wait_to_be_carried()

    @property
    def odom_from_robot(self) -> Pose2:
        """Where the wheels have brought the robot since it began to look."""
        return self._helm.odom_from_robot

    def step(self, observation: Observation, standing: bool = False) -> Command:
        """One tick: returns what the wheels shall do. Once `found` is set there is nothing more to do.

        Args:
            observation: what the robot senses now.
            standing: the robot must not move; the behaviour waits.
        """
        self._helm.take_in(observation, ())
        odometry = observation.odometry
        self._way, self._turned = self._way + abs(odometry.forward), self._turned + abs(odometry.turn)
        self.seen.append((self.odom_from_robot, observation.proximity))
        return Command() if standing else next(self._behaviour)

    # Behaviours: each yields a command a tick, so the order of actions reads from top to bottom.

    def _search(self) -> Behaviour:
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

    def _look_around(self, turns: int) -> Behaviour:
        s, start = self._settings, self._turned
        for _ in range(math.ceil(turns * math.tau / s.look_turn)):
            yield from self._helm.stand(s.still)
            whole = (self._turned - start) / math.tau
            if self._look() or whole >= (turns if self._hint is None else 1):
                return
            again, self._look_again = self._look_again, None
            turn = s.look_turn
            if again is not None:
                turn = wrap_angle(again.heading - self.odom_from_robot.heading)
            yield from self._helm.turn(turn, s.turn_rate)

    def _wait_to_be_carried(self) -> Behaviour:
        while not self._look():
            if self._views >= self._settings.carried_looks:
                self.lost, self.detail = True, self._verdict(f"in {self._views} images")
                break
            self.detail = f"waiting to recognise a place of its own map: {self.detail}"
            yield from self._helm.stand(self._settings.carried_pause)
        while True:
            yield Command()

    def _move(self) -> Generator[Command, None, bool]:
        """Drive a little to look from elsewhere; returns whether there was room."""
        s = self._settings
        way, direction = self._helm.freest(s.move)
        if self._hint is not None:
            _, odom_from_node = self._hint
            node = self.odom_from_robot.inverse() @ odom_from_node
            toward = math.atan2(node.y, node.x)
            near = min(self._helm.room(toward), math.hypot(node.x, node.y))
            if near >= s.least_move:
                way, direction = min(near, s.move), toward
        if way < s.least_move:
            return False
        self.detail = "moving on to look from elsewhere"
        yield from self._helm.turn(math.remainder(direction, math.tau), s.turn_rate)
        yield from self._helm.drive_on(way, s.speed)
        return True

    # Small things

    def _look(self) -> bool:
        """Try to recognise the current image; sets `found`."""
        s, image = self._settings, self._helm.observation.image
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
            odom_from_node = self.odom_from_robot @ recognition.node_from_robot.mean.inverse()
            self._hint = recognition.inliers, odom_from_node
        alike = lookalikes(recalled, s.rival, s.apart)
        if alike is not None:
            self.detail = f"nodes {alike[0].id} and {alike[1].id} look the same"
            return False
        exact = exact_enough(recognition.node_from_robot, s.sure)
        if not exact_enough(recognition.node_from_robot, s.sure, s.vague):
            self.detail = f"node {node.id} is in view, but too far off"
            return False
        self.detail = f"node {node.id}: {recognition.inliers} landmarks agree; another view must, too"
        here = node.map_from_robot.mean @ recognition.node_from_robot.mean
        sighting = Sighting(here, self.odom_from_robot, self._way, self._turned, exact)
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

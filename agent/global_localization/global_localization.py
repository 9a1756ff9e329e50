"""Global localization: a lost robot takes views, turns, drives on and asks until it is localized.

The sources of candidates are passed in: the robot's own map, and the fleet's if it has a fleet. A robot with
a goal and a robot that is to map on use the same search: the first needs one recognition, the second two that
agree; see `SearchPolicy`.
"""

import math
from collections.abc import Generator
from dataclasses import dataclass

from mapweave.agent.global_localization.candidates import (
    APART,
    Candidate,
    FleetMapSource,
    OwnMapSource,
    RankedPlaces,
)
from mapweave.agent.global_localization.pose_consistency import PoseHypothesis, consistent
from mapweave.agent.localization.place_recognition import exact_enough
from mapweave.agent.motion_primitives import MotionPrimitives
from mapweave.agent.observation import Command, RobotDescription
from mapweave.hybridmap.pose import Pose2, wrap_angle
from mapweave.vision.sift import Sift


@dataclass(frozen=True)
class SearchPolicy:
    """What a robot does before it gives up, and what it takes for a recognition.

    Attributes:
        sure: largest standard deviations of an accepted recognition, m and rad.
        leniency: after each full turn without success this many times `sure` more.
        views_needed: recognitions that must agree, 1 or 2; 2 counts the own map's alone.
        turns: whole turns at the first place, and at each further one; one where anything is recognised.
        places: how many places it searches from; 0 for no limit.
        carried_pause: time between two views of a robot that a person moves, s.
        carried_views: views without success after which such a robot counts as lost.
    """

    sure: tuple[float, float]
    leniency: float
    views_needed: int
    turns: tuple[int, int]
    places: int
    carried_pause: float = 0.5
    carried_views: int = 120


TO_NAVIGATE = SearchPolicy(sure=(0.06, 0.03), leniency=1.0, views_needed=1, turns=(1, 1), places=0)
"""A robot that has to get somewhere never gives up, and one recognition will do."""

BEYOND_PORTAL = SearchPolicy(sure=(0.06, 0.03), leniency=1.0, views_needed=1, turns=(1, 1), places=1)
"""A robot that was taken through a portal stands where a person has put it: it turns once, then it asks."""

TO_MAP = SearchPolicy(sure=(0.03, 0.018), leniency=0.0, views_needed=2, turns=(2, 1), places=4)
"""A robot that is to map on: a false edge bends the map for good, a fresh map is no harm."""


CARRIED_MOVING_VIEWS = 12
"""A carried robot is lost after so many views without success between which it moves: six seconds of driving.
A new map can be joined to the old one later, a stretch that is not mapped cannot."""
MOVED = 0.02
"""m or rad between two views."""
STILL = 0.2
"""Seconds that the robot stands still before a view."""
TURN_STEP = 0.5
"""Between two views, rad."""
TURN_RATE = 0.6
"""rad/s."""
MOVE = 1.0
"""After full turns without success it searches from elsewhere: this far away, m, if there is room,"""
LEAST_MOVE = 0.2
"""and at least this far, m."""
SPEED = 0.2
"""Of that drive, m/s."""

LEAST_FEATURES = 8
"""A view with fewer cannot be recognised."""
LEAST_VIEWS = 0.25
"""If fewer images than this share had features, the turn does not count: the lens is covered."""

LENIENT = 2.0
"""A robot that has only just lost all landmarks accepts recognitions that are so much less exact."""
VAGUE = 3.0
"""A recognition so many times less exact than `sure` may still confirm an exact one."""

FAMILIAR = 3
"""So many headings of nodes nearby are tried before a turn all around,"""
NEARBY = 0.8
"""of nodes within this, m,"""
RICH = 40
"""with so many landmarks."""

Search = Generator[Command, None, Candidate | None]


class GlobalLocalization:
    """Localizes a lost robot. Of two places that look the same it takes neither.

    Attributes:
        detail: what it does and why, in words.
    """

    def __init__(
        self,
        description: RobotDescription,
        sift: Sift,
        motion: MotionPrimitives,
        own_map: OwnMapSource,
        policy: SearchPolicy,
        fleet: FleetMapSource | None = None,
    ) -> None:
        """Take the means.

        Args:
            description: of the robot.
            sift: finds features.
            motion: moves the robot.
            own_map: what the robot knows itself.
            policy: how hard it tries, and what it believes.
            fleet: what others know; None for a robot that counts on its own map alone.
        """
        self.detail = ""
        self._description = description
        self._sift = sift
        self._motion = motion
        self._own = own_map
        self._fleet = fleet
        self._policy = policy
        self._hypotheses: list[PoseHypothesis] = []
        self._hint: tuple[int, Pose2] | None = None
        self._confirm_at: Pose2 | None = None
        self._ambiguous = ""
        self._attempts = self._views = 0

    def search(self, expected: Pose2 | None = None) -> Search:
        """Search here, then elsewhere; None if all places of the policy were searched without success.

        Args:
            expected: `map_from_robot` in the own map by the wheels, if the robot has only just lost all
                landmarks: then it first turns to the headings of nearby nodes.
        """
        policy, motion = self._policy, self._motion
        self.detail, self._ambiguous = "looking", ""
        for heading in self._familiar_headings(expected):
            yield from motion.turn(wrap_angle(heading - motion.odom_from_robot.heading), TURN_RATE)
            yield from motion.stand(STILL)
            candidate = yield from self.look(LENIENT)
            if candidate is not None:
                return candidate
        place, begin = 1, motion.turned
        while True:
            self._attempts, self._views, self._hint = 0, 0, None
            candidate = yield from self._look_around(
                policy.turns[0] if place == 1 else policy.turns[1], begin
            )
            if candidate is not None:
                return candidate
            self._forget_floor()
            if self._views < LEAST_VIEWS * self._attempts:
                # With a covered lens, or in the dark, driving elsewhere does not help.
                continue
            last = place == policy.places
            moved = False if last else (yield from self._move())
            if last or not (moved or policy.places == 0):
                break
            place += 1
        self._give_up(f"at {place} place{'s' if place > 1 else ''}")
        return None

    def wait(self) -> Search:
        """Take views while a person moves the robot; None after `carried_views` views without success.

        A drive goes on meanwhile: a few views between which the robot has moved are enough.
        """
        moving = 0
        while self._views < self._policy.carried_views and moving < CARRIED_MOVING_VIEWS:
            views, driven = self._views, self._motion.way + self._motion.turned
            candidate = yield from self.look()
            if candidate is not None:
                return candidate
            self.detail = f"waiting to recognise a place of its own map: {self.detail}"
            yield from self._motion.stand(self._policy.carried_pause)
            moving += self._views > views and self._motion.way + self._motion.turned - driven > MOVED
        self._give_up(f"in {self._views} images")
        return None

    def look(self, leniency: float = 1.0) -> Search:
        """Recognise the current view; None if it is unknown or uncertain.

        Args:
            leniency: by how much a recognition may be less exact than `sure`.
        """
        self._attempts += 1
        image = self._motion.observation.image
        if image is None:
            self.detail = "no image from the camera"
            return None
        features = self._sift.extract(image)
        if len(features) < LEAST_FEATURES:
            self.detail = f"only {len(features)} features in view"
            return None
        self._views += 1
        view = features.view(self._description.camera)
        own = self._own.candidates(view, image, features)
        self._take_hint(own)
        self._ambiguous = own.ambiguous or self._ambiguous
        if self._policy.views_needed > 1:
            return self._second_of_two(own)
        fleet = None if self._fleet is None else (yield from self._fleet.candidates(view))
        return self._single(own, fleet, leniency)

    # Verdicts

    def _single(self, own: RankedPlaces, fleet: RankedPlaces | None, leniency: float) -> Candidate | None:
        """The place that one view shows, by the own map and by the fleet's, which must not contradict it."""
        sure = self._policy.sure
        self.detail = own.reason if fleet is None else fleet.reason
        if fleet is not None and fleet.ambiguous:
            self._ambiguous = fleet.ambiguous
            self.detail = f"ambiguous: {fleet.ambiguous}"
            return None
        fleet_best = None if fleet is None else next(iter(fleet.places), None)
        own_best = None if own.ambiguous else next(iter(own.places), None)
        if own_best is not None and not exact_enough(own_best.node_from_robot, sure, leniency):
            own_best = None
        if own_best is not None and not (fleet_best and self._elsewhere(fleet_best, own_best)):
            self.detail = f"own map: {own.reason}"
            # The robot stood still while it waited for the answer.
            return own_best
        # The unknown distance of a photograph is measured on the way to it, not by another view.
        vague = fleet_best is not None and not exact_enough(fleet_best.node_from_robot, sure, leniency)
        if fleet_best is not None and fleet_best.distance_known and vague:
            self.detail += ", but not exactly enough"
            return None
        return fleet_best

    def _second_of_two(self, own: RankedPlaces) -> Candidate | None:
        """The place that a view shows if an earlier view of other things agrees with it."""
        if own.ambiguous or not own.places:
            self.detail = own.ambiguous or own.reason
            return None
        best = own.places[0]
        exact = exact_enough(best.node_from_robot, self._policy.sure)
        if not exact_enough(best.node_from_robot, self._policy.sure, VAGUE):
            self.detail = f"node {best.node} is in view, but too far off"
            return None
        self.detail = f"{own.reason}; another view must, too"
        motion = self._motion
        map_from_robot = self._own.map.nodes[best.node].map_from_robot.mean @ best.node_from_robot.mean
        hypothesis = PoseHypothesis(map_from_robot, motion.odom_from_robot, motion.way, motion.turned, exact)
        agreeing = [earlier for earlier in self._hypotheses if consistent(earlier, hypothesis)]
        self._hypotheses.append(hypothesis)
        if exact and agreeing:
            return best
        if not exact:
            self._confirm_at = next((h.odom_from_robot for h in agreeing if h.exact), None)
        return None

    def _elsewhere(self, fleet: Candidate, own: Candidate) -> bool:
        """Whether the fleet puts the robot elsewhere. Its map may be older than the own map."""
        nodes = self._own.map.nodes
        if fleet.node not in nodes:
            return True
        by_fleet, by_own_map = (
            nodes[c.node].map_from_robot.mean @ c.node_from_robot.mean for c in (fleet, own)
        )
        return by_own_map.distance(by_fleet) > APART

    def _give_up(self, where: str) -> None:
        why = "no two views agreed" if self._hypotheses else "nothing was recognised"
        self.detail = f"cannot localize on its own map of {len(self._own.map.nodes)} nodes: {why} {where}"

    # Moves

    def _look_around(self, turns: int, begin: float) -> Search:
        """Take views through full turns; the search began when the robot had turned by `begin`, rad."""
        motion, start = self._motion, self._motion.turned
        for _ in range(math.ceil(turns * math.tau / TURN_STEP)):
            yield from motion.stand(STILL)
            turns_so_far = (motion.turned - begin) / math.tau
            candidate = yield from self.look(1.0 + self._policy.leniency * turns_so_far)
            if candidate is not None:
                return candidate
            if motion.turned - start >= (turns if self._hint is None else 1) * math.tau:
                break
            confirm_at, self._confirm_at = self._confirm_at, None
            turn = TURN_STEP
            if confirm_at is not None:
                turn = wrap_angle(confirm_at.heading - motion.odom_from_robot.heading)
            yield from motion.turn(turn, TURN_RATE)
        return None

    def _move(self) -> Generator[Command, None, bool]:
        """Drive a little to search from elsewhere; returns whether there was room.

        What distinguishes two places is visible from somewhere: a door in another position, a picture
        around the corner. A node that was recognised, though not well enough, is better seen from nearby.
        """
        motion = self._motion
        why = "nothing here is known" if self._hint is None else "nothing here is known well enough"
        why = f"ambiguous, {self._ambiguous}" if self._ambiguous else why
        way = 0.0
        if self._hint is not None:
            node = motion.odom_from_robot.inverse() @ self._hint[1]
            if (distance := math.hypot(node.x, node.y)) >= LEAST_MOVE:
                # Rangers may not point there yet.
                self.detail = f"{why}: turning to what is known"
                yield from motion.turn(math.atan2(node.y, node.x), TURN_RATE)
                way = min(motion.room(0.0), distance, MOVE)
        if way < LEAST_MOVE:
            way, direction = motion.freest(MOVE)
            if way < LEAST_MOVE:
                self.detail = "no room to search from elsewhere"
                return False
            yield from motion.turn(math.remainder(direction, math.tau), TURN_RATE)
        self.detail, self._ambiguous = f"{why}: driving on to search from elsewhere", ""
        yield from motion.drive_on(way, SPEED)
        return True

    def _forget_floor(self) -> None:
        """All around nothing is known of the floor where the robot should be: it may be on any."""
        self._own.elsewhere = False
        if self._fleet is not None:
            self._fleet.near = None

    def _take_hint(self, own: RankedPlaces) -> None:
        """Remember the node with most inliers from here, even if its pose is uncertain."""
        best = own.places[0].recognized if own.places else None
        if best is not None and (self._hint is None or best.recognition.inliers > self._hint[0]):
            robot_from_node = best.recognition.node_from_robot.mean.inverse()
            self._hint = best.recognition.inliers, self._motion.odom_from_robot @ robot_from_node

    def _familiar_headings(self, expected: Pose2 | None) -> list[float]:
        """Headings in the wheels' frame, rad, of own nodes nearby; the nearest first."""
        if expected is None:
            return []
        heading = self._motion.odom_from_robot.heading
        poses = [n.map_from_robot.mean for n in self._own.map.nodes.values() if len(n.landmarks) >= RICH]
        turns = [
            wrap_angle(pose.heading - expected.heading) for pose in poses if expected.distance(pose) <= NEARBY
        ]
        chosen: list[float] = []
        # The view straight ahead was just tried.
        for turn in sorted(turns, key=abs):
            if all(abs(wrap_angle(turn - earlier)) >= TURN_STEP for earlier in (0.0, *chosen)):
                chosen.append(turn)
        return [wrap_angle(heading + turn) for turn in chosen[:FAMILIAR]]

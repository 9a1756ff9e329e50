"""Global localization: a lost robot looks, turns, drives on and asks until it knows where it is.

What it looks for is passed in: places of its own map, and of the fleet's if it has a fleet. It is the same
search for a robot that has to get somewhere (one recognition will do) and for one that is to map on (two
must agree); see `SearchPolicy`.
"""

from __future__ import annotations

import math
from collections.abc import Generator

from mapweave.agent.global_localization.candidates import APART, Candidate, Candidates, FleetMap, OwnMap
from mapweave.agent.global_localization.pose_consistency import PoseHypothesis, consistent
from mapweave.agent.global_localization.search_policy import SearchPolicy
from mapweave.agent.localization.place_recognition import exact_enough
from mapweave.agent.motion_primitives import MotionPrimitives
from mapweave.agent.observation import Command, RobotDescription
from mapweave.hybridmap.pose import Pose2, wrap_angle
from mapweave.vision.sift import Sift

STILL = 0.2
"""Seconds that the robot stands still before a look."""
LOOK_TURN = 0.5
"""Between two looks, rad."""
TURN_RATE = 0.6
"""rad/s."""
MOVE = 1.0
"""After looks all around in vain it looks from elsewhere: this far away, m, if there is room,"""
LEAST_MOVE = 0.2
"""and at least this far, m."""
SPEED = 0.2
"""Of that drive, m/s."""

LEAST_FEATURES = 8
"""A view with fewer cannot be recognised."""
LEAST_VIEWS = 0.25
"""If fewer looks had a view than this share, the robot has not looked around: the lens is covered."""

LENIENT = 2.0
"""A robot that has only just lost sight of everything believes recognitions that are so much less exact."""
VAGUE = 3.0
"""A recognition so many times less exact than one to go on from may still agree with such a one."""

FAMILIAR = 3
"""So many headings of nodes nearby are tried before a turn all around,"""
NEARBY = 0.8
"""of nodes within this, m,"""
RICH = 40
"""with so many landmarks."""

Search = Generator[Command, None, Candidate | None]


class GlobalLocalization:
    """Finds out where the robot is. Of two places that look the same it takes neither.

    Attributes:
        detail: what it does and sees, in words.
    """

    def __init__(
        self,
        description: RobotDescription,
        sift: Sift,
        motion: MotionPrimitives,
        own_map: OwnMap,
        policy: SearchPolicy,
        fleet: FleetMap | None = None,
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
        self._look_again: Pose2 | None = None
        self._ambiguous = ""
        self._looks = self._views = 0

    def search(self, believed: Pose2 | None = None) -> Search:
        """Look around here, then elsewhere; None if that was in vain at as many places as the policy says.

        Args:
            believed: `map_from_robot` in the own map by the wheels, if the robot has only just lost sight of
                everything: then it looks first where nodes nearby have looked.
        """
        policy, motion = self._policy, self._motion
        self.detail, self._ambiguous = "looking", ""
        for heading in self._familiar(believed):
            yield from motion.turn(wrap_angle(heading - motion.odom_from_robot.heading), TURN_RATE)
            yield from motion.stand(STILL)
            found = yield from self.look(LENIENT)
            if found is not None:
                return found
        place, begin = 1, motion.turned
        while True:
            self._looks, self._views, self._hint = 0, 0, None
            found = yield from self._look_around(policy.turns[0] if place == 1 else policy.turns[1], begin)
            if found is not None:
                return found
            if self._views < LEAST_VIEWS * self._looks:
                # With a covered lens, or in the dark, there is nothing to be learnt from going elsewhere.
                continue
            last = place == policy.places
            moved = False if last else (yield from self._move())
            if last or not (moved or policy.places == 0):
                break
            place += 1
        self._give_up(f"at {place} place{'s' if place > 1 else ''}")
        return None

    def wait(self) -> Search:
        """Look while somebody else moves the robot; None after `carried_looks` views in vain."""
        while self._views < self._policy.carried_looks:
            found = yield from self.look()
            if found is not None:
                return found
            self.detail = f"waiting to recognise a place of its own map: {self.detail}"
            yield from self._motion.stand(self._policy.carried_pause)
        self._give_up(f"in {self._views} images")
        return None

    def look(self, leniency: float = 1.0) -> Search:
        """Recognise the current view; None if it is not known, or not for sure.

        Args:
            leniency: by how much a recognition may be less exact than `sure`.
        """
        self._looks += 1
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
        if self._policy.looks > 1:
            return self._second_of_two(own)
        told = None if self._fleet is None else (yield from self._fleet.candidates(view))
        return self._single(own, told, leniency)

    # Verdicts

    def _single(self, own: Candidates, told: Candidates | None, leniency: float) -> Candidate | None:
        """The place that one view shows, by the own map and by the fleet's, which must not contradict it."""
        sure = self._policy.sure
        self.detail = own.reason if told is None else told.reason
        if told is not None and told.ambiguous:
            self._ambiguous = told.ambiguous
            self.detail = f"ambiguous: {told.ambiguous}"
            return None
        theirs = None if told is None else next(iter(told.places), None)
        mine = None if own.ambiguous else next(iter(own.places), None)
        if mine is not None and not exact_enough(mine.node_from_robot, sure, leniency):
            mine = None
        if mine is not None and not (theirs and self._elsewhere(theirs, mine)):
            self.detail = f"own map: {own.reason}"
            # The robot has stood still while the answer was on its way.
            return mine
        # How far away a photograph was taken shows on the way to it, not by looking again.
        vague = theirs is not None and not exact_enough(theirs.node_from_robot, sure, leniency)
        if theirs is not None and theirs.distance_known and vague:
            self.detail += ", but not exactly enough"
            return None
        return theirs

    def _second_of_two(self, own: Candidates) -> Candidate | None:
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
        here = self._own.map.nodes[best.node].map_from_robot.mean @ best.node_from_robot.mean
        now = PoseHypothesis(here, motion.odom_from_robot, motion.way, motion.turned, exact)
        agreeing = [earlier for earlier in self._hypotheses if consistent(earlier, now)]
        self._hypotheses.append(now)
        if exact and agreeing:
            return best
        if not exact:
            self._look_again = next((h.odom_from_robot for h in agreeing if h.exact), None)
        return None

    def _elsewhere(self, told: Candidate, own: Candidate) -> bool:
        """Whether the fleet puts the robot elsewhere. It may not know yet what the own map knows."""
        nodes = self._own.map.nodes
        if told.node not in nodes:
            return True
        there, here = (nodes[c.node].map_from_robot.mean @ c.node_from_robot.mean for c in (told, own))
        return here.distance(there) > APART

    def _give_up(self, where: str) -> None:
        what = "no two views agreed" if self._hypotheses else "nothing was recognised"
        self.detail = f"cannot find itself on its own map of {len(self._own.map.nodes)} nodes: {what} {where}"

    # Moves

    def _look_around(self, turns: int, begin: float) -> Search:
        """Look and turn, for whole turns; the search began when the robot had turned by `begin`, rad."""
        motion, start = self._motion, self._motion.turned
        for _ in range(math.ceil(turns * math.tau / LOOK_TURN)):
            yield from motion.stand(STILL)
            in_vain = (motion.turned - begin) / math.tau
            found = yield from self.look(1.0 + self._policy.leniency * in_vain)
            if found is not None:
                return found
            if motion.turned - start >= (turns if self._hint is None else 1) * math.tau:
                break
            again, self._look_again = self._look_again, None
            turn = LOOK_TURN
            if again is not None:
                turn = wrap_angle(again.heading - motion.odom_from_robot.heading)
            yield from motion.turn(turn, TURN_RATE)
        return None

    def _move(self) -> Generator[Command, None, bool]:
        """Drive a little to look from elsewhere; returns whether there was room.

        Whatever tells two places apart is to be seen from somewhere: a door that stands elsewhere, a picture
        around the corner. A node that was recognised, though not well enough, is better seen from nearby.
        """
        motion = self._motion
        way, direction = motion.freest(MOVE)
        if self._hint is not None:
            _, odom_from_node = self._hint
            node = motion.odom_from_robot.inverse() @ odom_from_node
            toward = math.atan2(node.y, node.x)
            near = min(motion.room(toward), math.hypot(node.x, node.y))
            if near >= LEAST_MOVE:
                way, direction = min(near, MOVE), toward
        if way < LEAST_MOVE:
            self.detail = "no room to look from elsewhere"
            return False
        why = "nothing here is known" if self._hint is None else "nothing here is known well enough"
        why = f"ambiguous, {self._ambiguous}" if self._ambiguous else why
        self.detail, self._ambiguous = f"{why}: driving on to look from elsewhere", ""
        yield from motion.turn(math.remainder(direction, math.tau), TURN_RATE)
        yield from motion.drive_on(way, SPEED)
        return True

    def _take_hint(self, own: Candidates) -> None:
        """Remember the node that was seen best from here, however vaguely."""
        best = own.places[0].recognized if own.places else None
        if best is not None and (self._hint is None or best.recognition.inliers > self._hint[0]):
            robot_from_node = best.recognition.node_from_robot.mean.inverse()
            self._hint = best.recognition.inliers, self._motion.odom_from_robot @ robot_from_node

    def _familiar(self, believed: Pose2 | None) -> list[float]:
        """Headings in the wheels' frame, rad, in which own nodes nearby have looked; the nearest first."""
        if believed is None:
            return []
        here = self._motion.odom_from_robot.heading
        poses = [n.map_from_robot.mean for n in self._own.map.nodes.values() if len(n.landmarks) >= RICH]
        turns = [
            wrap_angle(there.heading - believed.heading)
            for there in poses
            if believed.distance(there) <= NEARBY
        ]
        chosen: list[float] = []
        # It has just looked straight on.
        for turn in sorted(turns, key=abs):
            if all(abs(wrap_angle(turn - other)) >= LOOK_TURN for other in (0.0, *chosen)):
                chosen.append(turn)
        return [wrap_angle(here + turn) for turn in chosen[:FAMILIAR]]

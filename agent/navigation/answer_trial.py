"""Answers of the fleet on trial: each is held against the robot's own view, and given up if that differs.

A whereabouts or a route says what will be in view. Until a node of it is seen where it should be, the robot
drives no further than it may drive blindly; then the answer is refuted. Two answers that agree, by the wheels
between them, on where the goal is bear each other out as well. Several refuted answers in a row, or a drive
out of all proportion to its route, end the mission: no answer makes a robot drive for ever.
"""

import math
from collections.abc import Sequence

from mapweave.agent.global_localization.candidates import Candidate
from mapweave.agent.global_localization.pose_consistency import PoseHypothesis, consistent
from mapweave.agent.global_localization.refuted_places import RefutedPlaces
from mapweave.agent.localization.fix import TURN_SHARE, Fix
from mapweave.agent.motion_primitives import MotionPrimitives
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import RouteLeg

TRIALS = 6
"""Answers refuted in a row before a goal is given up. Each costs at most the blind way, 2 m, and a search."""
MORE_WAY = 50.0
"""The way to a stop may take this much, m: what a lost robot turns and drives within its patience,"""
ROUTES = 5.0
"""and so many times its longest route: detours around what is blocked, and ways back."""
LONGEST_ROUTE = 100.0
"""Of which no more counts than this, m: a false one may have any length. No stop takes more than 550 m."""


class AnswerTrial:
    """Tries a server's answer on the way to one stop of a mission, or to its goal.

    Attributes:
        node: by which the robot is localized by the fleet's word alone; None if its own view bears it out.
        borne_out: whether a node to which the present route leads was seen where it should be.
    """

    def __init__(self, motion: MotionPrimitives, refuted: RefutedPlaces) -> None:
        """Nothing was answered yet."""
        self.node: NodeId | None = None
        self.borne_out = False
        self._motion = motion
        self._refuted = refuted
        self._longest, self._begun_at = 0.0, _effort(motion)
        self._failed = 0
        self._route: Sequence[RouteLeg] = ()
        self._last = ""
        self._searched = False
        self._before: tuple[NodeId, PoseHypothesis] | None = None

    def found(self, place: Candidate | None) -> None:
        """Take where the robot is said to be, or found itself on its own map."""
        self.node = None if place is None or place.recognized is not None else place.node
        self._searched = place is not None

    def took(self, route: Sequence[RouteLeg], fix: Fix) -> None:
        """Take the route that is driven from now on, and where the robot is on it."""
        self._route, self.borne_out = route, False
        if self._searched:
            node_from_goal = Pose2()
            for leg in route:
                node_from_goal = node_from_goal @ leg.previous_from_node.mean
            self._compare(route[-1].node.id, node_from_goal.inverse() @ fix.node_from_robot.mean)
        legs = [leg.previous_from_node.mean for leg in route]
        length = sum(math.hypot(leg.x, leg.y) for leg in legs)
        self._longest = max(self._longest, min(length, LONGEST_ROUTE))

    def _compare(self, goal: NodeId, goal_from_robot: Pose2) -> None:
        """Hold the answers to a search against those to the one before: the wheels know what is between."""
        motion = self._motion
        now = PoseHypothesis(goal_from_robot, motion.odom_from_robot, motion.way, motion.turned, True)
        if self._before is not None and self._before[0] == goal and consistent(self._before[1], now):
            self._failed = 0
        self._before, self._searched = (goal, now), False

    def saw(self, node: NodeId) -> None:
        """A node of the route is in view where it should be."""
        self.node = None
        if node != self._route[0].node.id or len(self._route) == 1:
            self.borne_out, self._failed = True, 0

    def refute(self, blind: float) -> None:
        """Nothing of the route was in view on so much way, m: the answers are not tried again from here."""
        self._failed += 1
        self._refuted.count += 1
        goal = self._route[-1].node.id
        if self.node is not None:
            self._refuted.add(self.node)
            said = f"the map server says that the robot is at node {self.node}"
        else:
            said = f"the route to {goal} leads past {len(self._route)} nodes"
        self._last = f"{said}; nothing of it is in view after {blind:.1f} m"

    def blocked(self) -> None:
        """Something is in the way. That refutes no place, unless no way from there is free."""
        if self.node is not None:
            self._failed += 1
            self._last = f"the map server says that the robot is at node {self.node}; every way is blocked"

    @property
    def ended(self) -> str:
        """Why no further answer is tried; empty if one may be."""
        if self._failed >= TRIALS:
            return f"{self._failed} answers in a row were wrong: {self._last}"
        way = _effort(self._motion) - self._begun_at
        if way > MORE_WAY + ROUTES * self._longest:
            effort = f"{way:.0f} m of driving and turning for a route of {self._longest:.0f} m"
            return f"{effort}: {self._last}" if self._last else effort
        return ""


def _effort(motion: MotionPrimitives) -> float:
    """Way driven and turned so far, m."""
    return motion.way + TURN_SHARE * motion.turned

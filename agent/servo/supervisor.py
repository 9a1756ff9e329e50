"""The servo: which law or which leg drives, tick by tick, so that the landmarks stay in view."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.observation import Command, RobotDescription
from mapweave.agent.servo.laws import control, saturate
from mapweave.agent.servo.leg_controller import LegController, SpeedLimits, clip
from mapweave.agent.servo.margins import FIELD_MARGIN, LEAST_MARGIN, MIN_VISIBLE, TURN_GAIN
from mapweave.agent.servo.obstacles import ObstacleMemory
from mapweave.agent.servo.plan import LEG_PRICE, TURN_PRICE, ServoPlan, Surroundings, arc, cost_of, sample
from mapweave.agent.servo.planner import find_plan
from mapweave.agent.servo.polar import Polar, continued, polar_of
from mapweave.agent.servo.recovery import Recovery
from mapweave.agent.servo.rollout import roll_out
from mapweave.agent.servo.servo_step import ServoStep, State
from mapweave.agent.servo.visibility import Visibility
from mapweave.hybridmap.pose import Pose2, wrap_angle

LAMBDA = 2.0
"""Gain lambda of the laws; 2 is critically damped."""
GAIN = 1.5
"""How fast time runs in the laws, 1/s; multiplies both speeds."""
DEAD_ZONE = 0.004
"""Distance rho_D within which only the heading is mended, m."""
POSITION_TOLERANCE = 0.0075
"""Estimated distance at which the goal counts as reached, m: a centimetre of true distance less what a pose
filter may be off."""
HEADING_TOLERANCE = 0.008
"""Estimated heading error at which the goal counts as reached, rad."""
SETTLE_TICKS = 3
"""Ticks in a row inside both tolerances before the robot has arrived."""
CLEARANCE = 0.04
"""Room between the footprint and obstacles, m."""
LAW_REACH = 0.04
"""Nearer than this no law is taken up (one at work goes on), m: the direction to the goal is noise there,
and short legs are surer."""
LAW_BONUS = 0.15
"""A law is preferred to a plan up to this share of extra cost."""
LAW_BONUS_M = 0.05
"""And besides up to this extra cost, m."""
HORIZON = 0.15
"""Look-ahead of the last check before a command leaves, s."""


class Servo:
    """Parks the robot at the goal, keeping enough landmarks in view at every instant.

    The order of preference: (1) inside the dead zone turn on the spot to the goal's heading; (2) continue
    the present law while its roll-out keeps the constraints; (3) a law whose roll-out parks and costs little
    more than a plan; (4) a plan of legs, made again when it turns out to be wrong; (5) turn, then retreat,
    to where landmarks are in view again; (6) report that it is stuck.
    """

    def __init__(self, description: RobotDescription) -> None:
        """Prepare for a robot."""
        self._description = description
        self._limits = SpeedLimits(max(description.max_forward, 1e-3), max(description.max_turn, 1e-3))
        self.start(Pose2(), np.zeros((0, 3)))

    def start(self, goal_from_robot: Pose2, points_in_goal: NDArray[Any]) -> bool:
        """Take a new goal: forget the way and the obstacles.

        Args:
            goal_from_robot: where the robot is, in the goal's robot frame.
            points_in_goal: (N, 3) m, landmarks in the goal's robot frame; rows with NaN are ignored.

        Returns:
            Whether a way is known.
        """
        self.switches = 0
        self._visibility = Visibility(self._description.camera)
        self._memory = ObstacleMemory()
        self._law: int | None = None
        self._polar = Polar(0.0, 0.0, 0.0)  # continued from tick to tick while a law is at work
        self._plan: ServoPlan | None = None
        self._leg = 0
        self._follower: LegController | None = None
        self._broken_laws = 0
        self._in_dead_zone = False
        self._settled = 0
        self._recovery = Recovery(self._limits)
        self._wait, self._patience = 0, 2
        self._visibility.update(goal_from_robot, points_in_goal, None)
        self._choose(goal_from_robot, self._surroundings(goal_from_robot))
        return self._law is not None or self._plan is not None

    def come_nearer(self, goal_from_robot: Pose2) -> bool:
        """At the goal, yet not near enough for the caller: drive one more way to it.

        Args:
            goal_from_robot: where the robot is, in the goal's robot frame, as it was measured at rest.

        Returns:
            Whether a way is known; if not, the robot stays where it is.
        """
        pose = Pose2(goal_from_robot.x, goal_from_robot.y, wrap_angle(goal_from_robot.heading))
        if math.hypot(pose.x, pose.y) <= DEAD_ZONE:
            return False
        plan = find_plan(self._surroundings(pose), pose)
        if plan is None:
            return False
        self._plan, self._leg, self._follower = plan, 0, None
        self._in_dead_zone, self._settled = False, 0
        self.switches += 1
        return True

    def command(
        self,
        goal_from_robot: Pose2,
        points_in_goal: NDArray[Any],
        visible: NDArray[np.bool_],
        obstacles: NDArray[Any],
    ) -> ServoStep:
        """One tick.

        Args:
            goal_from_robot: where the robot is now, in the goal's robot frame.
            points_in_goal: (N, 3) m, landmarks in the goal's robot frame; rows with NaN are ignored.
            visible: (N,) which of them are tracked now.
            obstacles: (K, 2) m, in robot, points that the rangers hit now.

        Raises:
            InvalidValue: landmarks of another shape.
        """
        pose = Pose2(goal_from_robot.x, goal_from_robot.y, wrap_angle(goal_from_robot.heading))
        self._visibility.update(pose, points_in_goal, visible)
        self._memory.add(pose, obstacles)
        final = self._final_turn(pose)
        if final is not None:
            return final
        surroundings = self._surroundings(pose)
        if self._visibility.field.slack(pose.vector) < LEAST_MARGIN:
            self._law = None
            self._drop_plan()
            return self._step(*self._recovery.command(pose, self._visibility.field, surroundings))
        self._recovery.over()
        for _ in range(3):
            self._keep_or_drop(pose, surroundings)
            if self._law is None and self._plan is None:
                self._choose(pose, surroundings)
            if self._law is not None:
                return self._drive_law(pose, surroundings)
            if self._plan is None:
                break
            step = self._drive_leg(pose, surroundings)
            if step is not None:
                return step
        return self._step(Command(), "stuck", "no way keeps the landmarks in view and the obstacles away")

    # ---- constraints

    def _surroundings(self, pose: Pose2) -> Surroundings:
        """Constraints now; where goal or robot are already nearer to an obstacle, as near is allowed."""
        wanted = self._description.radius + CLEARANCE
        around = Surroundings(self._visibility.planning_field, self._memory.points, wanted)
        if len(self._memory.points):
            nearest = float(around.distance(np.array([pose.vector, [0.0, 0.0, 0.0]])).min())
            floor = self._description.radius + 0.01
            around.clearance = min(wanted, max(nearest - 0.005, floor))
        return around

    # ---- choice

    def _keep_or_drop(self, pose: Pose2, around: Surroundings) -> None:
        """Drop the law or plan at work when its way has become inadmissible; let a law relieve a plan."""
        hard = 0.5 * LEAST_MARGIN
        if self._law is not None:
            self._polar = continued(pose, self._polar)
            rollouts = roll_out(self._polar, LAMBDA, DEAD_ZONE)
            way = rollouts.poses[self._law]
            if not (rollouts.parked[self._law] and around.admits(way, hard)):
                self._law = None
                self._broken_laws += 1
        elif self._plan is not None:
            rest = self._plan.legs[self._leg :]
            pose_near_start = Pose2(pose.x, pose.y, _branch(pose.heading, self._plan.start.heading))
            if not around.admits(sample(pose_near_start, rest), min(hard, self._plan.margin)):
                self._drop_plan()
                return
            cost = cost_of(pose_near_start, rest)
            law = self._best_law(polar_of(pose), around, cost)
            if law is not None:
                self._drop_plan()
                self._take_law(law, pose)

    def _choose(self, pose: Pose2, around: Surroundings) -> None:
        """Find a way from here: the cheaper of laws and plan, laws favoured."""
        if self._wait > 0:
            self._wait -= 1
            return
        if math.hypot(pose.x, pose.y) < 1e-9 or self._visibility.field.count < MIN_VISIBLE:
            return
        plan = find_plan(around, pose)
        law = self._best_law(polar_of(pose), around, plan.cost if plan else math.inf)
        if law is not None:
            self._take_law(law, pose)
        elif plan is not None:
            self._plan, self._leg, self._follower = plan, 0, None
            self.switches += 1
        else:
            # A search that found nothing is dear: wait ever longer before the next, the scene may change.
            self._patience = min(2 * self._patience, 80)
            self._wait = self._patience
            return
        self._patience = 2

    def _best_law(self, polar: Polar, around: Surroundings, cost: float) -> int | None:
        """The cheapest law that parks within the constraints for little more than a cost (m)."""
        if polar.rho < LAW_REACH:
            return None
        rollouts = roll_out(polar, LAMBDA, DEAD_ZONE)
        costs = rollouts.lengths + TURN_PRICE * rollouts.turns + LEG_PRICE
        # Each law that had to be given up raises the bar for the next: no endless switching.
        margin = FIELD_MARGIN * (1.0 + 0.5 * self._broken_laws)
        limit = cost * (1.0 + LAW_BONUS) + LAW_BONUS_M
        for law in np.argsort(costs, kind="stable").tolist():
            if costs[law] > limit:
                return None
            if rollouts.parked[law] and around.admits(rollouts.poses[law], margin):
                return int(law)
        return None

    def _take_law(self, law: int, pose: Pose2) -> None:
        self._law, self._polar = law, polar_of(pose)
        self.switches += 1

    def _drop_plan(self) -> None:
        self._plan, self._follower = None, None

    # ---- motion

    def _final_turn(self, pose: Pose2) -> ServoStep | None:
        """Inside the dead zone: mend the heading, then settle."""
        rho = math.hypot(pose.x, pose.y)
        self._in_dead_zone = rho <= (POSITION_TOLERANCE if self._in_dead_zone else DEAD_ZONE)
        if not self._in_dead_zone:
            self._settled = 0
            return None
        self._law = None
        self._drop_plan()
        if abs(pose.heading) > HEADING_TOLERANCE:
            self._settled = 0
            turn = Command(0.0, clip(-TURN_GAIN * pose.heading, self._limits.turn))
            return self._step(turn, "turning", "at the goal: turning to its heading")
        self._settled += 1
        if self._settled < SETTLE_TICKS:
            return self._step(Command(), "turning", "at the goal: settling")
        return self._step(Command(), "arrived", "at the goal")

    def _drive_law(self, pose: Pose2, around: Surroundings) -> ServoStep:
        """Equation (5) with v = rho u, slowed to the limits without a change of curvature."""
        assert self._law is not None
        polar, gain = self._polar, GAIN
        u, omega = control(polar.phi, polar.beta, LAMBDA)
        speeds = saturate(
            gain * polar.rho * float(u),
            gain * float(omega[self._law]),
            self._limits.forward,
            self._limits.turn,
        )
        return self._checked(Command(*speeds), "driving", f"law {self._law + 1}", pose, around)

    def _drive_leg(self, pose: Pose2, around: Surroundings) -> ServoStep | None:
        """Follow the plan; None when it has ended short of the goal."""
        plan = self._plan
        assert plan is not None
        while self._leg < len(plan.legs):
            leg = plan.legs[self._leg]
            if self._follower is None:
                last = self._leg == len(plan.legs) - 1
                self._follower = LegController(leg, last, self._limits)
            command = self._follower.command(pose)
            if command is not None:
                name = f"leg {self._leg + 1} of {len(plan.legs)}"
                if self._follower.turning:
                    return self._checked(command, "turning", f"turning to {name}", pose, around)
                away = leg.direction < 0 and math.hypot(leg.x, leg.y) > math.hypot(pose.x, pose.y)
                return self._checked(command, "retreating" if away else "driving", name, pose, around)
            self._leg += 1
            self._follower = None
        self._drop_plan()
        # A way that has ended within the tolerance is as good as it gets: no further leg for a millimetre.
        self._in_dead_zone = math.hypot(pose.x, pose.y) <= 0.8 * POSITION_TOLERANCE
        return self._final_turn(pose)

    # ---- output

    def _checked(
        self, command: Command, state: State, reason: str, pose: Pose2, around: Surroundings
    ) -> ServoStep:
        """The last check: a command that would break a constraint within the look-ahead is stopped."""
        if around.admits(arc(pose, command.forward, command.turn, HORIZON), 0.0):
            return self._step(command, state, reason)
        self._law = None
        self._drop_plan()
        return self._step(Command(), state, f"stopped: {reason} would leave what is allowed")

    def _step(self, command: Command, state: State, reason: str) -> ServoStep:
        return ServoStep(command, state, self._law if state == "driving" else None, reason)


def _branch(angle: float, reference: float) -> float:
    """The angle plus the multiple of 2 pi that brings it nearest to another."""
    return reference + wrap_angle(angle - reference)

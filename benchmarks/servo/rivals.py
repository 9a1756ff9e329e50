"""What the servo is compared with: greedy switching of 2004, and pursuit that ignores the field of view."""

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from benchmarks.servo.world import LEAST_VISIBLE, ROBOT, SEMI_APERTURE
from mapweave.agent.observation import Command
from mapweave.agent.servo.laws import control, lyapunov, saturate
from mapweave.agent.servo.polar import continued, polar_of
from mapweave.agent.servo.supervisor import Servo
from mapweave.hybridmap.pose import Array, Pose2, wrap_angle

_DEAD_ZONE = 0.006
_HEADING_TOLERANCE = 0.008
_NOTHING = np.zeros((0, 2))


class Controller(Protocol):
    """Something that parks.

    Attributes:
        switches: how often another law or plan has taken the wheels.
    """

    switches: int

    def command(self, goal_from_robot: Pose2, points: Array, visible: NDArray[np.bool_]) -> Command | None:
        """What to do, or None when it has parked."""
        ...


class Ours:
    """mapweave.agent.servo.supervisor.Servo, as the robot uses it."""

    def __init__(self, goal_from_robot: Pose2, points: Array) -> None:
        """Start it."""
        self._servo = Servo(ROBOT)
        self._servo.start(goal_from_robot, points)

    @property
    def switches(self) -> int:
        """Laws and plans taken up."""
        return self._servo.switches

    @switches.setter
    def switches(self, value: int) -> None:
        self._servo.switches = value

    def command(self, goal_from_robot: Pose2, points: Array, visible: NDArray[np.bool_]) -> Command | None:
        """One tick."""
        step = self._servo.command(goal_from_robot, points, visible, _NOTHING)
        return None if step.state == "arrived" else step.command


def _final_turn(pose: Pose2) -> Command | None:
    if abs(wrap_angle(pose.heading)) <= _HEADING_TOLERANCE:
        return None
    turn = -2.5 * wrap_angle(pose.heading)
    return Command(0.0, max(-ROBOT.max_turn, min(ROBOT.max_turn, turn)))


class Greedy:
    """Murrieri et al. 2004 as it is usually built: the law with the lowest V, another at the field's border.

    The four landmarks nearest to the optical axis at the start are tracked (all that are in view count when
    the law must change). At a threshold below Delta the law of lowest V whose next motion turns the border
    feature inward takes over; if there is none, the old one goes on.
    """

    def __init__(self, goal_from_robot: Pose2, points: Array) -> None:
        """Take the law of lowest V."""
        self.switches = 1
        self._polar = polar_of(goal_from_robot)
        values = lyapunov(self._polar.rho, self._polar.phi, self._polar.beta)
        self._law = int(values.argmin())
        self._inside = False

    def command(self, goal_from_robot: Pose2, points: Array, visible: NDArray[np.bool_]) -> Command | None:
        """One tick."""
        pose = goal_from_robot
        self._inside = math.hypot(pose.x, pose.y) <= (0.01 if self._inside else _DEAD_ZONE)
        if self._inside:
            return _final_turn(pose)
        self._polar = continued(pose, self._polar)
        if self._room(pose, points) < 0.06 and self._room(self._after(pose, self._law), points) < self._room(
            pose, points
        ):
            fresh = polar_of(pose)
            values = lyapunov(fresh.rho, fresh.phi, fresh.beta)
            here = self._room(pose, points)
            for law in np.argsort(values).tolist():
                if law != self._law and self._room(self._after(pose, law), points) > here:
                    self._law, self._polar = law, fresh
                    self.switches += 1
                    break
        return self._speeds(pose, self._law)

    def _speeds(self, pose: Pose2, law: int) -> Command:
        polar = self._polar if law == self._law else polar_of(pose)
        u, omega = control(polar.phi, polar.beta, 2.0)
        return Command(
            *saturate(1.5 * polar.rho * float(u), 1.5 * float(omega[law]), ROBOT.max_forward, ROBOT.max_turn)
        )

    def _after(self, pose: Pose2, law: int) -> Pose2:
        command = self._speeds(pose, law)
        way, turn = command.forward * ROBOT.tick, command.turn * ROBOT.tick
        return pose @ Pose2(way * math.cos(turn / 2), way * math.sin(turn / 2), turn)

    def _room(self, pose: Pose2, points: Array) -> float:
        """rad, room of the fourth-best landmark to the border."""
        seen = pose.inverse().apply(points)
        bearing = np.abs(np.arctan2(seen[:, 1], seen[:, 0]))
        return SEMI_APERTURE - float(np.sort(bearing)[LEAST_VISIBLE - 1])


class Pursuit:
    """Turns to the goal, drives straight at it, turns to its heading: the shortest way of all."""

    def __init__(self, goal_from_robot: Pose2, points: Array) -> None:
        """Forward or backward, whichever needs less turning."""
        self.switches = 1
        toward = math.atan2(-goal_from_robot.y, -goal_from_robot.x)
        ahead = abs(wrap_angle(toward - goal_from_robot.heading)) + abs(wrap_angle(toward))
        astern = abs(wrap_angle(toward + math.pi - goal_from_robot.heading)) + abs(
            wrap_angle(toward + math.pi)
        )
        self._sense = 1.0 if ahead <= astern else -1.0
        self._inside = False

    def command(self, goal_from_robot: Pose2, points: Array, visible: NDArray[np.bool_]) -> Command | None:
        """One tick."""
        pose = goal_from_robot
        distance = math.hypot(pose.x, pose.y)
        self._inside = distance <= (0.01 if self._inside else _DEAD_ZONE)
        if self._inside:
            return _final_turn(pose)
        toward = math.atan2(-self._sense * pose.y, -self._sense * pose.x)
        error = wrap_angle(toward - pose.heading)
        if abs(error) > math.pi / 2 and distance < 0.1:
            self._sense = -self._sense
            error = wrap_angle(error + math.pi)
        forward = self._sense * 1.5 * distance * max(math.cos(error), 0.0) ** 3
        return Command(*saturate(forward, 2.5 * error, ROBOT.max_forward, ROBOT.max_turn))


CONTROLLERS: dict[str, Callable[[Pose2, Array], Controller]] = {
    "servo": Ours,
    "greedy_2004": Greedy,
    "pursuit_without_fov": Pursuit,
}

"""The world of the servo benchmark: an exact unicycle, landmarks, a camera with pixel noise, a pose filter.

Nothing of mapweave.agent.servo is used here: what is in view is judged by this module alone.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.observation import Command, RobotDescription
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array, Pose2

SEMI_APERTURE = math.radians(30.0)
LEAST_VISIBLE = 4
CAMERA = Camera(
    320, 240, 160.0 / math.tan(SEMI_APERTURE), 160.0 / math.tan(SEMI_APERTURE), 160.0, 120.0, 0.25
)
ROBOT = RobotDescription(CAMERA)
PIXEL_SIGMA_PX = 0.5
_FINE = 10
"""Integration steps a tick; visibility is judged at each."""


def in_view(poses: Array, points: Array) -> NDArray[np.bool_]:
    """(..., N) whether landmarks (N, 3) are in the image at poses (..., 3), both in goal."""
    x, y, heading = (poses[..., k, None] for k in range(3))
    dx, dy = points[:, 0] - x, points[:, 1] - y
    depth = np.cos(heading) * dx + np.sin(heading) * dy
    aside = np.cos(heading) * dy - np.sin(heading) * dx
    ahead = depth > 0.1
    safe = np.where(ahead, depth, 1.0)
    seen: NDArray[np.bool_] = ahead & (np.abs(np.arctan2(aside, safe)) <= SEMI_APERTURE)
    return seen & (np.abs(points[:, 2] - CAMERA.mount_height) * CAMERA.fy / safe <= CAMERA.cy)


@dataclass(frozen=True, eq=False)
class Task:
    """One parking task: where the robot starts, in goal, and landmarks (N, 3) m, in goal."""

    start: Pose2
    points: Array


def draw_task(rng: np.random.Generator, count: int = 12) -> Task:
    """Landmarks 1.5-5 m ahead of the goal and in its view, and a start behind the goal.

    The start is 0.3-2.5 m off in the half-plane behind the goal (up to 10 cm ahead), its heading within 45
    degrees of the goal's, and sees at least six landmarks.
    """
    while True:
        depth = rng.uniform(1.5, 5.0, count)
        bearing = rng.uniform(-SEMI_APERTURE, SEMI_APERTURE, count)
        height = CAMERA.mount_height + rng.uniform(-0.25, 0.25, count)
        points = np.column_stack([depth, depth * np.tan(bearing), height])
        distance, direction = rng.uniform(0.3, 2.5), rng.uniform(-math.pi, math.pi)
        start = Pose2(
            distance * math.cos(direction),
            distance * math.sin(direction),
            rng.uniform(-math.pi / 4, math.pi / 4),
        )
        if start.x <= 0.1 and in_view(start.vector, points).sum() >= 6:
            return Task(start, points)


class Unicycle:
    """The true robot: speeds are clipped to its limits and held for one tick."""

    def __init__(self, task: Task) -> None:
        """Stand at the task's start."""
        self.pose = task.start
        self.length = 0.0
        self.least_visible = LEAST_VISIBLE + 99
        self._points = task.points

    def drive(self, command: Command) -> tuple[float, float]:
        """Drive one tick; returns the true way (m) and turn (rad)."""
        v = float(np.clip(command.forward, -ROBOT.max_forward, ROBOT.max_forward))
        w = float(np.clip(command.turn, -ROBOT.max_turn, ROBOT.max_turn))
        times = np.linspace(0.0, ROBOT.tick, _FINE + 1)
        turn = w * times
        chord = v * times * np.sinc(0.5 * turn / math.pi)
        middle = self.pose.heading + 0.5 * turn
        path = np.column_stack(
            [
                self.pose.x + chord * np.cos(middle),
                self.pose.y + chord * np.sin(middle),
                self.pose.heading + turn,
            ]
        )
        self.least_visible = min(self.least_visible, int(in_view(path, self._points).sum(axis=1).min()))
        self.pose = Pose2.from_vector(path[-1])
        self.length += abs(v) * ROBOT.tick
        return v * ROBOT.tick, w * ROBOT.tick


class PoseFilter:
    """Estimates the robot's pose in goal from noisy wheels and noisy pixels of the known landmarks."""

    def __init__(self, task: Task, rng: np.random.Generator) -> None:
        """Begin with a rough guess, as after a relocalization; the first images mend it.

        Args:
            task: what is true.
            rng: of the noise.
        """
        self._points, self._rng = task.points, rng
        self._state = task.start.vector + rng.normal(0.0, [0.05, 0.05, 0.05])
        self._covariance = np.diag([0.05, 0.05, 0.05]) ** 2
        for _ in range(3):
            self.see(task.start)

    @property
    def pose(self) -> Pose2:
        """The estimate."""
        return Pose2.from_vector(self._state)

    def move(self, way: float, turn: float) -> None:
        """Predict by wheels that are off by two per cent and a little."""
        way += self._rng.normal(0.0, 0.02 * abs(way) + 1e-4)
        turn += self._rng.normal(0.0, 0.02 * abs(turn) + 2e-4)
        middle = self._state[2] + 0.5 * turn
        c, s = math.cos(middle), math.sin(middle)
        self._state = self._state + np.array([way * c, way * s, turn])
        f = np.array([[1.0, 0.0, -way * s], [0.0, 1.0, way * c], [0.0, 0.0, 1.0]])
        g = np.array([[c, 0.0], [s, 0.0], [0.0, 1.0]])
        q = np.diag([0.02 * abs(way) + 1e-4, 0.02 * abs(turn) + 2e-4]) ** 2
        self._covariance = f @ self._covariance @ f.T + g @ q @ g.T

    def see(self, true_pose: Pose2) -> NDArray[np.bool_]:
        """Take one image's pixels; returns (N,) which landmarks are in view."""
        seen = in_view(true_pose.vector, self._points)
        if not seen.any():
            return seen
        pixels = CAMERA.project(true_pose.inverse().apply(self._points[seen]))
        pixels += self._rng.normal(0.0, PIXEL_SIGMA_PX, pixels.shape)
        prior, information = self._state, np.linalg.inv(self._covariance)
        state = prior
        for _ in range(3):
            q = Pose2.from_vector(state).inverse().apply(self._points[seen])
            c, s = math.cos(state[2]), math.sin(state[2])
            # d q_x and d q_y by (x, y, heading), each (n, 3); q = R^T (p - t).
            one = np.ones(len(q))
            dx = np.column_stack([-c * one, -s * one, q[:, 1]])
            dy = np.column_stack([s * one, -c * one, -q[:, 0]])
            rise = (q[:, 2] - CAMERA.mount_height)[:, None]
            aside, depth = q[:, 1:2], np.maximum(q[:, :1], 0.05)
            du = -CAMERA.fx * (dy / depth - aside * dx / depth**2)
            dv = CAMERA.fy * rise * dx / depth**2
            jacobian = np.stack([du, dv], axis=1).reshape(-1, 3)
            expected = np.hstack(
                [CAMERA.cx - CAMERA.fx * aside / depth, CAMERA.cy - CAMERA.fy * rise / depth]
            )
            residual = (pixels - expected).ravel()
            h = information + jacobian.T @ jacobian / PIXEL_SIGMA_PX**2
            b = jacobian.T @ residual / PIXEL_SIGMA_PX**2 + information @ (prior - state)
            state = state + np.linalg.solve(h, b)
        self._state, self._covariance = state, np.linalg.inv(h)
        return seen

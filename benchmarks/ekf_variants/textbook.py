"""An extended Kalman filter with a choice of landmark coordinates and linearisation points.

For comparison, not for robots: dense matrices, derivatives by complex step, no gates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.ekf_variants.coordinates import (
    Coordinates,
    Numbers,
    Points,
    Rays,
    from_pose,
    in_robot,
    jacobian,
    of_robot,
)
from mapweave.agent.observation import Odometry
from mapweave.hybridmap.pose import Array, Pose2
from synthetic.mapping_run import AXLE, WHEEL_NOISE, MappingRun

Mask = NDArray[np.bool_]

_FLOOR = 1e-5
"""Standard deviation of a wheel's way in a step without any, m: as our filter's."""


@dataclass(frozen=True)
class Choice:
    """How to filter.

    Attributes:
        coordinates: of landmarks.
        moving: whether they are kept in the moving camera's frame, else in the first camera's.
        depth: at which landmarks start, m.
        depth_sigma: of points at the start, along their ray, m.
        inverse_sigma: of rays at the start, in units of 1 / depth.
        aside_sigma: of points at the start in the two other directions, m; 0 if their ray is known from the
            first pixel. Else the first pixel corrects them.
        iterations: linearisations of an update.
        first_estimates: whether all derivatives are taken at first estimates (Huang, Mourikis and
            Roumeliotis 2010): landmarks where they started, poses where they were predicted.
        relinearisations: how often a step is linearised again at what the image says it was.
    """

    coordinates: Coordinates
    moving: bool
    depth: float = 2.5
    depth_sigma: float = 1.0
    inverse_sigma: float = 1.2
    aside_sigma: float = 0.0
    iterations: int = 1
    first_estimates: bool = False
    relinearisations: int = 0


class TextbookFilter:
    """EKF over [pose (3), landmarks (n x 3)].

    Attributes:
        pose_vector: (3,) [x m, y m, heading rad] since the anchor.
        landmarks: (n, 3) in the choice's coordinates and frame.
        covariance: (3 + 3n, 3 + 3n), additive errors.
        transition: (3 + 3n, 3 + 3n) Jacobian of the last step by the state before it.
        measurement: (2N, 3 + 3n) Jacobian of the last image's slopes, of the N landmarks seen.
    """

    def __init__(self, run: MappingRun, choice: Choice) -> None:
        """Start at the anchor with all landmarks of the run's first image."""
        self.choice = choice
        self._camera = run.camera
        self._focal = np.array([run.camera.fx, run.camera.fy])
        self._centre = np.array([run.camera.cx, run.camera.cy])
        self._variances = (run.pixel_sigma / self._focal) ** 2
        slopes = (run.pixels[0] - self._centre) / self._focal
        n = len(slopes)
        self.pose_vector: Array = np.zeros(3)
        self.covariance: Array = np.zeros((3 + 3 * n, 3 + 3 * n))
        rays = np.column_stack([slopes, np.full(n, 1.0 / choice.depth)])
        self.landmarks: Array = choice.coordinates.drop(Rays().lift(rays))
        index = 3 + np.arange(3 * n).reshape(n, 3)
        self.covariance[index[:, :, None], index[:, None, :]] = self._start(rays)
        self.transition: Array = np.eye(3 + 3 * n)
        self.measurement: Array = np.zeros((0, 3 + 3 * n))
        self._first = self.landmarks
        self._predicted = self.pose_vector
        self._by_input: Array = np.zeros((3 + 3 * n, 2))
        if choice.aside_sigma:
            self._update(np.ones(n, np.bool_), run.pixels[0])

    def step(self, odometry: Odometry, pixels: Array) -> None:
        """Predict and update; the step may be linearised again where its image says that the robot went.

        Args:
            odometry: the step.
            pixels: (n, 2) px; NaN for landmarks that are not seen.
        """
        before = self.pose_vector, self.landmarks, self.covariance
        reference = self._predicted if self.choice.first_estimates else self.pose_vector
        measured = np.array([odometry.forward, odometry.turn])
        self._move(measured, measured, reference)
        self._predicted = self.pose_vector
        seen = np.isfinite(pixels[:, 0])
        for _ in range(self.choice.relinearisations):
            innovation, spread = self._innovate(seen, pixels)
            pull = np.linalg.solve(spread, innovation)
            likely = measured + wheel_covariance(measured) @ (self.measurement @ self._by_input).T @ pull
            self.pose_vector, self.landmarks, self.covariance = before
            self._move(measured, likely, self.pose_vector)
        self._update(seen, pixels)

    def points_in_anchor(self) -> Array:
        """(n, 3) m, landmarks in the first robot frame."""
        points = in_robot(self.choice.coordinates.lift(self.landmarks), self._camera)
        return Pose2.from_vector(self.pose_vector).apply(points) if self.choice.moving else points

    def pose_nees(self, true: Pose2) -> float:
        """Squared Mahalanobis distance of the true pose, 3 degrees of freedom."""
        off = self.pose_vector - true.vector
        return float(off @ np.linalg.solve(self.covariance[:3, :3], off))

    def landmark_nees(self, points: Array, true: Pose2) -> float:
        """Mean squared Mahalanobis distance of landmarks in the filter's own coordinates and frame.

        Args:
            points: (n, 3) m, where they are in the first robot frame.
            true: pose.
        """
        points = true.inverse().apply(points) if self.choice.moving else points
        off = self.landmarks - self.choice.coordinates.drop(of_robot(points, self._camera))
        index = 3 + np.arange(off.size).reshape(off.shape)
        blocks = self.covariance[index[:, :, None], index[:, None, :]]
        return float(np.einsum("ni,nij,nj->n", off, np.linalg.inv(blocks), off).mean())

    @property
    def _vector(self) -> Array:
        return np.concatenate([self.pose_vector, self.landmarks.ravel()])

    @_vector.setter
    def _vector(self, vector: Array) -> None:
        self.pose_vector, self.landmarks = vector[:3], vector[3:].reshape(-1, 3)

    def _start(self, rays: Array) -> Array:
        """(n, 3, 3) covariance of landmarks at the start."""
        choice = self.choice
        if isinstance(choice.coordinates, Points) and choice.aside_sigma:
            own = np.diag(np.square([choice.aside_sigma, choice.aside_sigma, choice.depth_sigma]))
            return np.broadcast_to(own, (len(rays), 3, 3))
        inverse_sigma = choice.inverse_sigma
        if isinstance(choice.coordinates, Points):
            inverse_sigma = choice.depth_sigma / choice.depth
        by_ray = jacobian(lambda z: choice.coordinates.drop(Rays().lift(z)), rays)
        own = np.diag([*self._variances, (inverse_sigma / choice.depth) ** 2])
        return np.asarray(by_ray @ own @ np.swapaxes(by_ray, 1, 2))

    def _measurement_jacobian(self, seen: Mask) -> Array:
        """(2N, 3 + 3n) of the slopes of those seen."""
        landmarks = (self._first if self.choice.first_estimates else self.landmarks)[seen]
        n, rows = len(landmarks), np.arange(2 * len(landmarks)).reshape(-1, 2)
        h = np.zeros((2 * n, len(self.covariance)))
        h[:, :3] = jacobian(lambda p: self._slopes(p, landmarks), self.pose_vector).reshape(2 * n, 3)
        index = 3 + 3 * np.flatnonzero(seen)[:, None] + np.arange(3)
        h[rows[:, :, None], index[:, None, :]] = jacobian(
            lambda z: self._slopes(self.pose_vector, z), landmarks
        )
        return h

    def _innovate(self, seen: Mask, pixels: Array) -> tuple[Array, Array]:
        """Linearise the measurement; its innovation (2N,) and the covariance of that."""
        slopes = (pixels[seen] - self._centre) / self._focal
        h = self.measurement = self._measurement_jacobian(seen)
        spread = h @ self.covariance @ h.T + np.diag(np.tile(self._variances, len(slopes)))
        return (slopes - self._slopes(self.pose_vector, self.landmarks[seen])).ravel(), spread

    def _update(self, seen: Mask, pixels: Array) -> None:
        """Correct by an image (Gauss-Newton on the posterior if iterated)."""
        prior = self._vector
        for _ in range(self.choice.iterations):
            innovation, spread = self._innovate(seen, pixels)
            h = self.measurement
            gain = np.linalg.solve(spread, h @ self.covariance).T
            self._vector = prior + gain @ (innovation - h @ (prior - self._vector))
        corrected = self.covariance - gain @ h @ self.covariance
        self.covariance = 0.5 * (corrected + corrected.T)

    def _move(self, measured: Array, at: Array, reference: Array) -> None:
        """Move by the wheels' (u1, u2), linearised at another, with the rest kept to first order.

        The derivative of the position by the heading is the way from the reference turned by 90 degrees.
        """
        pose_vector = _moved(self.pose_vector, at)
        by_pose = np.eye(3)
        by_pose[0, 2], by_pose[1, 2] = -(pose_vector - reference)[1], (pose_vector - reference)[0]
        pose_by_input = jacobian(lambda u: _moved(self.pose_vector, u), at)
        landmarks, n = self._carried(self.landmarks, at), len(self.landmarks)
        by_landmark = jacobian(lambda z: self._carried(z, at), self.landmarks)
        landmarks_by_input = jacobian(lambda u: self._carried(self.landmarks, u), at)
        self._by_input = np.concatenate([pose_by_input, landmarks_by_input.reshape(3 * n, 2)])
        self.transition = np.zeros_like(self.covariance)
        self.transition[:3, :3] = by_pose
        index = 3 + np.arange(3 * n).reshape(n, 3)
        self.transition[index[:, :, None], index[:, None, :]] = by_landmark
        rest = self._by_input @ (measured - at)
        noise = self._by_input @ wheel_covariance(measured) @ self._by_input.T
        self.covariance = self.transition @ self.covariance @ self.transition.T + noise
        self._vector = np.concatenate([pose_vector, landmarks.ravel()]) + rest

    def _carried(self, landmarks: Numbers, u: Numbers) -> Numbers:
        """Landmarks after a step."""
        if not self.choice.moving:
            return landmarks
        vectors, there = self.choice.coordinates.lift(landmarks), _moved(np.zeros(3), u)
        return self.choice.coordinates.drop(from_pose(vectors, there, self._camera.mount_forward))

    def _slopes(self, pose_vector: Numbers, landmarks: Numbers) -> Numbers:
        """(N, 2) where landmarks are expected, (pixel - principal point) / focal length."""
        vectors = self.choice.coordinates.lift(landmarks)
        if not self.choice.moving:
            vectors = from_pose(vectors, pose_vector, self._camera.mount_forward)
        return np.asarray(vectors[:, :2] / vectors[:, 2:3])


def wheel_covariance(u: Array) -> Array:
    """(2, 2) covariance of a step u = (u1 m, u2 rad), from two wheels that err independently."""
    ways = u[0] + 0.5 * AXLE * u[1] * np.array([1.0, -1.0])
    by_wheels = np.array([[0.5, 0.5], [1.0 / AXLE, -1.0 / AXLE]])
    return np.asarray(by_wheels @ np.diag((WHEEL_NOISE * ways) ** 2 + _FLOOR**2) @ by_wheels.T)


def _moved(pose_vector: Numbers, u: Numbers) -> Numbers:
    """A pose after a step (u1, u2) of the wheels."""
    middle = pose_vector[2] + 0.5 * u[1]
    return np.asarray(pose_vector + np.stack([u[0] * np.cos(middle), u[0] * np.sin(middle), u[1]]))

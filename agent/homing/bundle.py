"""Everything seen on a way as one least squares problem: normal equations with the landmarks eliminated."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.homing.keyframes import Keyframes
from agent.homing.rays import Rays
from agent.homing.sight import BEHIND, Sight, see
from hybridmap.pose import Array, Pose2, PoseGaussian, wrap_angle

USUAL_MISS = 3.0
"""Half squared misses of a landmark, for each image of it, that chance hardly exceeds: 1 is expected."""


@dataclass(frozen=True, eq=False)
class Link:
    """What the prior says of the first posture, or the wheels of two that follow each other.

    Attributes:
        residual: (3,) m, m, rad.
        jacobian: (3, 3 or 6) by the posture or both.
        information: (3, 3) inverse covariance of the residual.
        column: of the first posture's x in the state.
    """

    residual: Array
    jacobian: Array
    information: Array
    column: int

    @property
    def cost(self) -> float:
        """Half its squared miss."""
        return 0.5 * float(self.residual @ self.information @ self.residual)


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal equations at one estimate: [U W^T; W V] with 3 x 3 blocks V of the landmarks.

    Attributes:
        u: (3K, 3K) of the postures.
        w: (N, 3, 3K) coupling of each landmark.
        v: (N, 3, 3) of the landmarks.
        gradient: (3K,) of the postures.
        gradients: (N, 3) of the landmarks.
        cost: half the squared misses, less than that where they are large.
        last_misses: (N,) sigma by which the last image misses; NaN where it shows nothing.
    """

    u: Array
    w: Array
    v: Array
    gradient: Array
    gradients: Array
    cost: float
    last_misses: Array

    def step(self, damping: float) -> tuple[Array, Array]:
        """(K, 3) and (N, 3) changes of postures and landmarks, by the Schur complement of V."""
        k = len(self.gradient)
        v = self.v.copy()
        v[:, range(3), range(3)] *= 1.0 + damping
        shared = np.linalg.solve(v, np.concatenate([self.w, self.gradients[:, :, None]], axis=2))
        coupling, own = shared[:, :, :k], shared[:, :, k]
        flat = self.w.reshape(-1, k)
        reduced = self.u + damping * np.diag(np.diag(self.u)) - flat.T @ coupling.reshape(-1, k)
        postures = np.linalg.solve(reduced, flat.T @ own.reshape(-1) - self.gradient)
        by_ray = np.asarray(-(own + coupling @ postures), np.float64)
        return np.asarray(postures, np.float64).reshape(-1, 3), by_ray

    def covariances(self) -> tuple[Array, Array]:
        """(3, 3) of the last posture, in the place's axes, and (N,) standard deviations of inverse depths."""
        k = len(self.gradient)
        inverse = np.linalg.inv(self.v)
        shared = inverse @ self.w
        reduced = self.u - self.w.reshape(-1, k).T @ shared.reshape(-1, k)
        covariance = np.asarray(np.linalg.inv(reduced), np.float64)
        row = shared[:, 2, :]
        variances = inverse[:, 2, 2] + ((row @ covariance) * row).sum(axis=1)
        last: Array = 0.5 * (covariance[-3:, -3:] + covariance[-3:, -3:].T)
        return last, np.asarray(np.sqrt(np.maximum(variances, 0.0)), np.float64)


@dataclass(frozen=True, eq=False)
class Bundle:
    """The problem: what is believed beforehand, and how well pixels are known.

    Attributes:
        prior: of the first posture.
        noise: (2,) standard deviation of the slopes of a tracked pixel.
        huber: a pixel that misses by more sigma than this counts less.
    """

    prior: PoseGaussian
    noise: Array
    huber: float

    def cost(self, frames: Keyframes, rays: Rays) -> float:
        """Of an estimate: half the squared misses, less than that where they are large."""
        losses, _, _ = self._judge(see(frames, rays, self.noise), rays)
        return float(losses.sum()) + self._told(frames)

    def linearised(self, frames: Keyframes, rays: Rays) -> Normal:
        """Normal equations at an estimate."""
        sight = see(frames, rays, self.noise)
        by_posture, by_ray = sight.slopes(frames, rays, self.noise)
        k, n = len(frames.postures), len(rays.values)
        losses, trust, weights = self._judge(sight, rays)
        weights, misses = weights[..., None, None], sight.misses[..., None]
        information = trust[:, None] / rays.sigmas**2

        # (K, N, 2, 3) and (K, N, 2, 1) to one block a landmark: (N, 2K, ...).
        own, weighed, missed = (
            part.transpose(1, 0, 2, 3).reshape(n, 2 * k, -1) for part in (by_ray, by_ray * weights, misses)
        )
        v = weighed.transpose(0, 2, 1) @ own
        v[:, range(3), range(3)] += information
        gradients = (weighed * missed).sum(axis=1) + information * rays.off
        w = (by_ray * weights).transpose(1, 0, 3, 2) @ by_posture.transpose(1, 0, 2, 3)
        w = w.transpose(0, 2, 1, 3).reshape(n, 3, 3 * k)

        pulled = by_posture * weights
        blocks = pulled.reshape(k, 2 * n, 3).transpose(0, 2, 1) @ by_posture.reshape(k, 2 * n, 3)
        u = np.zeros((3 * k, 3 * k))
        for j in range(k):
            u[3 * j : 3 * j + 3, 3 * j : 3 * j + 3] = blocks[j]
        gradient = (pulled * misses).sum(axis=(1, 2)).reshape(-1)
        cost = float(losses.sum())
        for link in self._links(frames):
            at = slice(link.column, link.column + link.jacobian.shape[1])
            pull = link.jacobian.T @ link.information
            u[at, at] += pull @ link.jacobian
            gradient[at] += pull @ link.residual
            cost += link.cost
        last = np.where(sight.shown[-1], np.linalg.norm(sight.misses[-1], axis=-1), np.nan)
        return Normal(u, w, v, gradient, gradients, cost, last)

    def _judge(self, sight: Sight, rays: Rays) -> tuple[Array, Array, Array]:
        """How bad each landmark is (N,), how far it is believed (N,), and each of its sightings (K, N).

        One slipped pixel counts less by Huber's loss. A landmark that was matched wrongly is wrong in all
        images alike: beyond what chance makes of its misses altogether, they count by their logarithm.
        """
        length = np.linalg.norm(sight.misses, axis=-1)
        single = np.where(length <= self.huber, 0.5 * length**2, self.huber * (length - 0.5 * self.huber))
        behind = BEHIND * (sight.shown & ~sight.ahead)
        whole = (single + behind).sum(axis=0) + 0.5 * ((rays.off / rays.sigmas) ** 2).sum(axis=1)
        usual = USUAL_MISS * (sight.shown.sum(axis=0) + 2.0)
        excess = np.maximum(whole / usual, 1.0)
        losses = np.where(excess > 1.0, usual * (1.0 + np.log(excess)), whole)
        trust = 1.0 / excess
        weights = np.where(sight.ahead, np.minimum(1.0, self.huber / np.maximum(length, 1e-9)), 0.0)
        return losses, trust, weights * trust

    def _told(self, frames: Keyframes) -> float:
        """What prior and wheels cost."""
        return sum(link.cost for link in self._links(frames))

    def _links(self, frames: Keyframes) -> Iterator[Link]:
        """The prior, and the ways between postures."""
        off = frames.postures[0] - self.prior.mean.vector
        off[2] = wrap_angle(float(off[2]))
        turn = np.eye(3)
        turn[:2, :2] = self.prior.mean.rotation.T
        yield Link(turn @ off, turn, _inverse(self.prior.covariance), 0)
        for j, step in enumerate(frames.steps):
            yield _between(frames.postures[j], frames.postures[j + 1], step, 3 * j)


def _between(before: Array, after: Array, step: PoseGaussian, column: int) -> Link:
    """What the wheels measured from one posture to the next; their covariance is in the axes at the end."""
    back = Pose2.from_vector(before).rotation.T
    way = back @ (after - before)[:2]
    residual = np.append(way, after[2] - before[2]) - step.mean.vector
    residual[2] = wrap_angle(float(residual[2]))
    jacobian = np.zeros((3, 6))
    jacobian[:2, :2], jacobian[:2, 3:5] = -back, back
    jacobian[:2, 2] = way[1], -way[0]
    jacobian[2, 2], jacobian[2, 5] = -1.0, 1.0
    end = np.eye(3)
    end[:2, :2] = step.mean.rotation
    return Link(residual, jacobian, _inverse(end @ step.covariance @ end.T), column)


def _inverse(covariance: NDArray[np.float64]) -> Array:
    return np.asarray(np.linalg.inv(covariance + 1e-12 * np.eye(3)), np.float64)

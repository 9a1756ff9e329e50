"""Everything seen on a way as one least squares problem: normal equations with the landmarks eliminated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agent.homing.keyframes import Keyframes
from agent.homing.rays import Rays
from agent.homing.sight import BEHIND, Sight, see
from hybridmap.pose import Array, PoseGaussian

USUAL_MISS = 3.0
"""Half squared misses of a landmark, for each image of it, that chance hardly exceeds: 1 is expected."""


@dataclass(frozen=True, eq=False)
class Chain:
    """What the prior says of the first posture, and the wheels of each and the one before it.

    Attributes:
        residuals: (K, 3) m, m, rad; of the prior first.
        by_before: (K, 3, 3) by the posture before; 0 for the prior.
        by_after: (K, 3, 3) by the posture itself.
        information: (K, 3, 3) inverse covariances of the residuals.
    """

    residuals: Array
    by_before: Array
    by_after: Array
    information: Array

    @staticmethod
    def of(frames: Keyframes, prior: PoseGaussian) -> Chain:
        """Between the postures of a way; a step's covariance is in the axes at its end."""
        means = np.array([prior.mean.vector, *(step.mean.vector for step in frames.steps)])
        covariances = np.array([prior.covariance, *(step.covariance for step in frames.steps)])
        before = np.vstack([np.zeros(3), frames.postures[:-1]])
        back = _turns(-before[:, 2])
        ways = (back @ (frames.postures - before)[:, :, None])[:, :, 0]
        residuals = ways - means
        residuals[:, 2] = np.remainder(residuals[:, 2] + np.pi, 2.0 * np.pi) - np.pi
        by_before = -back
        by_before[:, 0, 2], by_before[:, 1, 2] = ways[:, 1], -ways[:, 0]
        by_before[0] = 0.0
        end = _turns(means[:, 2])
        spread = end @ covariances @ end.transpose(0, 2, 1) + 1e-12 * np.eye(3)
        return Chain(residuals, by_before, back, np.asarray(np.linalg.inv(spread), np.float64))

    @property
    def cost(self) -> float:
        """Half the squared misses."""
        return 0.5 * float((self.residuals * self._pulls).sum())

    @property
    def _pulls(self) -> Array:
        return (self.information @ self.residuals[:, :, None])[:, :, 0]

    def add_to(self, u: Array, gradient: Array) -> None:
        """Add normal equations to (3K, 3K) and (3K,) of the postures."""
        pulls = self._pulls
        for j, (before, after, information) in enumerate(
            zip(self.by_before, self.by_after, self.information, strict=True)
        ):
            first = max(3 * j - 3, 0)
            at = slice(first, 3 * j + 3)
            jacobian = np.hstack([before, after]) if j else after
            u[at, at] += jacobian.T @ information @ jacobian
            gradient[at] += jacobian.T @ pulls[j]


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
        return float(losses.sum()) + Chain.of(frames, self.prior).cost

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
        chain = Chain.of(frames, self.prior)
        chain.add_to(u, gradient)
        cost = float(losses.sum()) + chain.cost
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


def _turns(angles: Array) -> Array:
    """(K, 3, 3) rotations of planar postures by (K,) rad."""
    turns = np.zeros((len(angles), 3, 3))
    turns[:, 0, 0] = turns[:, 1, 1] = np.cos(angles)
    turns[:, 1, 0] = np.sin(angles)
    turns[:, 0, 1] = -turns[:, 1, 0]
    turns[:, 2, 2] = 1.0
    return turns

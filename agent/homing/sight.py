"""What postures of a way should see of landmarks, and how that changes with either."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.homing.keyframes import Keyframes
from agent.homing.rays import NEAREST, Rays
from hybridmap.pose import Array

BEHIND = 20.0
"""Cost of a landmark that an estimate puts behind the camera that sees it: much, but not without end."""


@dataclass(frozen=True, eq=False)
class Sight:
    """K images of N landmarks, as an estimate has them.

    Attributes:
        misses: (K, N, 2) standard deviations by which the slopes miss what the images show; 0 if not `ahead`.
        left: (K, N) Y of the landmark over its depth at the place.
        depth: (K, N) X likewise; 1 if not `ahead`.
        expected: (K, N, 2) the slopes Y / X and Z / X.
        ahead: (K, N) shown, and where it can be seen.
        shown: (K, N) whether the image shows the landmark.
    """

    misses: Array
    left: Array
    depth: Array
    expected: Array
    ahead: NDArray[np.bool_]
    shown: NDArray[np.bool_]

    def slopes(self, frames: Keyframes, rays: Rays, noise: Array) -> tuple[Array, Array]:
        """(K, N, 2, 3) derivatives of the misses by the postures, and by the rays (a, b, r)."""
        r = rays.values[:, 2]
        c, s, tx, ty = rays.offsets(frames)
        zero = np.zeros_like(self.depth)
        d_depth = np.stack([-r * c, -r * s, self.left], axis=-1)
        d_left = np.stack([r * s, -r * c, -self.depth - r * rays.mounts[1]], axis=-1)
        by_posture = self._quotients(d_left, np.zeros_like(d_left), d_depth)
        d_depth = np.stack([s + zero, zero, -c * tx - s * ty + zero], axis=-1)
        d_left = np.stack([c + zero, zero, s * tx - c * ty + zero], axis=-1)
        d_up = np.stack([zero, zero + 1.0, zero + rays.rise], axis=-1)
        by_ray = self._quotients(d_left, d_up, d_depth)
        return by_posture / noise[:, None], by_ray / noise[:, None]

    def _quotients(self, d_left: Array, d_up: Array, d_depth: Array) -> Array:
        """Derivatives of Y / X and Z / X by those of Y, Z and X."""
        u, v = self.expected[..., 0, None], self.expected[..., 1, None]
        quotients: Array = np.stack([d_left - u * d_depth, d_up - v * d_depth], axis=-2)
        return quotients / self.depth[..., None, None]


def see(frames: Keyframes, rays: Rays, noise: Array) -> Sight:
    """Project all rays into all images.

    Args:
        frames: postures and images.
        rays: landmarks.
        noise: (2,) standard deviation of a slope.
    """
    a, b, r = rays.values.T
    c, s, tx, ty = rays.offsets(frames)
    along, aside = 1.0 - r * tx, a - r * ty
    depth, left = c * along + s * aside, -s * along + c * aside
    shown = np.isfinite(frames.slopes[..., 0])
    ahead = shown & (depth > NEAREST)
    depth = np.where(ahead, depth, 1.0)
    expected = np.stack([left, np.broadcast_to(b + r * rays.rise, left.shape)], axis=-1) / depth[..., None]
    misses = np.where(ahead[..., None], (expected - frames.slopes) / noise, 0.0)
    return Sight(misses, left, depth, expected, ahead, shown)

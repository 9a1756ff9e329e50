"""Random starts of the localization filter: landmarks as a map has them, a posture nearly unknown."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from agent.ekf.localization import LocalizationFilter
from agent.observation import Odometry
from benchmarks.ekf_run import AXLE, CAMERA, TICK, WHEEL_NOISE
from hybridmap.pose import Pose2, PoseGaussian

_PIXEL = 0.7
_NEAR, _TURNED = 0.10, math.radians(3.0)
"""m and rad: a start has converged when the posture stays nearer to the truth than this."""


@dataclass(frozen=True)
class Start:
    """What became of one start.

    Attributes:
        converged: whether the posture was near the truth from the twentieth step on.
        nees: squared Mahalanobis distance of the true posture at the end, 3 degrees of freedom.
        map_before: RMS error of the landmarks in the node as the map had them, m.
        map_after: and as the drive left them, m.
    """

    converged: bool
    nees: float
    map_before: float
    map_after: float


def try_start(rng: np.random.Generator, steps: int = 100) -> Start:
    """Drive `steps` ticks from a prior that is 1 m and 1 rad wrong (standard deviations)."""
    count = int(rng.integers(8, 31))
    depths = rng.uniform(1.5, 5.0, count)
    pixels = np.column_stack([rng.uniform(20, 300, count), rng.uniform(20, 220, count)])
    points = CAMERA.back_project(pixels, depths)
    mapped_pixels = pixels + _PIXEL * rng.normal(size=pixels.shape)
    # A map's errors are of inverse depth, as parallax makes them; it tells them as sigmas of the depth.
    share = rng.uniform(0.01, 0.08, count)
    mapped_depths = depths / (1 + share * rng.normal(size=count))
    sigmas = share * mapped_depths**2 / depths
    mapped = CAMERA.back_project(mapped_pixels, mapped_depths)
    ray = np.column_stack(
        [np.ones(count), (mapped[:, 1:] - (0.0, CAMERA.mount_height)) / mapped_depths[:, None]]
    )
    covariances = np.einsum("ni,nj,n->nij", ray, ray, sigmas**2)
    covariances[:, [1, 2], [1, 2]] += (_PIXEL * mapped_depths / CAMERA.fx)[:, None] ** 2
    while True:
        true = Pose2(*(rng.normal(size=3) * (0.5, 0.3, 0.25)))
        if CAMERA.contains(CAMERA.project(true.inverse().apply(points))).sum() >= 6:
            break
    wrong = rng.normal(size=3) * (1 / np.sqrt(2), 1 / np.sqrt(2), 1.0)
    prior = PoseGaussian.from_sigmas(true @ Pose2.from_vector(wrong), 1 / np.sqrt(2), 1.0)
    ids = np.arange(count)
    filter_ = LocalizationFilter(CAMERA, AXLE, WHEEL_NOISE, prior, ids, mapped, covariances)
    converged = True
    phase = rng.uniform(0, 2 * np.pi)
    for k in range(steps):
        odometry = Odometry(0.2 * TICK * np.sin(TICK * k + phase), 0.12 * TICK * np.cos(0.8 * TICK * k))
        ways = odometry.forward + 0.5 * AXLE * odometry.turn * np.array([1.0, -1.0])
        right, left = ways * (1 + WHEEL_NOISE * rng.normal(size=2))
        true = true @ Odometry(0.5 * (right + left), (right - left) / AXLE).motion()
        exact = CAMERA.project(true.inverse().apply(points))
        seen = exact + _PIXEL * rng.normal(size=exact.shape)
        seen[~CAMERA.contains(exact)] = np.nan
        filter_.predict(odometry)
        filter_.update(ids, seen)
        if k >= 19:
            off = filter_.pose.mean.inverse() @ true
            converged &= np.hypot(off.x, off.y) < _NEAR and abs(off.heading) < _TURNED
    known = filter_.landmarks_in_node()
    return Start(
        bool(converged),
        filter_.pose.mahalanobis2(true),
        float(np.sqrt(np.square(mapped - points).sum(axis=1).mean())),
        float(np.sqrt(np.square(known.points - points[known.ids]).sum(axis=1).mean())),
    )

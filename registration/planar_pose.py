"""Pose of a planar robot from an image of known points: three degrees of freedom, robust.

Static localization of the paper's section 6 (least squares on n >= 4 known points), made robust: many
poses are solved at once from two or three sightings each, scored by likelihood, and the best refined.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.registration.gauss_newton import GAUSS_NEWTON_STEPS, PlanarFix, improve, refine, stack_sightings
from mapweave.registration.minimal_poses import hypotheses
from mapweave.registration.planar_ambiguity import mirrored
from mapweave.registration.projection import Stack
from mapweave.registration.sightings import Sightings

PREVIEW = 20
"""Sightings, about, on which all hypotheses are scored before the best fifth is scored on all."""


@dataclass(frozen=True)
class PlanarPoseSettings:
    """How a pose is found.

    Attributes:
        pixel_sigma: standard deviation of a matched pixel, px. A SIFT feature found again at another scale
            is off by about one pixel.
        scale_sigma: share by which all points of one frame may be too near or too far together; they come
            from one drive with one set of wheels, so their errors are not independent.
        least_inliers: fewer give no pose.
    """

    pixel_sigma: float = 1.0
    scale_sigma: float = 0.01
    least_inliers: int = 4


def solve_planar_pose(
    points: NDArray[Any],
    pixels: NDArray[Any],
    camera: Camera,
    *,
    rng: np.random.Generator,
    point_covariances: NDArray[Any] | None = None,
    settings: PlanarPoseSettings | None = None,
) -> PlanarFix | None:
    """Estimate the robot's pose from matches of which some may be wrong.

    Args:
        points: (N, 3) m, in the node's robot frame; rows that are not finite are never inliers.
        pixels: (N, 2) px, where the robot sees them.
        camera: the robot's.
        rng: for the hypotheses.
        point_covariances: (N, 3, 3) m^2; exact points without.
        settings: how.

    Returns:
        The pose, or None if the sightings do not determine one.
    """
    s = settings or PlanarPoseSettings()
    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    pixels = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
    usable = np.isfinite(points).all(axis=1) & np.isfinite(pixels).all(axis=1)
    if point_covariances is not None:
        usable &= np.isfinite(np.asarray(point_covariances)).all(axis=(1, 2))
        point_covariances = np.asarray(point_covariances)[usable]
    sightings = Sightings.build(
        points[usable],
        pixels[usable],
        camera,
        covariances=point_covariances,
        pixel_sigma=s.pixel_sigma,
    )
    solved = solve_sightings([sightings], rng=rng, settings=s)
    if solved is None:
        return None
    inliers = np.zeros(len(points), dtype=bool)
    inliers[np.flatnonzero(usable)[solved.inliers]] = True
    return replace(solved, inliers=inliers)


HYPOTHESES = 100
"""Poses tried from three bearings, and as many from two points with depth."""
FINALISTS = 2
"""Best hypotheses that are refined."""


def solve_sightings(
    parts: Sequence[Sightings],
    *,
    rng: np.random.Generator,
    settings: PlanarPoseSettings,
) -> PlanarFix | None:
    """The same for sightings in either direction; `inliers` is over the concatenated parts."""
    parts = [part for part in parts if len(part)]
    total = sum(len(part) for part in parts)
    if total < settings.least_inliers:
        return None
    counts = [-(-HYPOTHESES * len(part) // total) for part in parts]
    poses = np.concatenate([hypotheses(part, n, rng) for part, n in zip(parts, counts, strict=True)])
    if len(poses) == 0:
        return None
    stack = stack_sightings(parts)
    if total > 2 * PREVIEW:
        # Most hypotheses are wrong, and a part of the sightings is enough to reject them.
        few = [part.take(slice(None, None, total // PREVIEW)) for part in parts]
        poses = poses[np.argsort(-_scores(few, poses), kind="stable")[: max(len(poses) // 5, 10)]]
    finalists = np.argsort(-_scores(parts, poses), kind="stable")[:FINALISTS]
    improved = [improve(stack, Pose2.from_vector(poses[k]), rounds=2) for k in finalists]
    kept = [candidate[0] for candidate in improved if candidate is not None]
    if not kept:
        return None
    best = kept[int(_scores(parts, np.stack([pose.vector for pose in kept])).argmax())]
    fix = refine(stack, best, settings.scale_sigma)
    if fix is None or int(fix.inliers.sum()) < settings.least_inliers:
        return None
    return _weighed(fix, parts, stack, settings)


APART = 0.3
"""Two poses nearer to each other than this are the same, m."""


def _weighed(
    fix: PlanarFix,
    parts: Sequence[Sightings],
    stack: Stack,
    s: PlanarPoseSettings,
) -> PlanarFix:
    """The better of a pose and its mirror image, with the score of the other."""
    inliers = fix.inliers & ~stack.inverted
    if int(inliers.sum()) < s.least_inliers:
        return fix
    mean = fix.node_from_robot.mean
    mirror = improve(stack, mirrored(mean, stack.points[inliers, :2]), rounds=GAUSS_NEWTON_STEPS)
    if mirror is None or mirror[0].distance(mean) < APART:
        return fix
    score, mirror_score = _scores(parts, np.stack([mean.vector, mirror[0].vector])).tolist()
    if mirror_score <= score:
        return replace(fix, rival=max(mirror_score, 0.0) / score if score > 0.0 else 1.0)
    better = refine(stack, mirror[0], s.scale_sigma)
    if better is None or int(better.inliers.sum()) < s.least_inliers:
        return replace(fix, rival=1.0)
    return replace(better, rival=max(score, 0.0) / mirror_score)


def _scores(parts: Sequence[Sightings], poses: Array) -> Array:
    """(H,) nats: log likelihood ratio of each of the (H, 3) poses against chance."""
    scores = np.zeros(len(poses))
    for part in parts:
        scores += part.log_ratios(poses).sum(axis=1)
    return scores

"""Pose of a planar robot from an image of known points: three degrees of freedom, robust.

Static localization of the paper's section 6 (least squares on n >= 4 known points), made robust: many
poses are solved at once from two or three sightings each, scored by likelihood, and the best refined.

Two cameras never look equally far up. By how much they differ is estimated with the pose, as a nuisance
parameter with a Gaussian prior, if a setting says how much it may be.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
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
        pitch_sigma: by which the one camera may look further up than the other, rad.
        least_inliers: fewer give no pose.
    """

    pixel_sigma: float = 1.0
    scale_sigma: float = 0.01
    pitch_sigma: float = 0.0
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
    sigma = settings.pitch_sigma
    stack = stack_sightings(parts, sigma)
    if total > 2 * PREVIEW:
        # Most hypotheses are wrong, and a part of the sightings is enough to reject them.
        few = [part.take(slice(None, None, total // PREVIEW)) for part in parts]
        poses = poses[np.argsort(-_scores(few, poses, sigma), kind="stable")[: max(len(poses) // 5, 10)]]
    finalists = np.argsort(-_scores(parts, poses, sigma), kind="stable")[:FINALISTS]
    kept = [state for k in finalists if (state := _improved(stack, poses[k])) is not None]
    if not kept:
        return None
    best = max(kept, key=lambda state: _score(parts, state, sigma))
    fix = refine(stack, best, settings.scale_sigma)
    if fix is None or int(fix.inliers.sum()) < settings.least_inliers:
        return None
    return _weighed(fix, parts, stack, settings)


def _improved(stack: Stack, pose: Array) -> Array | None:
    """Pose and pitch (4,) after some steps from a pose (3,); None if the inliers do not determine one.

    Before the first step nothing is known of the pitch: it may put all right matches outside their gates. So
    that step takes it for noise as well.
    """
    state = np.append(pose, 0.0)
    if stack.pitch_sigma:
        first = improve(_with_pitch_as_noise(stack), state, rounds=1)
        if first is None:
            return None
        state = first[0]
    improved = improve(stack, state, rounds=2)
    return None if improved is None else improved[0]


def _with_pitch_as_noise(stack: Stack) -> Stack:
    """The same pixels, each as uncertain as an unknown pitch makes it."""
    focal, centre = stack.optics[:, :2], stack.optics[:, 2:4]
    a, b = ((centre - stack.observed[:, :2]) / focal).T
    noise = stack.noise.copy()
    noise[:, :2] += (stack.pitch_sigma * focal * np.column_stack([a * b, 1.0 + b**2])) ** 2
    return stack._replace(noise=noise)


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
    mean, pitch = fix.node_from_robot.mean, fix.pitch / s.pitch_sigma if s.pitch_sigma else 0.0
    start = mirrored(mean, stack.points[inliers, :2])
    mirror = improve(stack, np.append(start.vector, pitch), rounds=GAUSS_NEWTON_STEPS)
    if mirror is None or Pose2.from_vector(mirror[0][:3]).distance(mean) < APART:
        return fix
    states = np.append(mean.vector, pitch), mirror[0]
    score, mirror_score = (_score(parts, state, s.pitch_sigma) for state in states)
    if mirror_score <= score:
        share = max(mirror_score, 0.0) / score if score > 0.0 else 1.0
        return _or_mirrored(fix, mirror[0], score - mirror_score, share)
    better = refine(stack, mirror[0], s.scale_sigma)
    if better is None or int(better.inliers.sum()) < s.least_inliers:
        return _or_mirrored(fix, mirror[0], 0.0, 1.0)
    return _or_mirrored(better, states[0], mirror_score - score, max(score, 0.0) / mirror_score)


def _or_mirrored(fix: PlanarFix, other: Array, lead: float, rival: float) -> PlanarFix:
    """A pose, as uncertain as it is if another one may be the true one.

    That is so with the probability that their log likelihood ratios leave it; the covariance is the second
    moment of both about the better one.

    Args:
        fix: the better pose.
        other: (4,) the other pose and its pitch.
        lead: by how many nats the first is likelier.
        rival: see PlanarFix.
    """
    pose = fix.node_from_robot
    off = (pose.mean.inverse() @ Pose2.from_vector(other[:3])).vector
    spread = np.outer(off, off) / (1.0 + math.exp(min(lead, 500.0)))
    pose = PoseGaussian(pose.mean, pose.covariance + spread)
    distance = math.hypot(off[0], off[1])
    return replace(fix, node_from_robot=pose, rival=rival, rival_distance=distance, spread=spread)


def _score(parts: Sequence[Sightings], state: Array, pitch_sigma: float) -> float:
    """Nats: log likelihood ratio of a pose and a pitch (4,) against chance, with the pitch's prior."""
    levelled = [part.levelled(pitch_sigma * float(state[3])) for part in parts]
    return float(_scores(levelled, state[None, :3])[0] - 0.5 * state[3] ** 2)


def _scores(parts: Sequence[Sightings], poses: Array, pitch_sigma: float = 0.0) -> Array:
    """(H,) nats: log likelihood ratio of each of the (H, 3) poses against chance, whatever the pitch is."""
    scores = np.zeros(len(poses))
    for part in parts:
        scores += part.log_ratios(poses, pitch_sigma).sum(axis=1)
    return scores

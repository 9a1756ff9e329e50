"""Is this image of that place, and where was it taken: matches, then geometry, then an honest verdict.

What the geometry can rule out is chance: a wrong match hits the small gate around a point's projection about
once in three hundred times, so a handful of inliers more than the pose needs is no accident. What it
cannot rule out is another place with the same things in it. So a recognition also has to explain a good share
of the features that matched at all, all over the image, and determine the pose; and its numbers are kept
as evidence for those who can compare places (merge, mapweave.mapserver.relocalization.relocalizer).
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.node import Landmarks, Node
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from mapweave.hybridmap.query import View
from mapweave.registration.evidence import GRID, depth_agreement, gather
from mapweave.registration.gauss_newton import by_scales as scales_of
from mapweave.registration.gauss_newton import stack_sightings
from mapweave.registration.matching import MatchSettings, match
from mapweave.registration.planar_pose import PlanarPoseSettings, solve_sightings
from mapweave.registration.sightings import Sightings

PITCH_SIGMA = 0.01
"""rad, by which one camera of a fleet looks further up than another. Calibration takes 0.01 for what does not
show in a map (agent/calibration/parameter_sigmas.py), and no robot corrects what is less."""


@dataclass(frozen=True)
class RecognitionSettings:
    """When an image counts as recognised.

    Attributes:
        matching: how features are matched.
        pose: how the pose is found.
        least_inliers: landmarks that agree.
        least_cells: cells of the 6 x 4 grid with an inlier, in either image.
        least_seen: of the landmarks that should be in the image by the pose found, on the side where it
            is more. A poster that hangs in two rooms explains few of what else should be there.
        most_rival: what the pose mirrored in what is seen may explain, as a share of what the best does:
            a flat thing from afar looks almost the same from two sides.
    """

    matching: MatchSettings = field(default_factory=MatchSettings)
    pose: PlanarPoseSettings = field(default_factory=lambda: PlanarPoseSettings(pitch_sigma=PITCH_SIGMA))
    least_inliers: int = 10
    least_cells: int = 5
    least_seen: float = 0.12
    most_rival: float = 0.8


@dataclass(frozen=True, eq=False)
class Recognition:
    """A place was recognised.

    Attributes:
        node_from_robot: pose of the robot that took the view, in the node's robot frame. For two nodes
            a and b this is `a_from_b`.
        pairs: (K, 2) int64, inliers: landmark of the node (a), feature of the view (landmark of b).
        matches: mutual matches, with or without depth.
        usable: matches with a depth on either side, which could have been inliers.
        evidence: the numbers that support it, for an edge's `evidence`.
        pitch: by which the view's camera looks further up than the node's, rad.
        spread: (3, 3) part of the pose's covariance, see PlanarFix.
    """

    node_from_robot: PoseGaussian
    pairs: NDArray[np.int64]
    matches: int
    usable: int
    evidence: dict[str, float]
    pitch: float = 0.0
    spread: Array = field(default_factory=lambda: np.zeros((3, 3)))

    @property
    def inliers(self) -> int:
        """How many landmarks agree."""
        return len(self.pairs)


@dataclass(frozen=True, eq=False)
class RecognitionFailure:
    """A place was not recognised.

    Attributes:
        reason: in words.
        matches: mutual matches.
        pairs: (K, 2) int64, landmarks that agree on the best pose; none without one.
        node_from_robot: the best pose, which was not good enough; None if nothing agrees on any.
        evidence: the numbers by which it was refused; empty without a pose.
    """

    reason: str
    matches: int
    pairs: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    node_from_robot: PoseGaussian | None = None
    evidence: dict[str, float] = field(default_factory=dict)

    @property
    def inliers(self) -> int:
        """How many landmarks agree."""
        return len(self.pairs)


def recognise(
    node: Node, view: View, settings: RecognitionSettings | None, rng: np.random.Generator
) -> Recognition | None:
    """Pose of a view with respect to a node, or None; `examine_view` gives the reason."""
    verdict = examine_view(node, view, settings, rng)
    return verdict if isinstance(verdict, Recognition) else None


def register(
    a: Node, b: Node, settings: RecognitionSettings | None, rng: np.random.Generator
) -> Recognition | None:
    """`a_from_b` from the common landmarks of two nodes, or None; `examine_nodes` gives the reason."""
    verdict = examine_nodes(a, b, settings, rng)
    return verdict if isinstance(verdict, Recognition) else None


def examine_view(
    node: Node, view: View, settings: RecognitionSettings | None, rng: np.random.Generator
) -> Recognition | RecognitionFailure:
    """Compare a view with a node's landmarks that have a depth.

    Args:
        node: the place.
        view: the image's features.
        settings: when an image counts as recognised; None for the defaults.
        rng: for the hypotheses.

    Returns:
        A recognition, or why there is none.
    """
    s = settings or RecognitionSettings()
    return examine_matches(node, view, match(node.landmarks.codes, view.codes, s.matching), s, rng)


def examine_matches(
    node: Node,
    view: View,
    pairs: NDArray[np.int64],
    settings: RecognitionSettings | None,
    rng: np.random.Generator,
) -> Recognition | RecognitionFailure:
    """The same for features that are matched already.

    Args:
        node: the place.
        view: the image's features.
        pairs: (K, 2), landmark of the node and feature of the view; no index twice in a column.
        settings: when an image counts as recognised; None for the defaults.
        rng: for the hypotheses.

    Returns:
        A recognition, or why there is none.
    """
    unknown = np.full(len(view), np.nan, np.float32)
    seen = Landmarks(view.pixels, view.codes, unknown, unknown)
    s = settings or RecognitionSettings()
    return _examine(node.landmarks, node.camera, seen, view.camera, pairs, s, rng)


def examine_nodes(
    a: Node, b: Node, settings: RecognitionSettings | None, rng: np.random.Generator
) -> Recognition | RecognitionFailure:
    """Compare two nodes, with the landmarks' depths on both sides, in one joint estimate.

    Where a's landmark has a depth, its point must project on b's pixel and, if b has a depth too, lie at that
    depth; where only b's has, its point must project on a's pixel.

    Args:
        a: one place.
        b: the other.
        settings: when two nodes count as the same place; None for the defaults.
        rng: for the hypotheses.

    Returns:
        A recognition whose `node_from_robot` is `a_from_b`, or why there is none.
    """
    s = settings or RecognitionSettings()
    pairs = match(a.landmarks.codes, b.landmarks.codes, s.matching)
    return _examine(a.landmarks, a.camera, b.landmarks, b.camera, pairs, s, rng)


def _examine(
    a: Landmarks,
    camera_a: Camera,
    b: Landmarks,
    camera_b: Camera,
    pairs: NDArray[np.int64],
    s: RecognitionSettings,
    rng: np.random.Generator,
) -> Recognition | RecognitionFailure:
    forward = a.has_depth[pairs[:, 0]]
    backward = ~forward & b.has_depth[pairs[:, 1]]
    usable = np.concatenate([pairs[forward], pairs[backward]])
    if len(usable) < s.least_inliers:
        many = "1 feature matches" if len(pairs) == 1 else f"{len(pairs)} features match"
        words = f"{many}, {len(usable)} with a depth; {s.least_inliers} are needed"
        return RecognitionFailure(words, len(pairs))
    # A view has no depths that could contradict the scale of the node's: then it is not part of each of them.
    measured = bool(b.has_depth.any())
    scale_share = 0.0 if measured else a.scale_share
    sightings = [
        _sightings(a, camera_a, b, camera_b, pairs[forward], s, False, scale_share),
        _sightings(b, camera_b, a, camera_a, pairs[backward][:, ::-1], s, True, 0.0),
    ]
    fix = solve_sightings(sightings, rng=rng, settings=s.pose)
    if fix is None:
        return RecognitionFailure(f"{len(usable)} matches agree on no pose", len(pairs))
    inliers = usable[fix.inliers]
    evidence = gather(a, camera_a, b, camera_b, inliers, len(pairs), len(usable), fix)
    evidence["depths"] = depth_agreement(sightings[0], fix)
    within = fix.rival_distance <= NEAR_RIVAL * evidence["depth"]
    evidence["rival"] = 0.0 if within else fix.rival
    reason = _objection(evidence, s)
    if reason:
        return RecognitionFailure(reason, len(pairs), inliers, fix.node_from_robot, evidence)
    unknown = min(a.scale_share, b.scale_share) if measured else a.scale_share
    pose = of_unknown_scale(fix.node_from_robot, unknown, camera_a, camera_b)
    return Recognition(pose, inliers, len(pairs), len(usable), evidence, fix.pitch, fix.spread)


def by_scales(a: Node, b: Node, pairs: NDArray[np.int64], a_from_b: Pose2) -> Array | None:
    """How the pose of two nodes that was found changes with the scales of the lengths of either.

    Where both have depths and one's are longer, the pose is a compromise: a little back along the view.

    Args:
        a: one place.
        b: the other.
        pairs: (K, 2) landmarks of a and b that agree.
        a_from_b: the pose that was found.

    Returns:
        (3, 2) right perturbation of `a_from_b`, m, m, rad, by the natural logarithm of the scale of a, and
        of b. None without pairs that determine a pose, or where the nodes have not kept their landmarks.
    """
    s = RecognitionSettings()
    if len(pairs) < s.least_inliers or (pairs.max(axis=0) >= (len(a.landmarks), len(b.landmarks))).any():
        return None
    forward = a.landmarks.has_depth[pairs[:, 0]]
    sightings = [
        _sightings(a.landmarks, a.camera, b.landmarks, b.camera, pairs[forward], s, False, 0.0),
        _sightings(b.landmarks, b.camera, a.landmarks, a.camera, pairs[~forward][:, ::-1], s, True, 0.0),
    ]
    return scales_of(stack_sightings(sightings, s.pose.pitch_sigma), np.append(a_from_b.vector, 0.0))


def of_unknown_scale(pose: PoseGaussian, share: float, of_node: Camera, of_view: Camera) -> PoseGaussian:
    """A pose that may be too far away, or too near, by a share of the way between the two cameras.

    Args:
        pose: node_from_robot.
        share: Landmarks.scale_share.
        of_node: camera that took the node.
        of_view: the robot's.
    """
    if not share:
        return pose
    camera = (pose.mean @ Pose2(of_view.mount_forward)).vector[:2] - [of_node.mount_forward, 0.0]
    change = np.append(share * (pose.mean.rotation.T @ camera), 0.0)
    return PoseGaussian(pose.mean, pose.covariance + np.outer(change, change))


def _sightings(
    landmarks: Landmarks,
    landmarks_camera: Camera,
    view: Landmarks,
    view_camera: Camera,
    pairs: NDArray[Any],
    s: RecognitionSettings,
    inverted: bool,
    scale_share: float,
) -> Sightings:
    """Points of the known side, pixels and depths of the seen side."""
    tilt_sigma = landmarks.tilt_sigma
    landmarks, view = landmarks.take(pairs[:, 0]), view.take(pairs[:, 1])
    return Sightings.build(
        landmarks.points_in_robot(landmarks_camera),
        view.pixels,
        view_camera,
        covariances=landmarks.covariances_in_robot(
            landmarks_camera, s.pose.pixel_sigma, scale_share, tilt_sigma
        ),
        pixel_sigma=s.pose.pixel_sigma,
        depths=view.depths,
        depth_sigmas=view.depth_sigmas,
        inverted=inverted,
    )


NEAR_RIVAL = 0.06
"""Share of the median depth of the inliers: a mirrored pose that is nearer is part of the uncertainty."""
LEAST_SHARE = 0.35
"""Share of the matches that could have been inliers which must be inliers."""
LEAST_DEPTHS = 0.5
"""Share of the landmarks that fit by their pixels and have a depth on both sides which must agree in depth
too."""


def _objection(evidence: dict[str, float], s: RecognitionSettings) -> str:
    """Why a pose is not good enough, in words; empty if it is."""
    e = evidence
    inliers = int(e["inliers"])
    if inliers < s.least_inliers:
        return f"{inliers} landmarks agree on a pose; {s.least_inliers} are needed"
    if e["share"] < LEAST_SHARE:
        return f"only {e['share']:.0%} of the matches agree on one pose"
    if e["cells"] < s.least_cells:
        return f"the {inliers} landmarks that agree lie in {int(e['cells'])} of {math.prod(GRID)} image cells"
    if e["seen"] < s.least_seen:
        return f"only {e['seen']:.0%} of the landmarks that should be in the image are"
    if e["depths"] < LEAST_DEPTHS:
        return f"only {e['depths']:.0%} of the landmarks that fit lie at the same depth"
    if e["rival"] > s.most_rival:
        return f"a pose on the other side of what is seen explains {e['rival']:.0%} as much"
    return ""

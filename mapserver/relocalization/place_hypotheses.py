"""Place hypotheses: places recognised in one view, their evidence, and averaged estimates."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Array, PoseGaussian
from mapweave.hybridmap.query import View
from mapweave.mapserver.relocalization.calibration import HypothesisSupport
from mapweave.registration.recognition import Recognition

ALONE = 18
"""Landmarks that must agree if one node speaks alone. Two nodes that say the same, found each by its own,
are much better evidence than one: parts of unlike places look alike."""
SLIGHT = 0.25
"""A place that explains less than this share of what the best one explains is no rival."""
THING_SIGMA = 0.35
"""Largest standard deviation of the landmarks on one thing, seen from above, m: of a table of 1.2 m."""
BESIDE = 0.35
"""What is farther from all landmarks on a thing is not of it, m."""
MISSING_BY_CHANCE = 0.05
"""Chance below which missing landmarks are evidence that the view is not of this place."""
HIDDEN_WIDTH, HIDDEN_AGREEING, HIDDEN_FEATURES = 0.4, 0.1, 3
"""A person before the camera hides at most this share of an image's width, from top to bottom: at most this
share of what agrees is seen there, and at least so many features of his own."""


@dataclass(frozen=True, eq=False)
class NodeMatch:
    """A node that was recognised in the view.

    Attributes:
        node: which.
        recognition: how.
        one_thing: it rests on one thing, and nothing is seen of what should be visible around that.
    """

    node: NodeId
    recognition: Recognition
    one_thing: bool = False


@dataclass(frozen=True, eq=False)
class PlaceHypothesis:
    """Recognitions that agree on one pose, best first.

    Attributes:
        matches: with nodes of one place.
        best_from_robot: pose in the first one's frame, combined.
        features: of the view that they explain together.
        nodes_around: of another place, whose aliases imply this one; 0 if it was recognised.
    """

    matches: list[NodeMatch]
    best_from_robot: PoseGaussian
    features: frozenset[int]
    nodes_around: int = 0

    @property
    def best(self) -> NodeMatch:
        """The recognition with most landmarks."""
        return self.matches[0]


def is_one_thing(node: Node, view: View, recognition: Recognition) -> bool:
    """Whether a recognition rests on one thing, and nothing is seen of what should be visible around it.

    A thing can be moved with all its landmarks. Then landmarks away from it, each with the same detection
    rate, are missing. Landmarks that one person may occlude do not count.
    """
    points = node.landmarks.points_in_robot(node.camera)
    agreeing = np.zeros(len(points), np.bool_)
    agreeing[recognition.pairs[:, 0]] = True
    on_it = points[agreeing & np.isfinite(points[:, 0])]
    if len(on_it) < 3 or extent(on_it) > THING_SIGMA:
        return False
    points_in_view = recognition.node_from_robot.mean.inverse().apply(points)
    pixels = view.camera.project(points_in_view)
    expected = view.camera.contains(pixels) & ~agreeing
    away = np.linalg.norm(points[expected][:, None] - on_it[None], axis=2).min(axis=1) > BESIDE
    missing = pixels[expected][away]
    detection_rate = min(recognition.evidence["seen"], 0.9)
    count = len(missing) - hidden(missing[:, 0], view, recognition)
    return count * math.log(1.0 - detection_rate) < math.log(MISSING_BY_CHANCE)


def hidden(missing: Array, view: View, recognition: Recognition) -> int:
    """How many landmarks one person in the view may occlude, at most.

    Args:
        missing: (M,) px, how far to the right they should be seen.
        view: the image's features.
        recognition: that the view shows the place.
    """
    agreeing = np.zeros(len(view), np.bool_)
    agreeing[recognition.pairs[:, 1]] = True
    starts = missing[:, None]
    ends = starts + HIDDEN_WIDTH * view.camera.width

    def inside(across: Array) -> NDArray[np.int64]:
        return np.asarray(((across >= starts) & (across <= ends)).sum(axis=1), np.int64)

    own, outside = inside(view.pixels[agreeing, 0]), inside(view.pixels[~agreeing, 0])
    possible = (own <= HIDDEN_AGREEING * agreeing.sum()) & (outside >= HIDDEN_FEATURES)
    return int(inside(missing)[possible].max(initial=0))


def extent(points: Array) -> float:
    """m, largest standard deviation of (K, 3) points seen from above."""
    if len(points) < 2:
        return 0.0
    return math.sqrt(max(float(np.linalg.eigvalsh(np.cov(points[:, :2].T))[-1]), 0.0))


def supported(places: Sequence[PlaceHypothesis]) -> list[HypothesisSupport]:
    """Evidence for each of the places recognised in one view."""
    supports = []
    for place in places:
        recognition = place.best.recognition
        rival_features = max((len(rival.features) for rival in places if rival is not place), default=0)
        share, against = (
            recognition.inliers / max(recognition.usable, 1),
            rival_features / len(place.features),
        )
        supports.append(
            HypothesisSupport(
                recognition.inliers, share, recognition.evidence["seen"], len(place.matches), against
            )
        )
    return supports


def fuse(first: PoseGaussian, second: PoseGaussian) -> PoseGaussian:
    """Combine two estimates of one pose whose errors may have anything in common.

    Covariance intersection (Julier and Uhlmann 1997) with the weight that gives the smallest trace: the same
    view and often the same landmarks are behind both, so adding their information would count them twice.
    """
    difference = (first.mean.inverse() @ second.mean).vector
    information = [np.linalg.inv(pose.covariance + 1e-12 * np.eye(3)) for pose in (first, second)]
    best: tuple[float, float] = (math.inf, 0.0)
    for weight in np.linspace(0.0, 1.0, 11):
        together = np.linalg.inv((1 - weight) * information[0] + weight * information[1])
        best = min(best, (float(together.trace()), float(weight)))
    weight = best[1]
    covariance = np.linalg.inv((1 - weight) * information[0] + weight * information[1])
    step = covariance @ (weight * information[1] @ difference)
    mean = first.mean @ type(first.mean).from_vector(step)
    return PoseGaussian(mean, 0.5 * (covariance + covariance.T))

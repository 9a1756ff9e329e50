"""Is this image of that place, when the place's landmarks have no depths: matches and epipolar geometry.

Weaker than a recognition with depths: a wrong match lies near the line that its partner may lie on once in
thirty times, not once in three hundred. So it is asked only where a robot expects to be.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hybridmap.camera import Camera
from hybridmap.node import Landmarks, Node
from hybridmap.query import View
from hybridmap.recognising.bearings import BearingFix, BearingSettings, relate_all
from hybridmap.recognising.evidence import cells
from hybridmap.recognising.matching import MatchSettings, match


@dataclass(frozen=True)
class BearingRecognitionSettings:
    """When an image counts as recognised by bearings.

    Attributes:
        matching: how features are matched.
        bearings: how the posture is found.
        least_inliers: landmarks that agree.
        least_share: of the matches.
        least_cells: cells of the 6 x 4 grid with an inlier, in either image.
        least_evidence: how much likelier the inliers are than wrong matches, nats.
        most_share: a depth is usable if its sigma is below this share of it.
    """

    matching: MatchSettings = field(default_factory=MatchSettings)
    bearings: BearingSettings = field(default_factory=BearingSettings)
    least_inliers: int = 12
    least_share: float = 0.5
    least_cells: int = 4
    least_evidence: float = 20.0
    most_share: float = 0.3


@dataclass(frozen=True, eq=False)
class BearingRecognition:
    """A place was recognised by bearings alone.

    Attributes:
        fixes: where the view's camera was from the node's, up to scale, the likeliest first.
        pairs: (K, 2) int64, inliers of the first: landmark of the node, feature of the view.
        matches: mutual matches.
        evidence: nats by which they are likelier than chance.
    """

    fixes: tuple[BearingFix, ...]
    pairs: NDArray[np.int64]
    matches: int
    evidence: float

    @property
    def inliers(self) -> int:
        """How many landmarks agree."""
        return len(self.pairs)


def usable_depths(landmarks: Landmarks, most_share: float) -> int:
    """How many landmarks have a depth with a sigma below a share of it."""
    with np.errstate(invalid="ignore"):
        return int((landmarks.depth_sigmas < most_share * landmarks.depths).sum())


def recognise_bearings(
    node: Node, view: View, rng: np.random.Generator, settings: BearingRecognitionSettings | None = None
) -> BearingRecognition | None:
    """Find from where a view was taken, up to scale, by all of a node's landmarks, with depth or without.

    Args:
        node: the place; its camera stands at the height of the view's.
        view: the image's features.
        rng: draws samples.
        settings: when an image counts as recognised.

    Returns:
        A recognition, or None if the view does not show the place.
    """
    s = settings or BearingRecognitionSettings()
    pairs = match(node.landmarks.codes, view.codes, s.matching)
    if len(pairs) < s.least_inliers:
        return None
    here, there = node.landmarks.pixels[pairs[:, 0]], view.pixels[pairs[:, 1]]
    fixes = relate_all(here, node.camera, there, view.camera, rng, s.bearings)
    if not fixes:
        return None
    agreeing = fixes[0].inliers
    count = int(agreeing.sum())
    evidence = _evidence(count, len(pairs), view.camera, s.bearings)
    if count < s.least_inliers or count < s.least_share * len(pairs) or evidence < s.least_evidence:
        return None
    if min(cells(here[agreeing], node.camera), cells(there[agreeing], view.camera)) < s.least_cells:
        return None
    return BearingRecognition(tuple(fixes), pairs[agreeing], len(pairs), evidence)


def _evidence(inliers: int, matches: int, camera: Camera, s: BearingSettings) -> float:
    """Nats: Chernoff's bound on so many wrong matches near their lines, for every pair that was tried."""
    band = 2.0 * math.sqrt(2.0 * s.gate) * s.pixel_sigma
    chance, share = min(band / camera.height, 0.5), inliers / matches
    if share <= chance:
        return 0.0
    rest = (1.0 - share) * math.log((1.0 - share) / (1.0 - chance)) if share < 1.0 else 0.0
    return matches * (share * math.log(share / chance) + rest) - math.log(4.0 * s.samples)

"""Places by their looks alone: nodes whose landmarks have no depths, told from a view by epipolar geometry.

A place is recognised if enough matches lie near epipolar lines of one fundamental matrix, which leaves the
camera free in all six directions: a hand does not hold it level. What it then says of a robot, whose camera
stays level at one height, is the heading and the direction in which it stands from the node; how far away,
nobody can know. So such an answer is a place and no posture: `Certainty.PLACE`, `Whereabouts.distance_known`.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from hybridmap.camera import Camera
from hybridmap.node import Node, NodeId
from hybridmap.pose import Pose2, PoseGaussian, wrap_angle
from hybridmap.query import Certainty, RelocalizeAnswer, View, Whereabouts
from hybridmap.recognising.bearing_recognition import usable_depths
from hybridmap.recognising.bearings import BearingFix, BearingSettings, relate_all
from hybridmap.recognising.evidence import cells
from hybridmap.recognising.matching import MatchSettings, match
from mapserver.relocalizing.doubles import between
from mapserver.relocalizing.judgement import NOWHERE
from merge.graph.merged import MergedMap

Name = TypeVar("Name")

ANYWHERE = math.pi / math.sqrt(3.0)
"""Standard deviation of a direction of which nothing is known, rad."""


@dataclass(frozen=True)
class AppearanceSettings:
    """When a place is recognised by its looks.

    Attributes:
        matching: how features are matched.
        bearings: how heading and direction are found.
        gate_px: largest distance from an epipolar line.
        least_inliers: matches that agree.
        least_share: of all matches.
        least_cells: cells of the 6 x 4 grid with an inlier, in either image.
        least_evidence: how much likelier than chance, nats.
        as_good: with this share of the likeliest posture's inliers, another posture may be right as well.
        comparable: with this share of the best place's inliers, another one makes it ambiguous.
        together: nodes of one component nearer to each other than this are one place, m.
        most_share: a depth is usable if its sigma is below this share of it,
        most_depths: and with so many of them a node is recognised by depths or not at all.
        floor_heading: error of a heading that no covariance tells of, rad.
        reach: about how far away a place is recognised, m: what is told of the distance.
        trust: share of such answers that were right, of those that were measured.
    """

    matching: MatchSettings = field(default_factory=MatchSettings)
    bearings: BearingSettings = field(default_factory=BearingSettings)
    gate_px: float = 2.0
    least_inliers: int = 12
    least_share: float = 0.5
    least_cells: int = 4
    least_evidence: float = 20.0
    as_good: float = 0.8
    comparable: float = 0.6
    together: float = 3.0
    most_share: float = 0.3
    most_depths: int = 12
    floor_heading: float = 0.03
    reach: float = 1.0
    trust: float = 0.9


def agreeing(node: Node, view: View, settings: AppearanceSettings | None = None) -> NDArray[np.int64] | None:
    """Which landmarks of a node and features of a view agree on one fundamental matrix (OpenCV's RANSAC).

    Returns:
        (K, 2) pairs, or None if the view does not show the place.
    """
    s = settings or AppearanceSettings()
    pairs = match(node.landmarks.codes, view.codes, s.matching)
    if len(pairs) < s.least_inliers:
        return None
    here, there = node.landmarks.pixels[pairs[:, 0]], view.pixels[pairs[:, 1]]
    _, mask = cv2.findFundamentalMat(here, there, cv2.FM_RANSAC, s.gate_px, 0.999, 2000)
    inside = np.zeros(len(pairs), bool) if mask is None else mask[:, 0].astype(bool)
    count = int(inside.sum())
    if count < max(s.least_inliers, s.least_share * len(pairs)):
        return None
    if evidence(count, len(pairs), s.gate_px, view.camera.height) < s.least_evidence:
        return None
    if min(cells(here[inside], node.camera), cells(there[inside], view.camera)) < s.least_cells:
        return None
    found: NDArray[np.int64] = pairs[inside]
    return found


def evidence(
    inliers: int, matches: int, gate_px: float, height_px: int, used: int = 7, tries: int = 2000
) -> float:
    """Nats: Chernoff's bound on so many wrong matches near their lines, without those that made the lines."""
    inliers, matches = inliers - used, matches - used
    chance = 2.0 * gate_px / height_px
    if matches <= 0 or inliers <= chance * matches:
        return 0.0
    share = inliers / matches
    rest = (1.0 - share) * math.log((1.0 - share) / (1.0 - chance)) if share < 1.0 else 0.0
    return matches * (share * math.log(share / chance) + rest) - math.log(tries)


def rivals(
    inliers: Mapping[Name, int], together: Callable[[Name, Name], bool], comparable: float
) -> list[Name]:
    """The place with most inliers, and one node each of others that come into question as well."""
    order = sorted(inliers, key=lambda name: -inliers[name])
    found = order[:1]
    for name in order[1:]:
        enough = inliers[name] >= comparable * inliers[order[0]]
        if enough and not any(together(name, other) for other in found):
            found.append(name)
    return found


class Appearance:
    """Answers where a view was taken, from nodes without depths. It stands for one merged map."""

    def __init__(
        self,
        node_of: Callable[[NodeId], Node | None],
        merged: MergedMap,
        settings: AppearanceSettings | None = None,
    ) -> None:
        """Take what is known.

        Args:
            node_of: gives a node by its id.
            merged: where nodes are.
            settings: how.
        """
        self._node_of, self._merged = node_of, merged
        self._settings = settings or AppearanceSettings()

    def answer(self, view: View, ranked: Sequence[NodeId]) -> RelocalizeAnswer | None:
        """PLACE or AMBIGUOUS, or None if no node without depths is recognised.

        Args:
            view: the image's features.
            ranked: nodes that look like it.
        """
        s = self._settings
        seen: dict[NodeId, tuple[Node, NDArray[np.int64]]] = {}
        for node_id in ranked:
            node = self._node_of(node_id)
            if node is None or usable_depths(node.landmarks, s.most_share) >= s.most_depths:
                continue
            pairs = agreeing(node, view, s)
            if pairs is not None:
                seen[node_id] = node, pairs
        if not seen:
            return None
        inliers = {node_id: len(pairs) for node_id, (_, pairs) in seen.items()}
        places = rivals(inliers, self._together, s.comparable)
        candidates = tuple(self._whereabouts(*seen[place], view, len(places)) for place in places)
        words = f"{inliers[places[0]]} landmarks of {places[0]}, which has no depths, agree"
        if len(places) > 1:
            names = " or ".join(map(str, places))
            return RelocalizeAnswer(Certainty.AMBIGUOUS, candidates, f"it may be {names}: {words}")
        return RelocalizeAnswer(
            Certainty.PLACE, candidates, f"{words}: the place is known, the distance from there is not"
        )

    def _together(self, a: NodeId, b: NodeId) -> bool:
        mapped = between(self._merged, a, b)
        return mapped is not None and math.hypot(mapped.x, mapped.y) < self._settings.together

    def _whereabouts(self, node: Node, pairs: NDArray[np.int64], view: View, places: int) -> Whereabouts:
        s = self._settings
        here, there = node.landmarks.pixels[pairs[:, 0]], view.pixels[pairs[:, 1]]
        rng = np.random.default_rng(zlib.crc32(view.codes.tobytes(), zlib.crc32(str(node.id).encode())))
        fixes = relate_all(here, node.camera, there, view.camera, rng, s.bearings)
        # What a camera that is not level shows may agree on no posture in the plane.
        least = max((fix.inliers.sum() for fix in fixes), default=0) * s.as_good
        fixes = [fix for fix in fixes if fix.inliers.sum() >= max(least, s.least_share * len(pairs))]
        posture = _spread(fixes, node.camera, view.camera, s)
        placement = self._merged.postures.get(node.id)
        return Whereabouts(
            node.id,
            posture,
            None if placement is None else placement.merged_from_robot @ posture,
            NOWHERE if placement is None else placement.component,
            len(pairs),
            s.trust / places,
            distance_known=False,
        )


def _spread(
    fixes: Sequence[BearingFix], of_node: Camera, of_view: Camera, s: AppearanceSettings
) -> PoseGaussian:
    """`node_from_robot` with what is known of it, and wide where nothing is.

    Two views often leave two or three postures that explain them about as well: what is told holds for all.
    Along the direction the distance may be anything up to about twice the reach.
    """
    reach = s.reach
    spread = np.diag([reach**2, reach**2, ANYWHERE**2])
    away, direction, heading = 0.0, 0.0, 0.0
    if fixes:
        heading, variance = _among([fix.heading for fix in fixes], [fix.covariance[0, 0] for fix in fixes])
        spread[2, 2] = variance + s.floor_heading**2
        if all(fix.directed for fix in fixes):
            away = reach
            direction, variance = _among(
                [fix.direction for fix in fixes], [fix.covariance[1, 1] for fix in fixes]
            )
            cosine, sine = math.cos(direction - heading), math.sin(direction - heading)
            turned = np.array([[cosine, -sine], [sine, cosine]])
            # The covariance is in the robot's frame.
            spread[:2, :2] = turned @ np.diag([reach**2, reach**2 * min(variance, 1.0)]) @ turned.T
    robot = Pose2(away * math.cos(direction), away * math.sin(direction), heading)
    forward = Pose2(of_node.mount_forward, 0.0, 0.0)
    return PoseGaussian(forward @ robot @ Pose2(-of_view.mount_forward, 0.0, 0.0), spread)


def _among(angles: Sequence[float], variances: Sequence[float]) -> tuple[float, float]:
    """The middle of angles that may each be right, and a variance that reaches all of them, rad and rad^2."""
    off = [wrap_angle(angle - angles[0]) for angle in angles]
    middle, half = 0.5 * (max(off) + min(off)), 0.5 * (max(off) - min(off))
    return wrap_angle(angles[0] + middle), max(variances) + half**2

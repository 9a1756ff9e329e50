"""Views of one map that contradict its own way.

Nodes of one map that see the same landmarks give their relative pose by themselves. Of an honest map it is
that of its way, as the depths were measured along this very way, by one camera. Depths that are too long make
each such pose too far by the same share; other focal lengths, or depths that change from node to node, leave
most landmarks without any pose that they agree on.

What is off otherwise tells of something else: places that look alike, a way that slipped once.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian, wrap_angle
from mapweave.merge.pose_graph.verification import examine
from mapweave.registration.matching import match
from mapweave.registration.recognition import LEAST_SHARE, Recognition

SCALE = math.log(1.15)
"""By more than this the logarithm of a length is off. Of honest maps the median of neighbours is off by up to
0.01, in the simulator and on recordings with odometry."""
LEAST_LENGTH, MOST_SIGMA = 0.25, 0.085
"""Between two cameras, m, and its standard deviation as a share of it: of others the length tells nothing."""
GATE = 3.0
"""Standard deviations by which a length that contradicts is off, at least."""
LARGEST = math.log(3.0)
"""What is off by more is another place that looks the same."""
MOST_ASIDE, MOST_TURN = 0.25, math.radians(15.0)
"""Of a place where the way has it but for the length: aside as a share of the length, and in heading, rad."""
LEAST_MATCHES, REACH = 15, 4.0
"""Two nodes so near to each other, m, with so many landmarks that match: that they agree on no pose is no
accident."""
LEAST_CONTRADICTIONS, LEAST_AGAINST = 4, 0.5
"""Pairs of views that contradict the way, at least, and as a share of those that tell anything. Honest maps
have up to 0.15 with odometry and 0.24 without, those with depths of 1.3 or changing lenses 0.9 and more."""


@dataclass(frozen=True, eq=False)
class PairOfViews:
    """Two nodes of one map.

    Attributes:
        a: one node.
        b: the other.
        by_way: `a_from_b` by the map's own edges.
        by_views: the same by their landmarks; None if these give none.
        lost: many landmarks match and agree on no pose, see `agree_on_no_pose`.
    """

    a: Node
    b: Node
    by_way: PoseGaussian
    by_views: PoseGaussian | None
    lost: bool = False


@dataclass(frozen=True)
class OwnViews:
    """What pairs of views of one map tell of its way.

    Attributes:
        agreeing: pairs that are as far from each other as by the way.
        turned: pairs that tell nothing of that, and have the heading of the way.
        scales: of pairs that contradict it by their distance alone, how many times as long it is.
        without_pose: pairs of near nodes whose matches agree on no pose.
    """

    agreeing: int
    turned: int
    scales: tuple[float, ...]
    without_pose: int

    @property
    def reason(self) -> str:
        """What contradicts, in words; empty if too little does."""
        off, lost = len(self.scales), self.without_pose
        alike = sum(abs(math.log(scale / np.median(self.scales))) <= SCALE for scale in self.scales)
        if _enough(alike, self.agreeing + off - alike):
            by = f"by their depths it is {np.median(self.scales):.2f} times as long"
            return f"{alike} of {off + self.agreeing} pairs of its views do not fit its own way: {by}"
        fitting = self.agreeing + self.turned
        # By a slip as well many are too far or too near, each by a share of its own.
        if lost >= LEAST_CONTRADICTIONS and _enough(off + lost, fitting):
            by = f"{lost} agree on no pose, as of other lenses or depths"
            return f"{off + lost} of {off + lost + fitting} pairs of its views do not fit its own way: {by}"
        return ""


def _enough(against: int, fitting: int) -> bool:
    return against >= max(LEAST_CONTRADICTIONS, LEAST_AGAINST * (against + fitting))


def contradiction(pairs: Iterable[PairOfViews]) -> str:
    """What pairs of views of one map say against its way, in words; empty if too little does.

    Two views by one camera may agree with each other, and with none by another one: they are counted apart.
    """
    same, different = list[PairOfViews](), list[PairOfViews]()
    for pair in pairs:
        (same if pair.a.camera == pair.b.camera else different).append(pair)
    return compare_views(same).reason or compare_views(different).reason


def compare_views(pairs: Iterable[PairOfViews]) -> OwnViews:
    """Hold pairs of views against the way between them."""
    agreeing, turned, without_pose, scales = 0, 0, 0, list[float]()
    for pair in pairs:
        if pair.by_views is None:
            without_pose += pair.lost and math.hypot(pair.by_way.mean.x, pair.by_way.mean.y) <= REACH
            continue
        if abs(wrap_angle(pair.by_way.mean.heading - pair.by_views.mean.heading)) > MOST_TURN:
            continue
        measured = _scale(pair.a, pair.b, pair.by_way, pair.by_views)
        if measured is None:
            turned += 1
            continue
        scale, sigma = measured
        if abs(math.log(scale)) <= SCALE:
            agreeing += 1
        elif abs(math.log(scale)) > GATE * sigma:
            scales.append(scale)
    return OwnViews(agreeing, turned, tuple(scales), without_pose)


def _scale(a: Node, b: Node, way: PoseGaussian, seen: PoseGaussian) -> tuple[float, float] | None:
    """How many times as far two cameras are apart by their views as by the way; None if that tells nothing.

    Wrong depths scale what is seen about the camera, not about the robot.

    Returns:
        That, and its standard deviation as a share of it.
    """
    by_way, by_views = (_between_cameras(a, b, pose.mean) for pose in (way, seen))
    lengths = np.hypot(*by_way), np.hypot(*by_views)
    if min(lengths) < LEAST_LENGTH:
        return None
    along, scale = by_views / lengths[1], float(lengths[1] / lengths[0])
    variance = sum(
        along @ pose.covariance[:2, :2] @ along / length**2
        for pose, length in ((way, lengths[0]), (seen, lengths[1]))
    )
    aside = np.hypot(*(by_way / lengths[0] - along))
    if variance > MOST_SIGMA**2 or aside > MOST_ASIDE or abs(math.log(scale)) > LARGEST:
        return None
    return scale, math.sqrt(variance)


def _between_cameras(a: Node, b: Node, a_from_b: Pose2) -> np.ndarray:
    """(2,) m, from the camera of a to that of b, in the robot frame of a."""
    return (a_from_b @ Pose2(b.camera.mount_forward)).vector[:2] - [a.camera.mount_forward, 0.0]


def agree_on_no_pose(a: Node, b: Node) -> bool:
    """Whether many landmarks of two nodes match, and few of them agree on any pose."""
    if len(match(a.landmarks.codes, b.landmarks.codes)) < LEAST_MATCHES:
        return False
    verdict = examine(a, b) if a.id < b.id else examine(b, a)
    return not isinstance(verdict, Recognition) and verdict.inliers < LEAST_SHARE * verdict.matches

"""Agreement of views: what one view shows too weakly is certain once another one gives the same place.

A robot asks again while it drives or turns. A few landmarks that agree by chance, or on something that is in
many places, give another pose from elsewhere; the right place moves as the wheels say. So two weak answers
count as one certain answer if

- the motion between their poses is what the wheels measured, and
- the robot has moved so far that the poses themselves show it: the same image twice proves nothing.

Both are chi-square tests of the same difference, with the answers' covariances and the wheels'.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np

from mapweave.agent.global_localization.pose_consistency import DRIFT
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import NO_COMPONENT, Certainty, RelocalizeAnswer, Whereabouts

GATE = 16.27
"""Chi-square 99.9 % point for 3 degrees of freedom."""
FLOOR = (0.05, 0.03)
"""Standard deviation of an answer beyond its covariance, m and rad; as where the server compares answers."""
MEMORY = 10.0
"""m; what was seen longer ago is forgotten: the wheels have drifted, and the robot may have been carried."""
REMEMBERED = 32
"""Weak answers that are kept at most."""


@dataclass(frozen=True, eq=False)
class _Weak:
    place: Whereabouts
    odom_from_robot: Pose2
    way: float
    turned: float


class ViewAgreement:
    """Decides from the answers to successive views where a robot is."""

    def __init__(self) -> None:
        """Begin without a view."""
        self._earlier: deque[_Weak] = deque(maxlen=REMEMBERED)

    def take(
        self, answer: RelocalizeAnswer, odom_from_robot: Pose2, way: float, turned: float
    ) -> Whereabouts | None:
        """Where the robot is, once that is certain.

        Args:
            answer: to the newest view.
            odom_from_robot: by the wheels, where the view was taken.
            way: driven until then, m, forward or backward.
            turned: turned until then, rad, either way.

        Returns:
            The place of the newest view; None if neither the view nor its agreement with an earlier one is
            proof enough.
        """
        if answer.certainty in (Certainty.FOUND, Certainty.PLACE):
            return answer.candidates[0]
        if answer.certainty is not Certainty.UNKNOWN or not answer.candidates:
            return None
        now = _Weak(answer.candidates[0], odom_from_robot, way, turned)
        while self._earlier and way - self._earlier[0].way > MEMORY:
            self._earlier.popleft()
        agreeing = any(_agree(earlier, now) for earlier in self._earlier)
        self._earlier.append(now)
        return now.place if agreeing else None


def _agree(earlier: _Weak, now: _Weak) -> bool:
    """Whether two weak answers are of two views, and of one place."""
    if not (earlier.place.distance_known and now.place.distance_known):
        return False
    if earlier.place.node == now.place.node:
        before, after = earlier.place.node_from_robot, now.place.node_from_robot
    elif NO_COMPONENT != earlier.place.component == now.place.component:
        in_merged = earlier.place.merged_from_robot, now.place.merged_from_robot
        if in_merged[0] is None or in_merged[1] is None:
            return False
        before, after = in_merged[0], in_merged[1]
    else:
        return False
    measured = before.inverse() @ after
    drift = DRIFT * (now.way - earlier.way), DRIFT * (now.turned - earlier.turned)
    sigmas = np.hypot(FLOOR, drift)
    covariance = measured.covariance + np.diag([sigmas[0], sigmas[0], sigmas[1]]) ** 2
    moved = earlier.odom_from_robot.inverse() @ now.odom_from_robot
    return (
        PoseGaussian(measured.mean, covariance).mahalanobis2(moved) <= GATE
        and PoseGaussian(Pose2(), covariance).mahalanobis2(measured.mean) > GATE
    )

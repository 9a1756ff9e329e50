"""What holds the mapping filter's estimate up, watched from step to step."""

import math
from collections.abc import Callable

from mapweave.agent.ekf.mapping_state import PRIOR_DEPTH
from mapweave.agent.ekf.update_report import Health
from mapweave.hybridmap.pose import Array, Pose2

PATIENCE = 2
"""Steps without an image after which the filter says so."""
PARALLAX_PX = 5.0
"""Depths are unknown before landmarks have moved by this much in the image, px."""


class FilterHealth:
    """Keeps the health by the last image, its age, and how far the robot has moved for parallax."""

    def __init__(self, focal: float) -> None:
        """Begin at the anchor, healthy.

        Args:
            focal: horizontal, px.
        """
        self._focal = focal
        self._last = (Health.GOOD, "")
        self._steps_unseen = 0
        self._base = (0.0, 0.0)
        self._baseline = 0.0

    def took_up(self, pose_vector: Array) -> None:
        """Landmarks were taken up at a pose (3,): their parallax is counted from there."""
        self._base, self._baseline = _position(pose_vector), 0.0

    def moved(self, pose_vector: Array) -> None:
        """Take in a predicted pose (3,), before its image."""
        self._steps_unseen += 1
        self._baseline = max(self._baseline, math.dist(_position(pose_vector), self._base))

    def saw(self, health: Health, reason: str) -> None:
        """Take in the health by an image."""
        self._steps_unseen = 0
        self._last = health, reason

    def reanchored(self, old_from_new: Pose2) -> None:
        """Restart at a new anchor."""
        base = old_from_new.inverse() @ Pose2(*self._base)
        self._base = base.x, base.y

    def health(self, converged: Callable[[], bool]) -> tuple[Health, str]:
        """What holds the estimate up at present, and in words what is wrong; empty if nothing is.

        Args:
            converged: whether the depth of any landmark is known; only asked for if there was no parallax.
        """
        unseen = self._steps_unseen
        if unseen >= PATIENCE:
            return Health.NO_IMAGE, f"no image for {unseen} steps"
        if self._last[0] is not Health.GOOD:
            return self._last
        parallax = self._baseline * self._focal / PRIOR_DEPTH
        if parallax < PARALLAX_PX and not converged():
            way = 1e3 * self._baseline
            return (
                Health.NO_PARALLAX,
                f"the robot has moved by {way:.0f} mm since landmarks were taken up: no depths",
            )
        return self._last


def _position(pose_vector: Array) -> tuple[float, float]:
    x, y, _ = pose_vector.tolist()
    return x, y

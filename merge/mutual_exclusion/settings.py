"""Settings: when two robots contradict each other's poses."""

from __future__ import annotations

from dataclasses import dataclass, field

from mapweave.merge.mutual_exclusion.mutual_visibility import MutualVisibilitySettings
from mapweave.merge.mutual_exclusion.trajectories import BodyTrajectorySettings


@dataclass(frozen=True)
class ExclusionSettings:
    """When two robots contradict each other's poses.

    Attributes:
        least_apart: centres of two robots are never nearer than this, m, unless both tell their radii: with
            a camera and two driven wheels few are narrower.
        doubt: chance at most that a true merge is refused, ever.
        least_witnesses: independent moments (see `window`) that must make the merge half as likely each.
        trail: how well it is known where a robot is between two nodes.
        sight: what robots should have seen of each other.
    """

    least_apart: float = 0.2
    doubt: float = 1e-3
    least_witnesses: int = 3
    trail: BodyTrajectorySettings = field(default_factory=BodyTrajectorySettings)
    sight: MutualVisibilitySettings = field(default_factory=MutualVisibilitySettings)

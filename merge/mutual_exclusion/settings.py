"""Settings: when two robots contradict each other's poses."""

from __future__ import annotations

from dataclasses import dataclass, field

from mapweave.merge.mutual_exclusion.mutual_visibility import MutualVisibilitySettings
from mapweave.merge.mutual_exclusion.negative_evidence import NegativeEvidenceSettings
from mapweave.merge.mutual_exclusion.trajectories import BodyTrajectorySettings


@dataclass(frozen=True)
class ExclusionSettings:
    """When two robots contradict each other's poses.

    Attributes:
        least_apart: centres of two robots are never nearer than this, m, unless both tell their radii: with
            a camera and two driven wheels few are narrower.
        doubt: chance at most that a true merge is refused, ever.
        least_witnesses: independent moments (see `window`) that must make the merge half as likely each.
        sigmas: the poses of the two are first moved apart by as many standard deviations, since what is
            wrong with them is wrong at all moments alike.
        step: moments between nodes are looked at as often as this, s.
        window: moments within as much time are one witness, s.
        neighbourhood: robots that are further apart than as many least distances speak neither for nor
            against.
        trail: how well it is known where a robot is between two nodes.
        sight: what robots should have seen of each other.
        absence: what they should have seen of each other's maps.
    """

    least_apart: float = 0.2
    doubt: float = 1e-3
    least_witnesses: int = 3
    sigmas: float = 2.0
    step: float = 0.5
    window: float = 2.0
    neighbourhood: float = 5.0
    trail: BodyTrajectorySettings = field(default_factory=BodyTrajectorySettings)
    sight: MutualVisibilitySettings = field(default_factory=MutualVisibilitySettings)
    absence: NegativeEvidenceSettings = field(default_factory=NegativeEvidenceSettings)

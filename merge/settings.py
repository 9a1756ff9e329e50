"""What a person sets of the merge: `[merge]` in a settings file. It imports no library of the merge."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from msgspec import Meta

Positive = Annotated[float, Meta(gt=0.0)]
NotNegative = Annotated[float, Meta(ge=0.0)]


@dataclass(frozen=True)
class ConsistencySettings:
    """When links are believed.

    Attributes:
        gate: chi-square with 3 degrees of freedom that a loop may miss by; 16.27 is 99.9 %, since a link must
            agree with every other one.
        floor_xy: position error of any loop that no covariance tells of, m.
        floor_heading: heading error of any loop that no covariance tells of, rad.
        least_links: independent links (no node in common) that join two pieces.
        dominance: how many times the landmarks of a contradicting set the kept set must have, and how many
            times its independent links if that set would be believed without it.
    """

    gate: Positive = 16.27
    floor_xy: NotNegative = 0.02
    floor_heading: NotNegative = 0.01
    least_links: Annotated[int, Meta(ge=1)] = 2
    dominance: Positive = 1.5


@dataclass(frozen=True)
class ExclusionSettings:
    """When two robots contradict each other's poses.

    Attributes:
        least_apart: centres of two robots are never nearer than this, m, unless both tell their radii: with
            a camera and two driven wheels few are narrower.
        doubt: chance at most that a true merge is refused, ever.
        least_moments: independent moments that must make the merge half as likely each.
    """

    least_apart: Positive = 0.2
    doubt: Annotated[float, Meta(gt=0.0, lt=1.0)] = 1e-3
    least_moments: Annotated[int, Meta(ge=1)] = 3


@dataclass(frozen=True)
class MergeSettings:
    """How maps are merged.

    Attributes:
        consistency: when links are accepted.
        exclusion: when two robots would have been in one place.
        keep_superseded_days: a server deletes nodes that newer ones have superseded for so long, days. Until
            then a wrong merge can be taken back whole. `inf`: never.
    """

    consistency: ConsistencySettings = field(default_factory=ConsistencySettings)
    exclusion: ExclusionSettings = field(default_factory=ExclusionSettings)
    keep_superseded_days: Positive = 14.0

"""What a person sets of the merge: `[merge]` in a settings file. It imports no library of the merge."""

from dataclasses import dataclass, field
from typing import Annotated

from msgspec import Meta

Positive = Annotated[float, Meta(gt=0.0)]


@dataclass(frozen=True)
class ConsistencySettings:
    """When links are believed.

    Attributes:
        gate: chi-square with 3 degrees of freedom that a loop may miss by; 16.27 is 99.9 %, since a link must
            agree with every other one.
        least_links: independent links (no node in common) that join two pieces.
    """

    gate: Positive = 16.27
    least_links: Annotated[int, Meta(ge=1)] = 2


@dataclass(frozen=True)
class ExclusionSettings:
    """When two robots contradict each other's poses.

    Attributes:
        least_apart: centres of two robots are never nearer than this, m, unless both tell their radii: with
            a camera and two driven wheels few are narrower.
        doubt: chance at most that a true merge is refused, ever.
    """

    least_apart: Positive = 0.2
    doubt: Annotated[float, Meta(gt=0.0, lt=1.0)] = 1e-3


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

"""Settings of global localization."""

from __future__ import annotations

from dataclasses import dataclass, field

from mapweave.agent.global_localization.pose_consistency import ConsistencySettings


@dataclass(frozen=True)
class GlobalLocalizationSettings:
    """As a robot wants it that has to get somewhere: it never gives up, and one recognition will do.

    Attributes:
        consistency: when two agree.
    """

    consistency: ConsistencySettings = field(default_factory=ConsistencySettings)


@dataclass(frozen=True)
class ResumptionSettings(GlobalLocalizationSettings):
    """As a robot wants it that is to map on: a false edge bends the map for good, a fresh map is no harm."""

    turns: tuple[int, int] = (2, 1)
    places: int = 4

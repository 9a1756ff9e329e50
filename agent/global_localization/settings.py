"""How hard a robot tries to find itself, and what it believes."""

from __future__ import annotations

from dataclasses import dataclass, field

from mapweave.agent.global_localization.pose_consistency import ConsistencySettings


@dataclass(frozen=True)
class GlobalLocalizationSettings:
    """As a robot wants it that has to get somewhere: it never gives up, and one recognition will do.

    Attributes:
        sure: standard deviations up to which a recognition is believed, m and rad,
        leniency: and after each whole turn in vain this many times `sure` more.
        looks: recognitions that must agree, 1 or 2; 2 counts the own map's alone.
        consistency: when two agree.
        turns: whole turns at the first place, and at each further one; one where anything is recognised.
        places: how many places it looks around at; 0 for no end.
        carried_pause: seconds between two looks of a robot that somebody else moves.
        carried_looks: how often such a robot looks in vain before it counts as lost.
    """

    sure: tuple[float, float] = (0.06, 0.03)
    leniency: float = 1.0
    looks: int = 1
    consistency: ConsistencySettings = field(default_factory=ConsistencySettings)
    turns: tuple[int, int] = (1, 1)
    places: int = 0
    carried_pause: float = 0.5
    carried_looks: int = 120


@dataclass(frozen=True)
class ResumptionSettings(GlobalLocalizationSettings):
    """As a robot wants it that is to map on: a false edge bends the map for good, a fresh map is no harm."""

    sure: tuple[float, float] = (0.03, 0.018)
    leniency: float = 0.0
    looks: int = 2
    turns: tuple[int, int] = (2, 1)
    places: int = 4

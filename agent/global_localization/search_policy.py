"""How hard a robot tries to find itself, and what it believes."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SearchPolicy:
    """What a robot does before it gives up, and what it takes for a recognition.

    Attributes:
        sure: standard deviations up to which a recognition is believed, m and rad,
        leniency: and after each whole turn in vain this many times `sure` more.
        looks: recognitions that must agree, 1 or 2; 2 counts the own map's alone.
        turns: whole turns at the first place, and at each further one; one where anything is recognised.
        places: how many places it looks around at; 0 for no end.
        carried_pause: time between two looks of a robot that somebody else moves, s.
        carried_looks: how often such a robot looks in vain before it counts as lost.
    """

    sure: tuple[float, float]
    leniency: float
    looks: int
    turns: tuple[int, int]
    places: int
    carried_pause: float = 0.5
    carried_looks: int = 120


TO_NAVIGATE = SearchPolicy(sure=(0.06, 0.03), leniency=1.0, looks=1, turns=(1, 1), places=0)
"""A robot that has to get somewhere never gives up, and one recognition will do."""

TO_MAP = SearchPolicy(sure=(0.03, 0.018), leniency=0.0, looks=2, turns=(2, 1), places=4)
"""A robot that is to map on: a false edge bends the map for good, a fresh map is no harm."""

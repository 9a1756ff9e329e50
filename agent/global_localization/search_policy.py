"""How hard a robot tries to find itself, and what it believes."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SearchPolicy:
    """What a robot does before it gives up, and what it takes for a recognition.

    Attributes:
        sure: largest standard deviations of an accepted recognition, m and rad.
        leniency: after each full turn without success this many times `sure` more.
        views_needed: recognitions that must agree, 1 or 2; 2 counts the own map's alone.
        turns: whole turns at the first place, and at each further one; one where anything is recognised.
        places: how many places it searches from; 0 for no limit.
        carried_pause: time between two views of a robot that a person moves, s.
        carried_views: views without success after which such a robot counts as lost.
    """

    sure: tuple[float, float]
    leniency: float
    views_needed: int
    turns: tuple[int, int]
    places: int
    carried_pause: float = 0.5
    carried_views: int = 120


TO_NAVIGATE = SearchPolicy(sure=(0.06, 0.03), leniency=1.0, views_needed=1, turns=(1, 1), places=0)
"""A robot that has to get somewhere never gives up, and one recognition will do."""

BEYOND_PORTAL = SearchPolicy(sure=(0.06, 0.03), leniency=1.0, views_needed=1, turns=(1, 1), places=1)
"""A robot that was taken through a portal stands where a person has put it: it turns once, then it asks."""

TO_MAP = SearchPolicy(sure=(0.03, 0.018), leniency=0.0, views_needed=2, turns=(2, 1), places=4)
"""A robot that is to map on: a false edge bends the map for good, a fresh map is no harm."""

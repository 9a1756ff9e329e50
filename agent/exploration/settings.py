"""How a robot explores, and the words for what it does."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

SPACING = 1.7
"""Places are at least this far from each other, m."""
REACH = 7.0
"""The longest way to a next place, m."""


@dataclass(frozen=True)
class ExplorerSettings:
    """How the robot explores.

    Attributes:
        drive_speed: m/s on that drive.
        turn_rate: rad/s.
        travel_speed: m/s.
        ask: whether to ask the fleet's map what others have mapped, and to leave that to them.
        wander: explore as the paper does, by chance (section 4.1), instead of place by place.
    """

    drive_speed: float = 0.25
    turn_rate: float = 0.6
    travel_speed: float = 0.26
    ask: bool = True
    wander: bool = False


class Phase(StrEnum):
    """What the explorer is doing, in words for the status line."""

    LOOKING = "waiting for a first image"
    DRIVING = "driving back and forth to map the view"
    TURNING = "turning to the next view"
    SCANNING = "turning where the map shows everything already"
    TRAVELLING = "travelling to the next place"
    DONE = "no new place in reach: exploration is complete"

"""How a robot explores, and the words for what it does."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


@dataclass(frozen=True)
class ExplorerSettings:
    """How the robot explores.

    Attributes:
        drive: how far it drives back and forth to map a view, m.
        drive_speed: m/s on that drive.
        least_drive: with less room than this the view is mapped as well as it can be while turning.
        least_features: a view with fewer features is not worth a drive.
        left: the turn ends when at most this many of the view's features are left (paper: four).
        least_turn: but not before this angle, rad.
        most_turn: nor after this, rad.
        turn_rate: rad/s.
        travel_speed: m/s.
        travel_step: a new node at least this often on the way, m.
        spacing: places are at least this far from each other, m.
        reach: the longest way to a next place, m.
        sight: what lies around a place, and what others know around theirs, is judged within this radius, m.
        view: a look around shows floor up to this far, m.
        look_time: about what a look around takes, s.
        least_area: new floor that is worth one, m^2.
        known_reach: nodes within this of a place show it, m.
        known: a place around which nodes look into this share of all directions is not mapped again.
        patience: seconds without getting on before a way is given up.
        ask: whether to ask the fleet's map what others have mapped, and to leave that to them.
        wander: explore as the paper does, by chance (section 4.1), instead of place by place.
    """

    drive: float = 0.6
    drive_speed: float = 0.25
    least_drive: float = 0.2
    least_features: int = 10
    left: int = 4
    least_turn: float = 0.45
    most_turn: float = 1.0
    turn_rate: float = 0.6
    travel_speed: float = 0.26
    travel_step: float = 0.8
    spacing: float = 1.7
    reach: float = 7.0
    sight: float = 1.6
    view: float = 3.0
    look_time: float = 60.0
    least_area: float = 1.0
    known_reach: float = 0.7
    known: float = 0.75
    patience: float = 4.0
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

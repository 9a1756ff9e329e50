"""The words for what an exploring robot does."""

from __future__ import annotations

from enum import StrEnum


class Phase(StrEnum):
    """What the explorer is doing, in words for the status line."""

    LOOKING = "waiting for a first image"
    DRIVING = "driving back and forth to map the view"
    TURNING = "turning to the next view"
    SCANNING = "turning where the map shows everything already"
    TRAVELLING = "travelling to the next place"
    WAITING = "standing: a place could not be reached; trying it again later"
    STUCK = "standing: the wheels do not move the robot"
    DONE = "no new place in reach: exploration is complete"
    NOT_DARED = "standing: the rest cannot be reached over floor that the camera has shown free"

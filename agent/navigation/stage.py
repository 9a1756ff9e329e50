"""What a robot with a goal is doing while it follows no route."""

from __future__ import annotations

from enum import StrEnum


class NavigationStage(StrEnum):
    """What navigation is doing, in words for people."""

    LOST = "turning to localize"
    ASKING = "asking for a route"
    BLOCKED = "waiting at an obstacle"
    WAITING = "waiting for a route"
    YIELDING = "waiting for another robot"
    ASIDE = "stepping aside for another robot"
    PORTAL = "waiting at a portal"
    ARRIVED = "parked at the goal"
    GIVEN_UP = "gave up its goal"

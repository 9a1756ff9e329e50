"""Mapping while a person moves the robot: when to make a node."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from mapweave.agent.mapping.episode import Episode, EpisodeRequest, Move
from mapweave.agent.observation import Command

LEAVING = 0.45
"""Or the share of the view's features still tracked below which they are leaving the view."""
LEAST_TRACKED = 16
"""Or this few of them."""
LEAST_TURN = 0.35
"""Or after turning by this, rad."""


@dataclass(frozen=True)
class CarriedMappingSettings:
    """When a carried robot makes a node.

    Attributes:
        converged: the share of landmarks that must have converged.
        depth_step: converged landmarks make a node only after moving this share of their median depth.
    """

    converged: float = 0.7
    depth_step: float = 0.25


class CarriedMapping:
    """Says when nodes are made of a drive that it does not control.

    Attributes:
        detail: in words, for the status line.
    """

    def __init__(self, mapper: Episode, settings: CarriedMappingSettings | None = None) -> None:
        """Take the mapper that the pipeline keeps up to date."""
        self.detail = "no image yet"
        self._mapper = mapper
        self._settings = settings or CarriedMappingSettings()
        self._behaviour = self._watch()

    def next_move(self) -> Move:
        """What to do next; a command, always to stand still, ends the tick. The mapper has seen the tick."""
        return next(self._behaviour)

    def _watch(self) -> Iterator[Move]:
        while True:
            if not self._mapper.started:
                yield EpisodeRequest.BEGIN
            elif self._is_complete():
                yield EpisodeRequest.FINISH
            yield Command()

    def _is_complete(self) -> bool:
        """Whether the view is known well, or about to be lost."""
        s, mapper = self._settings, self._mapper
        moved = mapper.anchor_from_robot
        way = math.hypot(moved.x, moved.y)
        left = mapper.anchored
        leaving = left < max(LEAVING * mapper.anchor_features, LEAST_TRACKED)
        far = way > s.depth_step * mapper.typical_depth or abs(moved.heading) > LEAST_TURN
        self.detail = f"{left} of {mapper.anchor_features} features left after {way:.1f} m"
        if mapper.anchor_features < LEAST_TRACKED:
            self.detail = f"only {mapper.anchor_features} features in view"
        moving = way > 0.02 * mapper.typical_depth or abs(moved.heading) > 0.1
        return (leaving and moving) or (far and mapper.converged_share >= s.converged)

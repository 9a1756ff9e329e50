"""Mapping while somebody else moves the robot: when to make a node."""

from __future__ import annotations

import math
from dataclasses import dataclass

from mapweave.agent.mapping.mapper import Mapper
from mapweave.agent.observation import Observation


@dataclass(frozen=True)
class CarriedMappingSettings:
    """When a carried robot makes a node.

    Attributes:
        converged: the share of landmarks that must have converged.
        leaving: or the share of the view's features still tracked below which they are leaving the view.
        least_tracked: or this few of them.
        depth_step: converged landmarks make a node only after moving this share of their median depth.
        least_turn: or after turning by this, rad.
    """

    converged: float = 0.7
    leaving: float = 0.45
    least_tracked: int = 16
    depth_step: float = 0.25
    least_turn: float = 0.35


class CarriedMapping:
    """Makes nodes of a drive that it does not control.

    Attributes:
        detail: in words, for the status line.
    """

    def __init__(self, mapper: Mapper, settings: CarriedMappingSettings | None = None) -> None:
        """Take the mapper that the pipeline keeps up to date."""
        self.detail = "no image yet"
        self._mapper = mapper
        self._settings = settings or CarriedMappingSettings()

    def step(self, observation: Observation) -> None:
        """One tick. The mapper has seen the observation already."""
        s, mapper = self._settings, self._mapper
        if not mapper.started:
            mapper.begin(observation)
            return
        moved = mapper.anchor_from_robot
        way = math.hypot(moved.x, moved.y)
        left = mapper.anchored
        leaving = left < max(s.leaving * mapper.anchor_features, s.least_tracked)
        far = way > s.depth_step * mapper.typical_depth or abs(moved.heading) > s.least_turn
        self.detail = f"{left} of {mapper.anchor_features} features left after {way:.1f} m"
        if mapper.anchor_features < s.least_tracked:
            self.detail = f"only {mapper.anchor_features} features in view"
        moving = way > 0.02 * mapper.typical_depth or abs(moved.heading) > 0.1
        if (leaving and moving) or (far and mapper.converged_share >= s.converged):
            mapper.finish(observation)

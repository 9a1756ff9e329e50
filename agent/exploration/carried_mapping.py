"""Mapping while a person moves the robot: when to make a node."""

from __future__ import annotations

import math
from dataclasses import dataclass

from mapweave.agent.mapping.mapper import Mapper
from mapweave.agent.observation import Observation

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
        leaving = left < max(LEAVING * mapper.anchor_features, LEAST_TRACKED)
        far = way > s.depth_step * mapper.typical_depth or abs(moved.heading) > LEAST_TURN
        self.detail = f"{left} of {mapper.anchor_features} features left after {way:.1f} m"
        if mapper.anchor_features < LEAST_TRACKED:
            self.detail = f"only {mapper.anchor_features} features in view"
        moving = way > 0.02 * mapper.typical_depth or abs(moved.heading) > 0.1
        if (leaving and moving) or (far and mapper.converged_share >= s.converged):
            mapper.finish(observation)

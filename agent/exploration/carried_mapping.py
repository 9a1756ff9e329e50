"""Mapping while a person moves the robot: when to make a node."""

import math
from collections.abc import Iterator

from mapweave.agent.mapping.episode import EpisodeRequest, Move
from mapweave.agent.mapping.mapper import Mapper
from mapweave.agent.observation import Command

CONVERGED = 0.7
"""Share of the landmarks that must have converged before a node is made."""
DEPTH_STEP = 0.25
"""Converged landmarks make a node only after moving this share of their median depth."""


LEAVING = 0.45
"""With a smaller share of the view's features still tracked, the view is being left and a node is made."""
LEAST_TRACKED = 16
"""With fewer features still tracked, the view is being left and a node is made."""
LEAST_TURN = 0.35
"""Converged landmarks make a node after turning by this as well, rad."""


class CarriedMapping:
    """Says when nodes are made of a drive that it does not control.

    Attributes:
        detail: in words, for the status line.
    """

    def __init__(self, mapper: Mapper) -> None:
        """Take the mapper that the pipeline keeps up to date."""
        self.detail = "no image yet"
        self._mapper = mapper
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
        mapper = self._mapper
        moved = mapper.anchor_from_robot
        way = math.hypot(moved.x, moved.y)
        left = mapper.anchored
        leaving = left < max(LEAVING * mapper.anchor_features, LEAST_TRACKED)
        far = way > DEPTH_STEP * mapper.typical_depth or abs(moved.heading) > LEAST_TURN
        self.detail = f"{left} of {mapper.anchor_features} features left after {way:.1f} m"
        if mapper.anchor_features < LEAST_TRACKED:
            self.detail = f"only {mapper.anchor_features} features in view"
        moving = way > 0.02 * mapper.typical_depth or abs(moved.heading) > 0.1
        return (leaving and moving) or (far and mapper.converged_share >= CONVERGED)

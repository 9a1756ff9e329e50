"""Exploration as in the paper: by chance."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from mapweave.agent.exploration.explorer import Explorer
from mapweave.agent.mapping.episode import Move

SHORTEST = 0.3
"""m; with less room ahead the robot turns on."""


class RandomExploration(Explorer):
    """Maps a view, turns to a side that chance chooses, and again (paper, section 4.1).

    The paper leaves open how the robot gets on, and turning on the spot it never would. Here it drives
    straight on after each turn, for a way that chance chooses out of the room that there is.
    """

    def _explore(self) -> Iterator[Move]:
        yield from self._moves.begin()
        while True:
            yield from self._moves.map_view()
            yield from self._moves.turn_to_next_view(self._either_side())
            way = self._rng.uniform(0.0, self._moves.room(0.0))
            if way > SHORTEST:
                heading = self._mapper.map_from_robot.mean.heading
                ahead = way * np.array([math.cos(heading), math.sin(heading)])
                yield from self._moves.travel([self._moves.position + ahead])

"""Random exploration, as in the paper."""

import math
from collections.abc import Iterator

import numpy as np

from mapweave.agent.exploration.explorer import Explorer
from mapweave.agent.mapping.episode import Move

SHORTEST = 0.3
"""m; with less room ahead the robot turns on."""


class RandomExploration(Explorer):
    """Maps a view, turns to a random side, and repeats (paper, section 4.1).

    The paper does not say how the robot moves on from a place. Here it drives straight on after each turn,
    for a random part of the free room.
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

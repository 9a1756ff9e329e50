"""What other robots have mapped nearby, by the fleet's map."""

import numpy as np

from mapweave.agent.exploration.viewpoint_selection import seen_around
from mapweave.agent.mission import ServerAnswer, WhatIsKnown
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.pose import Array
from mapweave.hybridmap.query import KnownAnswer

NUMBER = -1
"""Number of every question: only the newest answer counts. The navigator's numbers are positive."""


class FleetCoverage:
    """Views of others, in this robot's own map: none without a server, or before the maps are joined.

    Attributes:
        views: (N, 4) [x m, y m, heading rad, semi-aperture rad], in map.
    """

    def __init__(self, map_id: MapId, reach: float) -> None:
        """Start without views.

        Args:
            map_id: the robot's own map.
            reach: radius of the questions, m.
        """
        self.views: Array = np.zeros((0, 4))
        self._map = map_id
        self._reach = reach

    def question(self, position: Array) -> WhatIsKnown:
        """What to ask at a position, (2,) m in map."""
        return WhatIsKnown(NUMBER, self._map, float(position[0]), float(position[1]), self._reach)

    def take(self, answer: ServerAnswer) -> None:
        """Take an answer. A missing answer leaves the earlier coverage as it is."""
        if isinstance(answer.content, KnownAnswer):
            self.views = answer.content.views.astype(np.float64)

    def places(self, views: Array, reach: float, covered_share: float) -> Array:
        """Places that others have covered, so that this robot need not: (M, 2) m, in map.

        Args:
            views: (N, 4) of all robots, this one included.
            reach: views within this of a place show it, m.
            covered_share: share of all directions that they must cover.
        """
        positions: Array = self.views[:, :2]
        around = [seen_around(views, position, reach) >= covered_share for position in positions]
        return np.asarray(positions[np.array(around, dtype=bool)])

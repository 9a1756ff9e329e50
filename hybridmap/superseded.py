"""Superseded nodes: newer ones of the same place replace them."""

import math
from dataclasses import dataclass

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.limits import Angle, Distance, LandmarkCount


@dataclass(frozen=True, slots=True)
class Superseded:
    """Why a node is no longer needed.

    Attributes:
        by: the newer node that replaces it.
        found: landmarks of the old node that were found again from the new one and stay in view between them.
        distance: m, between the two.
        turn: rad, between their headings.
    """

    by: NodeId
    found: LandmarkCount
    distance: Distance
    turn: Angle

    def __str__(self) -> str:
        """In words: `r1.1.5 replaces it, 0.31 m off and turned by 12 degrees, with 34 landmarks`."""
        turned = f"turned by {math.degrees(self.turn):.0f} degrees"
        where = f"{self.distance:.2f} m off and {turned}"
        return f"{self.by} replaces it, {where}, with {self.found} landmarks"

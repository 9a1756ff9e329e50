"""A straight corridor, too narrow for two robots to pass each other, with one niche in the middle."""

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from mapweave.hybridmap.errors import InvalidValue
from mapweave.sim.worlds.design import THICKNESS, Design, Room, Wall

HALF = THICKNESS / 2
END = 1.5
"""Length of the parts at the ends in which robots start, m."""


@dataclass(frozen=True)
class PassageParameters:
    """Size of the corridor.

    Attributes:
        length: from west to east, m.
        breadth: from south to north, m.
        niche: its width along the corridor, m.
        depth: of the niche, m.
    """

    length: Annotated[float, Meta(ge=5.0, le=60.0)] = 8.0
    breadth: Annotated[float, Meta(ge=1.0, le=5.0)] = 1.0
    niche: Annotated[float, Meta(ge=0.7, le=20.0)] = 1.6
    depth: Annotated[float, Meta(ge=0.5, le=5.0)] = 1.4

    def __post_init__(self) -> None:
        """Refuse sizes that do not fit each other (InvalidValue)."""
        if self.niche > self.length - 2 * END:
            raise InvalidValue(
                f"a niche of {self.niche:g} m does not fit between the ends of a passage of {self.length:g} m"
            )


def passage(parameters: PassageParameters, seed: int) -> Design:
    """Design a passage; other seeds, other prints on its walls."""
    x, y = parameters.length, parameters.breadth
    west, east = (x - parameters.niche) / 2, (x + parameters.niche) / 2
    top = y + parameters.depth
    rooms = (
        Room("west", (0.0, 0.0), (END, y)),
        Room("corridor", (END, 0.0), (x - END, y)),
        Room("east", (x - END, 0.0), (x, y)),
        Room("niche", (west, y), (east, top)),
    )
    walls = (
        Wall((-THICKNESS, -HALF), (x + THICKNESS, -HALF)),
        Wall((-HALF, 0.0), (-HALF, y)),
        Wall((x + HALF, 0.0), (x + HALF, y)),
        Wall((-THICKNESS, y + HALF), (west, y + HALF)),
        Wall((east, y + HALF), (x + THICKNESS, y + HALF)),
        Wall((west - HALF, y + THICKNESS), (west - HALF, top + THICKNESS)),
        Wall((east + HALF, y + THICKNESS), (east + HALF, top + THICKNESS)),
        Wall((west, top + HALF), (east, top + HALF)),
    )
    return Design(
        f"passage-{seed}", seed, start_rooms=("west", "east"), look_along=True, rooms=rooms, walls=walls
    )

"""An arena: one hall with prints all around, to park in."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta

from mapweave.sim.worlds.design import THICKNESS, Design, Room, Wall
from mapweave.sim.worlds.furniture import STOCK, furnish
from mapweave.sim.worlds.layout import plan_of

HALF = THICKNESS / 2


@dataclass(frozen=True)
class ArenaParameters:
    """Size of the hall.

    Attributes:
        length: from west to east, m.
        width: from south to north, m.
        boxes: that are wanted in it.
    """

    length: Annotated[float, Meta(ge=2.0, le=60.0)] = 8.0
    width: Annotated[float, Meta(ge=2.0, le=60.0)] = 6.0
    boxes: Annotated[int, Meta(ge=0, le=100)] = 0


def arena(parameters: ArenaParameters, seed: int) -> Design:
    """Design an arena; other seeds, other prints and other places of the boxes."""
    rng = np.random.default_rng([seed, 0xA4E4A])
    x, y = parameters.length, parameters.width
    rooms = (Room("room 0", (0.0, 0.0), (x, y)),)
    walls = (
        Wall((-THICKNESS, -HALF), (x + THICKNESS, -HALF)),
        Wall((-THICKNESS, y + HALF), (x + THICKNESS, y + HALF)),
        Wall((-HALF, 0.0), (-HALF, y)),
        Wall((x + HALF, 0.0), (x + HALF, y)),
    )
    crates = tuple(kind for kind in STOCK if kind.name == "crate")
    plan = plan_of(Design(rooms=rooms, walls=walls))
    boxes = furnish(rng, plan, plan.rooms[0], crates, by_wall=0, count=parameters.boxes)
    return Design(f"arena-{seed}", seed, rooms=rooms, walls=walls, furniture=tuple(boxes))

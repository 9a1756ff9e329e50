"""An office: rooms along one corridor, each with a doorway, furniture and prints."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta

from mapweave.sim.worlds.design import THICKNESS, Design, Furniture, Room, Wall
from mapweave.sim.worlds.furniture import STOCK, furnish
from mapweave.sim.worlds.layout import plan_of

DOOR = 1.0
"""Width of doorways, m."""
HALF = THICKNESS / 2


@dataclass(frozen=True)
class OfficeParameters:
    """Size of an office.

    Attributes:
        rooms: along the corridor.
        furniture: whether there is any.
    """

    rooms: Annotated[int, Meta(ge=1, le=32)] = 3
    furniture: bool = True


def office(parameters: OfficeParameters, seed: int) -> Design:
    """Design an office; other seeds have other sizes, doors, furniture and prints."""
    rng = np.random.default_rng([seed, 0x0FF1CE])
    rooms, walls = _floor(rng, parameters.rooms)
    plan = plan_of(Design(rooms=rooms, walls=walls))
    furniture: list[Furniture] = []
    if parameters.furniture:
        for room in (r for r in plan.rooms if r.name.startswith("room")):
            furniture += furnish(rng, plan, room, STOCK, by_wall=4, count=int(rng.integers(4, 7)))
    return Design(f"office-{seed}", seed, rooms=rooms, walls=walls, furniture=tuple(furniture))


def _floor(rng: np.random.Generator, rooms: int) -> tuple[tuple[Room, ...], tuple[Wall, ...]]:
    """Rooms north of a corridor that runs east; walls with a gap for each door."""
    widths = rng.uniform(3.6, 4.4, rooms).round(3)
    depth = round(float(rng.uniform(3.6, 4.3)), 3)
    breadth = round(float(rng.uniform(1.9, 2.2)), 3)
    edges = np.concatenate([[0.0], np.cumsum(widths + THICKNESS)]).round(3).tolist()
    length, top, between = edges[-1], round(breadth + THICKNESS + depth, 3), round(breadth + HALF, 3)
    spaces = [Room("corridor", (0.0, 0.0), (round(length - THICKNESS, 3), breadth))]
    walls = [
        Wall((-THICKNESS, -HALF), (length, -HALF)),
        Wall((-THICKNESS, round(top + HALF, 3)), (length, round(top + HALF, 3))),
        Wall((-HALF, 0.0), (-HALF, top)),
        Wall((round(length - HALF, 3), 0.0), (round(length - HALF, 3), top)),
    ]
    for number in range(rooms):
        left, right = edges[number], round(edges[number + 1] - THICKNESS, 3)
        spaces.append(Room(f"room {number}", (left, round(breadth + THICKNESS, 3)), (right, top)))
        door = round(float(rng.uniform(left + 0.5, right - 0.5 - DOOR)), 3)
        end = round(door + DOOR, 3)
        spaces.append(Room(f"door {number}", (door, breadth), (end, round(breadth + THICKNESS, 3))))
        walls += [Wall((left, between), (door, between)), Wall((end, between), (right, between))]
        if number:
            middle = round(left - HALF, 3)
            walls.append(Wall((middle, breadth), (middle, top)))
    return tuple(spaces), tuple(walls)

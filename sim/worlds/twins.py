"""Two rooms that look exactly the same: every view of one is also a view of the other."""

import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from msgspec import Meta

from mapweave.sim.worlds.design import THICKNESS, Design, Point, Room, Wall
from mapweave.sim.worlds.furniture import STOCK, furnish
from mapweave.sim.worlds.layout import plan_of

HALF = THICKNESS / 2
DOOR = 1.0
"""Width of doorways, m."""
BREADTH = 2.1
"""Of the corridor, m."""
PIECES = 4
"""Of furniture that are wanted in each room."""


@dataclass(frozen=True)
class TwinsParameters:
    """Size of the rooms, and whether one can get from one to the other.

    Attributes:
        joined: whether both rooms open onto one corridor, which is like nothing else; else they are closed.
        length: of each room from west to east, m.
        width: of each room from south to north, m.
    """

    joined: bool = False
    length: Annotated[float, Meta(ge=2.5, le=30.0)] = 4.8
    width: Annotated[float, Meta(ge=2.5, le=30.0)] = 4.4


def twins(parameters: TwinsParameters, seed: int) -> Design:
    """Design the twins; other seeds look different.

    The second room is the first, moved east by whole metres: then even rounding is the same in both.
    """
    rng = np.random.default_rng([seed, 0x7415])
    length, width = parameters.length, parameters.width
    east = float(math.ceil(length + 2 * THICKNESS))
    door = round(float(rng.uniform(0.5, length - 0.5 - DOOR)), 3) if parameters.joined else None
    room = Room("room 0", (0.0, 0.0), (length, width), seed=0)
    walls = _walls(length, width, door)
    rooms = [room]
    if door is not None:
        rooms.append(Room("door 0", (door, -2 * THICKNESS), (door + DOOR, 0.0), seed=1))
    alone = plan_of(Design(rooms=tuple(rooms), walls=tuple(walls)))
    pieces = furnish(rng, alone, alone.rooms[0], STOCK, by_wall=PIECES - 1, count=PIECES)
    pieces = [replace(piece, seed=number) for number, piece in enumerate(pieces)]
    rooms += [_moved_room(west_room, east) for west_room in rooms]
    walls += [replace(w, start=_moved(w.start, east), end=_moved(w.end, east)) for w in walls]
    furniture = [*pieces, *(replace(piece, at=_moved(piece.at, east)) for piece in pieces)]
    if door is not None:
        corridor, around = _corridor(east + length, door, east)
        rooms.append(corridor)
        walls += around
    return Design(
        f"twins-{seed}", seed, start_rooms=("room 0", "room 1"), rooms=tuple(rooms), walls=tuple(walls),
        furniture=tuple(furniture),
    )  # fmt: skip


def _walls(length: float, width: float, door: float | None) -> list[Wall]:
    """The walls of one room, each with a seed, with a gap for a door in the south."""
    around: list[tuple[Point, Point]] = [
        ((-HALF, -THICKNESS), (-HALF, width + THICKNESS)),
        ((length + HALF, -THICKNESS), (length + HALF, width + THICKNESS)),
        ((0.0, width + HALF), (length, width + HALF)),
    ]
    if door is None:
        around.append(((0.0, -HALF), (length, -HALF)))
    else:
        around += [((0.0, -HALF), (door, -HALF)), ((door + DOOR, -HALF), (length, -HALF))]
    return [Wall(start, end, seed=number) for number, (start, end) in enumerate(around)]


def _corridor(end: float, door: float, east: float) -> tuple[Room, list[Wall]]:
    """The corridor south of both rooms, with a layer of wall and prints of its own before them."""
    low, high = -2 * THICKNESS - BREADTH, -2 * THICKNESS
    room = Room("corridor", (0.0, low), (end, high))
    gaps = [0.0, door, door + DOOR, east + door, east + door + DOOR, end]
    layer = -1.5 * THICKNESS
    walls = [Wall((gaps[k], layer), (gaps[k + 1], layer)) for k in (0, 2, 4)]
    walls += [
        Wall((-HALF, low - THICKNESS), (-HALF, -THICKNESS)),
        Wall((end + HALF, low - THICKNESS), (end + HALF, -THICKNESS)),
        Wall((0.0, low - HALF), (end, low - HALF)),
    ]
    return room, walls


def _moved_room(room: Room, east: float) -> Room:
    name = room.name.replace("0", "1")
    return replace(room, name=name, low=_moved(room.low, east), high=_moved(room.high, east))


def _moved(point: Point, east: float) -> Point:
    return point[0] + east, point[1]

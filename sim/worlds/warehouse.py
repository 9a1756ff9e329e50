"""A warehouse: rows of mostly equal racks, and signs at the ends of the aisles."""

import string
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta

from mapweave.sim.worlds.design import THICKNESS, Design, Furniture, Poster, Room, Wall
from mapweave.sim.worlds.furniture import furnish
from mapweave.sim.worlds.layout import plan_of

HALF = THICKNESS / 2
HEIGHT = 3.2
"""Of the hall, m."""
BAY = 1.8
"""Length of one bay of a rack, m."""
DEPTH = 0.9
"""Of a rack, with cartons on both sides, m."""
RACK = 2.2
"""Height of a rack, m."""
AISLE = 1.9
"""Breadth of an aisle between two rows, m."""
END = 2.4
"""Breadth of the cross aisles at both ends, m."""
CHANGED = 0.3
"""Share of the bays in which some cartons are others."""
IN_FRONT = 0.05
"""How far in front of its wall a sign's place is given, m."""

STACKS = (
    Furniture("stack", (0.0, 0.0), 0.8, 0.6, 0.8, texture="carton", top="carton"),
    Furniture("stack", (0.0, 0.0), 0.6, 0.5, 0.45, texture="carton", top="carton"),
)
"""Cartons in the cross aisles."""


@dataclass(frozen=True)
class WarehouseParameters:
    """Size of a warehouse.

    Attributes:
        rows: of racks, each with an aisle on both sides.
        bays: of each row.
        stacks: of cartons that are wanted in each of the two cross aisles.
    """

    rows: Annotated[int, Meta(ge=1, le=20)] = 3
    bays: Annotated[int, Meta(ge=1, le=30)] = 5
    stacks: Annotated[int, Meta(ge=0, le=20)] = 3


def warehouse(parameters: WarehouseParameters, seed: int) -> Design:
    """Design a warehouse; other seeds have other goods, in other bays, and other signs."""
    rng = np.random.default_rng([seed, 0x3A4E])
    rows, bays = parameters.rows, parameters.bays
    length, width = round(2 * END + bays * BAY, 3), round(rows * DEPTH + (rows + 1) * AISLE, 3)
    paint = int(rng.integers(150, 190))
    rooms = [
        Room("west end", (0.0, 0.0), (END, width), "screed", paint),
        Room("east end", (round(length - END, 3), 0.0), (length, width), "screed", paint),
    ]
    for aisle in range(rows + 1):
        low, high = round(aisle * (AISLE + DEPTH), 3), round(aisle * (AISLE + DEPTH) + AISLE, 3)
        rooms.append(Room(f"aisle {aisle + 1}", (END, low), (round(length - END, 3), high), "screed", paint))
    walls = (
        Wall((-THICKNESS, -HALF), (length + THICKNESS, -HALF), texture="cladding"),
        Wall((-THICKNESS, width + HALF), (length + THICKNESS, width + HALF), texture="cladding"),
        Wall((-HALF, 0.0), (-HALF, width), texture="cladding"),
        Wall((length + HALF, 0.0), (length + HALF, width), texture="cladding"),
    )
    racks = [rack for row in range(rows) for rack in _row(rng, row, bays)]
    posters = [*_signs(rooms, length), *_notices(rng, length, width)]
    bare = Design(rooms=tuple(rooms), walls=walls, furniture=tuple(racks))
    plan = plan_of(bare)
    stacks = [
        stack
        for room in plan.rooms[:2]
        for stack in furnish(rng, plan, room, STACKS, by_wall=parameters.stacks - 1, count=parameters.stacks)
    ]
    return Design(
        f"warehouse-{seed}", seed, HEIGHT, background=165, start_rooms=tuple(room.name for room in rooms),
        rooms=bare.rooms, walls=walls, furniture=(*racks, *stacks), posters=tuple(posters),
    )  # fmt: skip


def _row(rng: np.random.Generator, row: int, bays: int) -> list[Furniture]:
    """The bays of one row, its letter at both ends."""
    y = round(AISLE + row * (AISLE + DEPTH) + DEPTH / 2, 3)
    letter = f"sign {string.ascii_uppercase[row]}"
    racks = []
    for bay in range(bays):
        changed = rng.random() < CHANGED
        ends = (letter if bay == bays - 1 else "none", letter if bay == 0 else "none")
        racks.append(
            Furniture(
                "rack", (round(END + (bay + 0.5) * BAY, 3), y), BAY, DEPTH, RACK,
                texture="rack changed" if changed else "rack", ends=ends, top="grey 60",
                movable=False, lit=False,
                # Racks that are not changed are the same picture; each sign is its own.
                seed=None if changed or bay in (0, bays - 1) else 0,
            )
        )  # fmt: skip
    return racks


def _signs(rooms: list[Room], length: float) -> list[Poster]:
    """The number of each aisle, at both of its ends, on the wall of the hall."""
    signs = []
    for number, aisle in enumerate(rooms[2:], 1):
        y = round((aisle.low[1] + aisle.high[1]) / 2, 3)
        signs.append(Poster((IN_FRONT, y), 1.0, 0.7, 0.4, f"sign {number}W"))
        signs.append(Poster((length - IN_FRONT, y), 1.0, 0.7, 0.4, f"sign {number}E"))
    return signs


def _notices(rng: np.random.Generator, length: float, width: float) -> list[Poster]:
    """Notices here and there along the two long walls, and in the corners."""
    notices = []
    for y in (IN_FRONT, width - IN_FRONT):
        x = float(rng.uniform(0.6, 1.8))
        while x < length - 0.6:
            w, h, bottom = rng.uniform([0.4, 0.4, 0.3], [0.9, 0.8, 0.7]).round(2).tolist()
            notices.append(Poster((round(x, 3), y), w, h, bottom, str(rng.choice(["print", "sign", "text"]))))
            x += float(rng.uniform(2.2, 4.5))
    return notices

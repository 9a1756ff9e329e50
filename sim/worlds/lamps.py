"""Where lamps hang, and into which rooms they shine."""

from __future__ import annotations

import numpy as np

from sim.floorplan import FloorPlan, distances_to
from sim.worlds.design import DARK, Design, Room, floor_area
from sim.worlds.light import Vector

SPACING = 3.2
"""Lamps hang about this far apart, m."""
DROP = 0.15
"""And this far below the top of the walls, m."""
OPEN = 0.3
"""Light comes from the next room through an edge at least so long, m."""


def lamps_of(design: Design, plan: FloorPlan) -> list[tuple[Vector, ...]]:
    """For each room the lamps that shine into it, in its own frame: its own, and those of rooms it is open to."""
    own = [_hung(room, design.height) for room in design.rooms]
    lamps = []
    for number, room in enumerate(design.rooms):
        others = [k for k in _touching(design, number) if _open(design, plan, number, k)]
        shine = [
            (x + design.rooms[k].low[0] - room.low[0], y + design.rooms[k].low[1] - room.low[1], z)
            for k in others
            for x, y, z in own[k]
        ]
        lamps.append((*own[number], *shine))
    return lamps


def _hung(room: Room, height: float) -> tuple[Vector, ...]:
    """Lamps under the ceiling of a room, m, in the room; none in a door opening."""
    if floor_area(room) < DARK:
        return ()
    length, width = room.high[0] - room.low[0], room.high[1] - room.low[1]
    columns, rows = (max(1, round(side / SPACING)) for side in (length, width))
    return tuple(
        (length * (column + 0.5) / columns, width * (row + 0.5) / rows, height - DROP)
        for row in range(rows)
        for column in range(columns)
    )


def _touching(design: Design, number: int) -> list[int]:
    """Other rooms that touch a room."""
    room = design.rooms[number]
    return [
        k
        for k, other in enumerate(design.rooms)
        if k != number
        and max(other.low[0] - room.high[0], room.low[0] - other.high[0]) <= 1e-6
        and max(other.low[1] - room.high[1], room.low[1] - other.high[1]) <= 1e-6
    ]


def _open(design: Design, plan: FloorPlan, one: int, other: int) -> bool:
    """Whether two rooms that touch share an edge without a wall all along it."""
    rooms = design.rooms[one], design.rooms[other]
    low = np.max([room.low for room in rooms], axis=0)
    high = np.min([room.high for room in rooms], axis=0)
    if (high - low).max() < OPEN:
        return False
    edge = low + np.linspace(0.1, 0.9, 9)[:, None] * (high - low)
    return bool((distances_to(plan.walls, edge) > 1e-6).any())

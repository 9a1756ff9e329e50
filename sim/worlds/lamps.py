"""Where lamps hang, and into which rooms they shine."""

import numpy as np

from mapweave.hybridmap.pose import Array
from mapweave.sim.floorplan import BuildingPlan, distances_to
from mapweave.sim.worlds.design import DARK, Design, Room, floor_area
from mapweave.sim.worlds.layout import exact
from mapweave.sim.worlds.light import Vector

SPACING = 3.2
"""Lamps hang about this far apart, m."""
DROP = 0.15
"""And this far below the top of the walls, m."""
OPEN = 0.3
"""Light comes from the next room through an edge at least so long, m."""


def lamps_of(design: Design, plan: BuildingPlan) -> list[tuple[Vector, ...]]:
    """The lamps of each room that shine into it, in its frame: its own, and those of rooms it is open to."""
    own = [_hung(room, design.height) for room in design.rooms]
    lamps = []
    for number, room in enumerate(design.rooms):
        neighbours = [k for k in _touching(design, number) if _open(design, plan, number, k)]
        shine = [
            own[number],
            *(own[k] + [*np.subtract(design.rooms[k].low, room.low), 0.0] for k in neighbours),
        ]
        lamps.append(tuple((x, y, z) for x, y, z in exact(np.concatenate(shine)).tolist()))
    return lamps


def _hung(room: Room, height: float) -> Array:
    """(N, 3) m, in the room: lamps under its ceiling; none in a door opening."""
    if floor_area(room) < DARK:
        return np.zeros((0, 3))
    size = exact(np.subtract(room.high, room.low))
    columns, rows = np.maximum(np.round(size / SPACING), 1).astype(int).tolist()
    x, y = (size[axis] * (np.arange(n) + 0.5) / n for axis, n in enumerate((columns, rows)))
    x, y = np.meshgrid(x, y)
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, height - DROP)])


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


def _open(design: Design, plan: BuildingPlan, a: int, b: int) -> bool:
    """Whether two rooms that touch share an edge without a wall all along it."""
    rooms = design.rooms[a], design.rooms[b]
    low = np.max([room.low for room in rooms], axis=0)
    high = np.min([room.high for room in rooms], axis=0)
    if (high - low).max() < OPEN:
        return False
    edge = low + np.linspace(0.1, 0.9, 9)[:, None] * (high - low)
    return bool((distances_to(plan.walls, edge) > 1e-6).any())

"""Where the parts of a design are: what they cover on the floor, and to which precision."""

import math

import numpy as np

from mapweave.hybridmap.pose import Array
from mapweave.sim.floorplan import BuildingPlan, Rectangle
from mapweave.sim.worlds.design import Design, Furniture, Room, Wall

QUANTUM = 2.0**-20
"""Panels and lamps are placed to a millionth of a metre: a world moved by whole metres is then drawn the same
to the last bit, which is what makes twin rooms twins."""


def plan_of(design: Design) -> BuildingPlan:
    """The floor plan of a design."""
    return BuildingPlan(
        tuple(room_rectangle(room) for room in design.rooms),
        tuple(wall_rectangle(wall) for wall in design.walls),
        tuple(piece_rectangle(piece) for piece in design.furniture),
    )


def wall_rectangle(wall: Wall) -> Rectangle:
    """What a wall covers; upright, and exact, if its line is."""
    (x0, y0), (x1, y1) = wall.start, wall.end
    half = wall.thickness / 2
    if y0 == y1:
        return Rectangle.spanning(min(x0, x1), y0 - half, max(x0, x1), y0 + half)
    if x0 == x1:
        return Rectangle.spanning(x0 - half, min(y0, y1), x0 + half, max(y0, y1))
    length, heading = math.dist(wall.start, wall.end), math.atan2(y1 - y0, x1 - x0)
    return Rectangle((x0 + x1) / 2, (y0 + y1) / 2, length, wall.thickness, heading)


def piece_rectangle(piece: Furniture) -> Rectangle:
    """What a piece of furniture covers."""
    return Rectangle(*piece.at, piece.length, piece.width, math.radians(piece.heading_deg), piece.name)


def room_rectangle(room: Room) -> Rectangle:
    """What a room covers."""
    return Rectangle.spanning(*room.low, *room.high, room.name)


def exact(points: Array) -> Array:
    """Points on the grid of panels and lamps."""
    rounded: Array = np.round(points / QUANTUM) * QUANTUM
    return rounded

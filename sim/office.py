"""An office: rooms along one corridor, each with a doorway, furniture and prints, all from a seed."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import count

import cv2
import numpy as np

from hybridmap.errors import InvalidValue
from sim import surface
from sim.floorplan import FloorPlan, Rectangle
from sim.texture import Painter, Texture
from sim.world import Block, Panel, World, block_panels, upright_panel

WALL = 0.12
"""Thickness of walls, m."""
HEIGHT = 2.3
"""Height of walls, m."""
DOOR = 1.0
"""Width of doorways, m."""
PASSAGE = 0.45
"""Furniture leaves a way for a disc of this radius from the middle of each room to the corridor, m."""
ROBOT = 0.28
"""Furniture leaves no corner where a disc of this radius fits and cannot get out, m."""
CROWDED = 0.475
"""Centres of furniture are farther apart than this share of their lengths together."""
SEGMENT = 1.3
"""Walls are papered in pieces at most this wide, m."""
TILE = 3.0
"""Floors are laid in pieces at most this long, m."""

MakeTexture = Callable[[float, float, Painter], Texture]
"""A fresh texture of a width and height in m."""

PIECES: dict[str, tuple[float, float, float, Painter]] = {
    "cupboard": (1.0, 0.45, 1.7, surface.cupboard),
    "bookshelf": (1.2, 0.35, 1.5, surface.bookshelf),
    "desk": (1.3, 0.65, 0.72, surface.wood),
    "crate": (0.5, 0.45, 0.6, surface.crate),
}
"""Length and width on the floor and height, m, and what its sides look like."""


def make_office(seed: int, rooms: int = 3) -> World:
    """Build an office.

    Args:
        seed: other seeds, other sizes, doors, furniture and prints.
        rooms: along the corridor, at least 1.

    Raises:
        InvalidValue: a number of rooms that cannot be built.
    """
    if not 1 <= rooms <= 32:
        raise InvalidValue(f"an office has 1 to 32 rooms, not {rooms}")
    rng = np.random.default_rng([seed, 0x0FF1CE])
    plan = _furnished(rng, _plan(rng, rooms))
    numbers = count()

    def texture(width: float, height: float, painter: Painter) -> Texture:
        px = surface.TEXELS_PER_METRE
        size = max(4, round(width * px)), max(4, round(height * px))
        return Texture(*size, (seed, next(numbers)), painter)

    blocks = [Block(wall, 0.0, HEIGHT) for wall in plan.walls]
    panels = [panel for wall in plan.walls for panel in _papered(wall, texture)]
    for piece in plan.furniture:
        _, _, height, painter = PIECES[piece.name]
        block = Block(piece, 0.0, height)
        blocks.append(block)
        widths = (piece.width, piece.length, piece.width, piece.length)
        sides = [texture(width, height, painter) for width in widths]
        panels += block_panels(block, sides, texture(piece.length, piece.width, surface.wood))
    panels += [panel for room in plan.rooms for panel in _floor(room, texture)]
    return World(f"office-{seed}", plan, tuple(blocks), tuple(panels))


def _plan(rng: np.random.Generator, rooms: int) -> FloorPlan:
    """Rooms north of a corridor that runs east; walls with a gap for each door."""
    widths = rng.uniform(3.6, 4.4, rooms)
    depth = float(rng.uniform(3.6, 4.3))
    breadth = float(rng.uniform(1.9, 2.2))
    edges = np.concatenate([[0.0], np.cumsum(widths + WALL)])
    length, top = float(edges[-1]), breadth + WALL + depth
    spaces = [Rectangle.spanning(0.0, 0.0, length - WALL, breadth, "corridor")]
    walls = [
        Rectangle.spanning(-WALL, -WALL, length, 0.0),
        Rectangle.spanning(-WALL, top, length, top + WALL),
        Rectangle.spanning(-WALL, 0.0, 0.0, top),
        Rectangle.spanning(length - WALL, 0.0, length, top),
    ]
    for number in range(rooms):
        left, right = float(edges[number]), float(edges[number + 1]) - WALL
        spaces.append(Rectangle.spanning(left, breadth + WALL, right, top, f"room {number}"))
        door = float(rng.uniform(left + 0.5, right - 0.5 - DOOR))
        spaces.append(Rectangle.spanning(door, breadth, door + DOOR, breadth + WALL, f"door {number}"))
        walls.append(Rectangle.spanning(left, breadth, door, breadth + WALL))
        walls.append(Rectangle.spanning(door + DOOR, breadth, right, breadth + WALL))
        if number:
            walls.append(Rectangle.spanning(left - WALL, breadth, left, top))
    return FloorPlan(tuple(spaces), tuple(walls))


def _furnished(rng: np.random.Generator, plan: FloorPlan) -> FloorPlan:
    """Pieces against the walls and one or two in the room, as many as leave a way to every middle."""
    for room in (r for r in plan.rooms if r.name.startswith("room")):
        for index in range(int(rng.integers(4, 7))):
            name = tuple(PIECES)[int(rng.integers(len(PIECES)))]
            place = _against_wall if index < 4 else _standing
            for _ in range(8):
                piece = place(rng, room, name)
                if not _fits(piece, room, plan.furniture):
                    continue
                tried = plan.furnished(piece)
                if _passable(tried):
                    plan = tried
                    break
    return plan


def _against_wall(rng: np.random.Generator, room: Rectangle, name: str) -> Rectangle:
    length, width, _, _ = PIECES[name]
    side = int(rng.integers(4))
    gap = 0.02
    across, along = (room.length, room.width) if side % 2 == 0 else (room.width, room.length)
    slide = float(rng.uniform(-0.5, 0.5)) * max(along - length, 0.0)
    reach = across / 2 - width / 2 - gap
    heading = side * math.pi / 2
    x = room.x + math.cos(heading) * reach - math.sin(heading) * slide
    y = room.y + math.sin(heading) * reach + math.cos(heading) * slide
    return Rectangle(x, y, length, width, heading + math.pi / 2, name)


def _standing(rng: np.random.Generator, room: Rectangle, name: str) -> Rectangle:
    length, width, _, _ = PIECES[name]
    x = room.x + float(rng.uniform(-0.5, 0.5)) * (room.length - 1.2)
    y = room.y + float(rng.uniform(-0.5, 0.5)) * (room.width - 1.2)
    return Rectangle(x, y, length, width, float(rng.uniform(0.0, math.pi)), name)


def _fits(piece: Rectangle, room: Rectangle, placed: tuple[Rectangle, ...]) -> bool:
    """Whether a piece is inside its (upright) room and neither cuts nor crowds another piece."""
    beyond = np.abs(piece.corners - [room.x, room.y]) - [room.length / 2, room.width / 2]
    if (beyond > 0.0).any():
        return False
    for other in placed:
        if math.hypot(piece.x - other.x, piece.y - other.y) < CROWDED * (piece.length + other.length):
            return False
        if cv2.rotatedRectangleIntersection(_box(piece), _box(other))[0] != cv2.INTERSECT_NONE:
            return False
    return True


def _box(piece: Rectangle) -> tuple[tuple[float, float], tuple[float, float], float]:
    """OpenCV's form of a rectangle."""
    return (piece.x, piece.y), (piece.length, piece.width), math.degrees(piece.heading)


def _passable(plan: FloorPlan) -> bool:
    """Whether the corridor, every doorway and most of every room are one region for a wide disc."""
    regions = plan.free_regions(PASSAGE)
    if not regions:
        return False
    for room in plan.rooms:
        nearest = np.abs(regions[0] - [room.x, room.y]).max(axis=1).min()
        if nearest > (0.08 if room.name.startswith("door") else 0.75):
            return False
    # No pocket in which a robot could start and not get out.
    return len(plan.free_regions(ROBOT)) == 1


def _papered(wall: Rectangle, texture: MakeTexture) -> list[Panel]:
    """The four faces of an upright wall, in pieces with prints of their own."""
    panels = []
    corners = wall.corners
    for first, second in ((1, 2), (2, 3), (3, 0), (0, 1)):
        start, end = corners[first], corners[second]
        width = float(np.linalg.norm(end - start))
        pieces = max(1, math.ceil(width / SEGMENT))
        for k in range(pieces):
            a, b = start + (end - start) * k / pieces, start + (end - start) * (k + 1) / pieces
            paper = texture(width / pieces, HEIGHT, surface.wall)
            panels.append(
                upright_panel((float(a[0]), float(a[1])), (float(b[0]), float(b[1])), 0.0, HEIGHT, paper)
            )
    return panels


def _floor(room: Rectangle, texture: MakeTexture) -> list[Panel]:
    """An upright room's floor in tiles, each seen from above: x to the right, y up the picture."""
    columns, rows = math.ceil(room.length / TILE), math.ceil(room.width / TILE)
    length, width = room.length / columns, room.width / rows
    left, top = room.x - room.length / 2, room.y + room.width / 2
    return [
        Panel(
            np.array([left + column * length, top - row * width, 0.0]),
            np.array([length, 0.0, 0.0]),
            np.array([0.0, -width, 0.0]),
            texture(length, width, surface.floor),
        )
        for row in range(rows)
        for column in range(columns)
    ]

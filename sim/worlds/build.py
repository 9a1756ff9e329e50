"""Builds a world from its design: blocks, panels, textures in the light of lamps."""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.sim.floorplan import Rectangle
from mapweave.sim.surface import TEXELS_PER_METRE
from mapweave.sim.texture import Painter, Texture
from mapweave.sim.world import Block, FurniturePiece, Panel, World, block_panels, upright_panel
from mapweave.sim.worlds.design import DARK, Design, Furniture, Poster, Room, Wall, check_design, floor_area
from mapweave.sim.worlds.faces import BEFORE, cut_face, nearest_face, room_before
from mapweave.sim.worlds.lamps import lamps_of
from mapweave.sim.worlds.layout import exact, plan_of
from mapweave.sim.worlds.light import Lit, Vector
from mapweave.sim.worlds.textures import NOTHING, Textures

TILE = 3.0
"""Floors are laid in pieces at most this long, m."""
OFF_WALL = 0.004
"""Posters hang so far in front of their wall, m."""
NEAR_WALL = 0.5
"""A poster's place is at most so far from its wall, m."""
MAX_TEXELS = 2048
"""Of one texture across and down; larger surfaces are coarser."""
ROOMS, WALLS, FURNITURE, POSTERS, PAINT, SHARED = range(6)
"""What textures' seeds are for."""


def build_world(design: Design, where: str = "world", folder: Path | None = None) -> World:
    """Build a world.

    Args:
        design: from any source.
        where: for the error's text, for example the name of the design's file.
        folder: that names of picture files start from.

    Raises:
        InvalidValue: something in the design cannot be built.
    """
    check_design(design, where)
    return _Builder(design, where, folder or Path()).world()


@dataclass(frozen=True)
class _Seeds:
    """Seeds of one item's textures, one after another.

    What an item shows depends on its own number and seed alone, so that moving or adding another item
    leaves it as it is.
    """

    start: tuple[int, ...]

    def __iter__(self) -> Iterator[tuple[int, ...]]:
        return ((*self.start, k) for k in itertools.count())


class _Builder:
    """What one world's parts have in common: rooms with their light, and textures."""

    def __init__(self, design: Design, where: str, folder: Path) -> None:
        self._design = design
        self._where = where
        self._names = Textures(folder, design.seed)
        self._textures: dict[tuple[object, ...], Texture] = {}
        self._plan = plan_of(design)
        self._low = np.array([room.low for room in design.rooms])
        self._high = np.array([room.high for room in design.rooms])
        self._lamps = lamps_of(design, self._plan)
        self._paints = [self._paint(room) for room in design.rooms]

    def world(self) -> World:
        """All parts, in the order of the design."""
        design, plan = self._design, self._plan
        blocks: list[Block] = []
        panels: list[Panel] = []
        pieces: list[FurniturePiece] = []
        for number, (wall, base) in enumerate(zip(design.walls, plan.walls, strict=True)):
            blocks.append(Block(base, 0.0, self._height(wall)))
            seeds = iter(self._seeds(WALLS, number, wall.seed))
            panels += self._papered(wall, base, seeds, f"{self._where}: walls[{number}]")
        for number, (piece, base) in enumerate(zip(design.furniture, plan.furniture, strict=True)):
            seeds = iter(self._seeds(FURNITURE, number, piece.seed))
            block = Block(base, 0.0, piece.height)
            sides = self._sides(piece, block, seeds, f"{self._where}: furniture[{number}]")
            block_range = range(len(blocks), len(blocks) + 1)
            pieces.append(
                FurniturePiece(block_range, range(len(panels), len(panels) + len(sides)), piece.movable)
            )
            blocks.append(block)
            panels += sides
        for number, poster in enumerate(design.posters):
            seeds = iter(self._seeds(POSTERS, number, poster.seed))
            panels.append(self._hung(poster, seeds, f"{self._where}: posters[{number}]"))
        for number, room in enumerate(design.rooms):
            seeds = iter(self._seeds(ROOMS, number, room.seed))
            panels += self._laid(room, seeds, f"{self._where}: rooms[{number}]")
        return World(
            design.name, plan, tuple(blocks), tuple(panels), design.background, tuple(pieces),
            _start_rooms(design), design.look_along,
        )  # fmt: skip

    def _seeds(self, kind: int, number: int, seed: int | None) -> _Seeds:
        return _Seeds(
            (self._design.seed, SHARED, kind, seed) if seed is not None else (self._design.seed, kind, number)
        )

    def _paint(self, room: Room) -> float:
        if room.paint is not None:
            return float(room.paint)
        number = self._design.rooms.index(room)
        rng = np.random.default_rng(next(iter(self._seeds(PAINT, number, room.seed))))
        return float(rng.uniform(150.0, 200.0))

    def _height(self, wall: Wall) -> float:
        return self._design.height if wall.height is None else wall.height

    def _papered(
        self, wall: Wall, base: Rectangle, seeds: Iterator[tuple[int, ...]], where: str
    ) -> list[Panel]:
        """The four faces of a wall, in pieces."""
        panels: list[Panel] = []
        height = self._height(wall)
        if wall.texture == NOTHING:
            return panels
        corners = base.corners
        for first, second in ((1, 2), (2, 3), (3, 0), (0, 1)):
            for a, b in cut_face(corners[first], corners[second], self._low, self._high):
                bare = upright_panel((a[0], a[1]), (b[0], b[1]), 0.0, height, BLANK)
                panels.append(self._textured(bare, wall.texture, next(seeds), True, where))
        return panels

    def _sides(
        self, piece: Furniture, block: Block, seeds: Iterator[tuple[int, ...]], where: str
    ) -> list[Panel]:
        """The faces of a piece of furniture that are drawn."""
        east, west = piece.ends or (piece.texture, piece.texture)
        names = (east, piece.texture, west, piece.texture, piece.top)
        bare = block_panels(block, [BLANK] * 4, BLANK)
        # Every face takes its seed, drawn or not: another texture on one face changes that face alone.
        faces = zip(bare, names, seeds, strict=False)
        return [self._textured(p, name, seed, piece.lit, where) for p, name, seed in faces if name != NOTHING]

    def _laid(self, room: Room, seeds: Iterator[tuple[int, ...]], where: str) -> list[Panel]:
        """A room's floor in tiles, each seen from above: x to the right, y up the picture."""
        if room.floor == NOTHING:
            return []
        size = np.array(room.high) - room.low
        columns, rows = np.ceil(size / TILE).astype(int).tolist()
        length, width = size[0] / columns, size[1] / rows
        left, top = room.low[0], room.high[1]
        tiles = [
            Panel(
                np.array([left + column * length, top - row * width, 0.0]),
                np.array([length, 0.0, 0.0]),
                np.array([0.0, -width, 0.0]),
                BLANK,
            )
            for row in range(rows)
            for column in range(columns)
        ]
        return [self._textured(tile, room.floor, next(seeds), True, where) for tile in tiles]

    def _hung(self, poster: Poster, seeds: Iterator[tuple[int, ...]], where: str) -> Panel:
        """A poster on the face of the wall that is nearest to its place."""
        at = np.array(poster.at)
        if poster.texture == NOTHING:
            raise InvalidValue(f"{where}: a poster needs a texture")
        nearest, face, number = math.inf, Pose2(), -1
        for index, base in enumerate(self._plan.walls):
            frame, reach, gap = nearest_face(base, at)
            if gap < nearest:
                nearest, face, number = gap, frame, index
                half = reach
        if number < 0 or not 0.0 < nearest <= NEAR_WALL:
            raise InvalidValue(f"{where}: at must be in front of a wall, at most {NEAR_WALL} m from it")
        slide = float(face.inverse().apply(at)[1])
        if abs(slide) + poster.width / 2 > half + 1e-6:
            raise InvalidValue(f"{where}: wider than its wall (walls[{number}]) has place there")
        if poster.bottom + poster.height > self._height(self._design.walls[number]) + 1e-6:
            raise InvalidValue(f"{where}: higher than its wall (walls[{number}])")
        ends = face.apply(
            np.array([[OFF_WALL, slide - poster.width / 2], [OFF_WALL, slide + poster.width / 2]])
        )
        bare = upright_panel(
            (ends[0, 0], ends[0, 1]),
            (ends[1, 0], ends[1, 1]),
            poster.bottom,
            poster.bottom + poster.height,
            BLANK,
        )
        return self._textured(bare, poster.texture, next(seeds), True, where)

    def _textured(self, bare: Panel, name: str, seed: tuple[int, ...], lit: bool, where: str) -> Panel:
        """A panel in its exact place, with its texture; equal textures are one object."""
        corner, right, left = (
            exact(v) for v in (bare.corner, bare.corner + bare.along, bare.corner + bare.down)
        )
        along, down = right - corner, left - corner
        room = self._facing(corner, along, down)
        painter = self._names.painter(name, self._paints[room] if room >= 0 else 180.0, where)
        if lit:
            low = np.array([*self._low[room], 0.0]) if room >= 0 else np.zeros(3)
            lamps = self._lamps[room] if room >= 0 else ()
            painter = Lit(painter, _vector(corner - low), _vector(along), _vector(down), lamps)
        return Panel(corner, along, down, self._texture(painter, along, down, seed))

    def _texture(self, painter: Painter, along: Array, down: Array, seed: tuple[int, ...]) -> Texture:
        size = [round(float(np.linalg.norm(side)) * TEXELS_PER_METRE) for side in (along, down)]
        width, height = (min(max(4, px), MAX_TEXELS) for px in size)
        key = (painter, width, height, seed)
        if key not in self._textures:
            self._textures[key] = Texture(width, height, seed, painter)
        return self._textures[key]

    def _facing(self, corner: Array, along: Array, down: Array) -> int:
        """The room that a panel faces, or -1."""
        # Not by `np.cross`, which takes a tenth of the time that it takes to build an office.
        (ax, ay, az), (dx, dy, dz) = along.tolist(), down.tolist()
        normal = np.array([az * dy - ay * dz, ax * dz - az * dx, ay * dx - ax * dy])
        point = corner + along / 2 + down / 2 + BEFORE * normal / np.linalg.norm(normal)
        return int(room_before(point[None, :2], self._low, self._high)[0])


BLANK = Texture.plain(0)
"""On panels that have no texture yet."""


def _start_rooms(design: Design) -> tuple[str, ...]:
    """The design's start rooms; else the rooms of that name; else all but door openings."""
    called = tuple(room.name for room in design.rooms if room.name.startswith("room"))
    large = tuple(room.name for room in design.rooms if floor_area(room) >= DARK)
    return design.start_rooms or called or large


def _vector(v: Array) -> Vector:
    return float(v[0]), float(v[1]), float(v[2])

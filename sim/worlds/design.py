"""What a world is before it is built: rooms, walls, furniture and posters by name, place and size.

The kinds of world write a design, a world's file holds one, and `mapweave.sim.worlds.build` builds it. All
sizes are in m, in world; x to the east, y to the north.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from mapweave.hybridmap.errors import InvalidValue

THICKNESS = 0.12
"""Of walls, m."""
HEIGHT = 2.3
"""Of walls, m."""
DARK = 1.5
"""Rooms smaller than this are door openings, m^2: no lamp hangs and no robot starts there."""
MAX_ITEMS = 2048
"""Rooms, walls, pieces of furniture, posters: of each."""
MAX_REACH = 1000.0
"""Coordinates are at most this far from the origin, m."""
MAX_AREA = 20_000.0
"""Of all rooms together, and of the building with all that it encloses, m^2."""
MAX_WALLS = 5_000.0
"""Length of all walls together, m."""
MAX_SEED = 2**53
"""Greatest number up to which a float keeps each whole number apart."""

Point = tuple[float, float]


@dataclass(frozen=True)
class Room:
    """Where one may be: a room, a corridor, a door opening. Rooms that touch are open to one another.

    Attributes:
        name: unique.
        low: south-west corner.
        high: north-east corner.
        floor: texture.
        paint: grey of its plastered walls, 1 to 255; by default from the seed.
        seed: rooms with the same seed have the same floor and paint; by default none has.
    """

    name: str
    low: Point
    high: Point
    floor: str = "linoleum"
    paint: int | None = None
    seed: int | None = None

    def check(self, where: str) -> None:
        """Refuse what cannot be built: see `check_design`."""
        _check_text(f"{where}: name", self.name)
        _check_point(f"{where}: low", self.low)
        _check_point(f"{where}: high", self.high)
        if not (self.high[0] - self.low[0] >= 0.02 and self.high[1] - self.low[1] >= 0.02):
            raise InvalidValue(f"{where}: high must be at least 2 cm east and north of low")
        if self.paint is not None:
            within(f"{where}: paint", self.paint, 1, 255)


@dataclass(frozen=True)
class Wall:
    """A wall along a line.

    Attributes:
        start: one end of its middle line.
        end: the other end.
        thickness: half of it on each side of the line.
        height: by default the world's.
        texture: of all its faces.
        seed: walls with the same seed look the same; by default each is different.
    """

    start: Point
    end: Point
    thickness: float = THICKNESS
    height: float | None = None
    texture: str = "wall"
    seed: int | None = None

    def check(self, where: str) -> None:
        """Refuse what cannot be built: see `check_design`."""
        _check_point(f"{where}: start", self.start)
        _check_point(f"{where}: end", self.end)
        if not math.dist(self.start, self.end) >= 0.02:
            raise InvalidValue(f"{where}: start and end must be at least 2 cm apart")
        within(f"{where}: thickness", self.thickness, 0.02, 2.0)
        if self.height is not None:
            within(f"{where}: height", self.height, 0.05, 10.0)


@dataclass(frozen=True)
class Furniture:
    """A box that stands on the floor.

    Attributes:
        name: of the thing.
        at: its middle.
        length: along its own x axis.
        width: along its own y axis.
        height: of its upper face.
        heading_deg: of its x axis, counter-clockwise from east.
        texture: of the faces towards its own +y and -y.
        ends: of the faces towards its own +x and -x; by default the same.
        top: texture of its upper face.
        movable: whether people may push it around.
        lit: whether the lamps of the room shine on it; otherwise it looks the same everywhere.
        seed: pieces with the same seed look the same; by default each is different.
    """

    name: str
    at: Point
    length: float
    width: float
    height: float
    heading_deg: float = 0.0
    texture: str = "wood"
    ends: tuple[str, str] | None = None
    top: str = "wood"
    movable: bool = True
    lit: bool = True
    seed: int | None = None

    def check(self, where: str) -> None:
        """Refuse what cannot be built: see `check_design`."""
        _check_text(f"{where}: name", self.name)
        _check_point(f"{where}: at", self.at)
        for field in ("length", "width", "height"):
            within(f"{where}: {field}", getattr(self, field), 0.02, 10.0)
        within(f"{where}: heading_deg", self.heading_deg, -360.0, 360.0)


@dataclass(frozen=True)
class Poster:
    """A picture on the face of a wall.

    Attributes:
        at: a point in front of the wall, at most half a metre from it, where the picture's middle hangs.
        width: of the picture.
        height: of the picture.
        bottom: height of its lower edge above the floor.
        texture: what is on it.
        seed: posters with the same seed show the same; by default each is its own.
    """

    at: Point
    width: float
    height: float
    bottom: float = 0.3
    texture: str = "print"
    seed: int | None = None

    def check(self, where: str) -> None:
        """Refuse what cannot be built: see `check_design`."""
        _check_point(f"{where}: at", self.at)
        for field in ("width", "height"):
            within(f"{where}: {field}", getattr(self, field), 0.02, 10.0)
        within(f"{where}: bottom", self.bottom, 0.0, 10.0)


Item = Room | Wall | Furniture | Poster


@dataclass(frozen=True)
class Design:
    """A whole world.

    Attributes:
        name: of the world.
        seed: of everything that has no seed of its own.
        height: of walls without a height of their own.
        background: grey above the walls.
        start_rooms: names of the rooms in which robots start; by default those called "room ...", or if no
            room is, all that are larger than a door opening.
        look_along: whether robots start facing along the longer side of their room.
        rooms: at least one.
        walls: solid.
        furniture: solid.
        posters: flat.
    """

    name: str = "world"
    seed: int = 0
    height: float = HEIGHT
    background: int = 200
    start_rooms: tuple[str, ...] = ()
    look_along: bool = False
    rooms: tuple[Room, ...] = ()
    walls: tuple[Wall, ...] = ()
    furniture: tuple[Furniture, ...] = ()
    posters: tuple[Poster, ...] = ()

    @property
    def items(self) -> dict[str, Sequence[Item]]:
        """The items of each kind of list, under its name."""
        return {
            "rooms": self.rooms,
            "walls": self.walls,
            "furniture": self.furniture,
            "posters": self.posters,
        }


def check_design(design: Design, where: str) -> None:
    """Refuse what cannot be built; textures are checked where they are looked up.

    Args:
        design: from anywhere.
        where: for the error's text, for example the file's name.

    Raises:
        InvalidValue: with the item and what is wrong with it.
    """
    within(f"{where}: seed", design.seed, 0, MAX_SEED)
    within(f"{where}: height", design.height, 0.5, 10.0)
    within(f"{where}: background", design.background, 0, 255)
    _check_text(f"{where}: name", design.name)
    for kind, items in design.items.items():
        if len(items) > MAX_ITEMS:
            raise InvalidValue(f"{where}: {len(items)} {kind} are too many; at most {MAX_ITEMS}")
        for number, item in enumerate(items):
            element = f"{where}: {kind}[{number}]"
            if item.seed is not None:
                within(f"{element}: seed", item.seed, 0, MAX_SEED)
            item.check(element)
    _check_rooms(design, where)
    total = sum(math.dist(wall.start, wall.end) for wall in design.walls)
    if total > MAX_WALLS:
        raise InvalidValue(f"{where}: {total:.0f} m of walls are too many; at most {MAX_WALLS:.0f} m")


def floor_area(room: Room) -> float:
    """The floor area of a room, m^2."""
    return (room.high[0] - room.low[0]) * (room.high[1] - room.low[1])


def within(name: str, value: float, low: float, high: float) -> None:
    """Refuse a number that is out of range.

    Raises:
        InvalidValue: it is, or is not finite.
    """
    if not low <= value <= high:
        raise InvalidValue(f"{name} is {value}; use {low:g} to {high:g}")


def _check_rooms(design: Design, where: str) -> None:
    if not design.rooms:
        raise InvalidValue(f"{where}: there is no room; add [[rooms]] with name, low and high")
    names = [room.name for room in design.rooms]
    if len(set(names)) < len(names):
        double = next(name for name in names if names.count(name) > 1)
        raise InvalidValue(f"{where}: two rooms are called {double!r}")
    for name in design.start_rooms:
        if name not in names:
            raise InvalidValue(f"{where}: start_rooms: no room {name!r}; there are {', '.join(names)}")
    area = sum(map(floor_area, design.rooms))
    points = [*(p for r in design.rooms for p in (r.low, r.high))]
    points += [p for wall in design.walls for p in (wall.start, wall.end)]
    xs, ys = zip(*points, strict=True)
    around = (max(xs) - min(xs)) * (max(ys) - min(ys))
    if max(area, around) > MAX_AREA:
        raise InvalidValue(f"{where}: {max(area, around):.0f} m^2 are too large; at most {MAX_AREA:.0f} m^2")


def _check_point(name: str, point: Point) -> None:
    for value in point:
        within(name, value, -MAX_REACH, MAX_REACH)


def _check_text(name: str, text: str) -> None:
    if not 1 <= len(text) <= 64 or not text.isprintable():
        raise InvalidValue(f"{name} is {text[:64]!r}; use 1 to 64 letters that can be printed")

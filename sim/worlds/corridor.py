"""A corridor that leads back to where it began: a long loop, bare plaster between few prints and doors."""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta

from mapweave.hybridmap.errors import InvalidValue
from mapweave.sim.worlds.design import THICKNESS, Design, Point, Poster, Room, Wall

HALF = THICKNESS / 2
CORNER = 0.25
"""Nothing hangs nearer than this to a corner, m."""
IN_FRONT = 0.05
"""How far in front of its wall a print's place is given, m."""


@dataclass(frozen=True)
class CorridorParameters:
    """Size of the ring.

    Attributes:
        length: of the floor from west to east, m.
        width: of the floor from south to north, m.
        breadth: of the corridor, m.
        spacing: from the middle of one print on a wall to the next, m; on the average.
    """

    length: Annotated[float, Meta(ge=4.0, le=100.0)] = 12.0
    width: Annotated[float, Meta(ge=4.0, le=100.0)] = 8.0
    breadth: Annotated[float, Meta(ge=1.2, le=5.0)] = 1.8
    spacing: Annotated[float, Meta(ge=1.2, le=20.0)] = 2.2

    def __post_init__(self) -> None:
        """Refuse sizes that do not fit each other (InvalidValue)."""
        if min(self.length, self.width) < 2 * self.breadth + 1.0:
            raise InvalidValue(
                f"a ring of {self.length:g} x {self.width:g} m has no middle if its corridor is "
                f"{self.breadth:g} m broad; make it 1 m longer and wider than twice its breadth"
            )


def corridor(parameters: CorridorParameters, seed: int) -> Design:
    """Design a ring; other seeds have other prints and doors at other places, all different."""
    rng = np.random.default_rng([seed, 0xC0441D04])
    paint = int(rng.integers(125, 170))
    x, y, b = parameters.length, parameters.width, parameters.breadth
    # Each side has one corner, so that each is longer than it is broad.
    rooms = (
        Room("south", (0.0, 0.0), (x - b, b), paint=paint),
        Room("east", (x - b, 0.0), (x, y - b), paint=paint),
        Room("north", (b, y - b), (x, y), paint=paint),
        Room("west", (0.0, b), (b, y), paint=paint),
    )
    outer = [(0.0, 0.0), (x, 0.0), (x, y), (0.0, y)]
    inner = [(b, b), (b, y - b), (x - b, y - b), (x - b, b)]
    faces = [(ring[k], ring[(k + 1) % 4]) for ring in (outer, inner) for k in range(4)]
    # Outer walls close their corners behind the floor; the inner ones would protrude into it.
    walls = tuple(_behind(*face, THICKNESS if k < 4 else 0.0) for k, face in enumerate(faces))
    posters = tuple(
        poster
        for k, face in enumerate(faces)
        for poster in _hang(rng, *face, parameters.spacing, head=b if k < 4 else 0.0)
    )
    names = tuple(room.name for room in rooms)
    return Design(
        f"corridor-{seed}", seed, start_rooms=names, look_along=True,
        rooms=rooms, walls=walls, posters=posters,
    )  # fmt: skip


def _behind(start: Point, end: Point, longer: float) -> Wall:
    """The wall of a face, longer at both ends; the floor is to the left of the way from `start` to `end`."""
    ahead = np.sign(np.array(end) - start)
    right = np.array([ahead[1], -ahead[0]])
    a, b = start + HALF * right - longer * ahead, end + HALF * right + longer * ahead
    return Wall(_point(a), _point(b), texture="plaster")


def _hang(rng: np.random.Generator, start: Point, end: Point, spacing: float, head: float) -> list[Poster]:
    """Prints, signs and doors along a face at irregular distances.

    Args:
        rng: random numbers.
        start: where the face begins; the floor is to its left.
        end: where it ends.
        spacing: of prints on the average, m.
        head: at both ends so much of the face is what one sees down another side of the ring, m; a print
            hangs there in any case.
    """
    size = math.dist(start, end)
    ahead = (np.array(end) - start) / size
    left = np.array([-ahead[1], ahead[0]])
    posters: list[Poster] = []
    free, last = CORNER, False
    at = float(rng.uniform(0.3, 0.7) * head if head else rng.uniform(0.2, 0.9) * spacing)
    final = size - float(rng.uniform(0.3, 0.7)) * head
    while not last:
        if head and at > final - 0.6 * spacing:
            at, last = final, True
        width, height, bottom, texture = _print(rng)
        middle = max(min(at, size - CORNER - width / 2), free + width / 2)
        if middle + width / 2 > size - CORNER:
            break
        place = _point(start + middle * ahead + IN_FRONT * left)
        posters.append(Poster(place, width, height, bottom, texture))
        free = middle + width / 2 + 0.1
        at = middle + float(rng.uniform(0.55, 1.45)) * spacing
    return posters


def _print(rng: np.random.Generator) -> tuple[float, float, float, str]:
    """Width, height, bottom (m) and texture."""
    chance = rng.random()
    if chance < 0.25:
        return 0.9, 2.0, 0.0, "door"
    if chance < 0.5:
        width, height = rng.uniform([0.3, 0.25], [0.55, 0.4])
        return round(float(width), 2), round(float(height), 2), round(float(rng.uniform(0.2, 0.9)), 2), "sign"
    width, height = rng.uniform([0.45, 0.45], [1.0, 0.85])
    return round(float(width), 2), round(float(height), 2), round(float(rng.uniform(0.1, 0.5)), 2), "print"


def _point(point: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> Point:
    return round(float(point[0]), 3), round(float(point[1]), 3)

"""The furniture of made worlds: what there is, and where pieces are put in a room."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mapweave.sim.floorplan import BuildingPlan, Rectangle
from mapweave.sim.furnishing import RoomSurroundings, against_wall, standing
from mapweave.sim.worlds.design import Furniture
from mapweave.sim.worlds.layout import piece_rectangle

CROWDED = 0.475
"""Centres of furniture are farther apart than this share of their lengths together."""
TRIES = 8
"""Places that are tried for one piece."""

STOCK = (
    Furniture("cupboard", (0.0, 0.0), 1.0, 0.45, 1.7, texture="cupboard"),
    Furniture("bookshelf", (0.0, 0.0), 1.2, 0.35, 1.5, texture="bookshelf"),
    Furniture("desk", (0.0, 0.0), 1.3, 0.65, 0.72, texture="desk"),
    Furniture("crate", (0.0, 0.0), 0.5, 0.45, 0.6, texture="crate"),
)
"""Furniture of offices."""

Place = Callable[[np.random.Generator, Rectangle, Rectangle], Rectangle]


def furnish(
    rng: np.random.Generator,
    plan: BuildingPlan,
    room: Rectangle,
    stock: tuple[Furniture, ...],
    by_wall: int,
    count: int,
) -> list[Furniture]:
    """Put furniture into a room: as much of what is wanted as leaves every way open.

    Args:
        rng: random numbers.
        plan: with the furniture so far.
        room: upright, of the plan.
        stock: what to choose from.
        by_wall: so many of the pieces are placed along the walls.
        count: pieces that are wanted.
    """
    site = RoomSurroundings(plan, room)
    pieces: list[Furniture] = []
    for index in range(count):
        kind = stock[int(rng.integers(len(stock)))]
        place: Place = against_wall if index < by_wall else standing
        for _ in range(TRIES):
            piece = _placed(kind, place(rng, room, piece_rectangle(kind)))
            box = piece_rectangle(piece)
            if not _crowded(piece, pieces) and site.allows(box):
                site.add(box)
                pieces.append(piece)
                break
    return pieces


def _placed(kind: Furniture, place: Rectangle) -> Furniture:
    """A piece of a kind, to the millimetre and the tenth of a degree, so that files are easy to read."""
    heading_deg = round(math.degrees(place.heading), 1)
    return replace(kind, at=(round(place.x, 3), round(place.y, 3)), heading_deg=heading_deg)


def _crowded(piece: Furniture, others: list[Furniture]) -> bool:
    return any(math.dist(piece.at, other.at) < CROWDED * (piece.length + other.length) for other in others)

"""Placement of furniture such that robots reach every place and get stuck nowhere."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Pose2
from mapweave.sim.floorplan import BuildingPlan, Grid, Rectangle, distances_to

PASSAGE = 0.45
"""A disc of this radius gets from the middle of each room to all rooms to which it got before, m."""
ROBOT = 0.28
"""Furniture leaves no new corner where a disc of this radius fits and cannot get out, m."""
MIDDLE = 0.75
"""A way ends at most so far from the middle of a large room, along each axis, m."""
DOORWAY = 0.08
"""And so far from the middle of a doorway, m."""
GAP = 0.02
"""Between furniture and the wall behind it, m."""
AROUND = 1.3
"""Whether a piece is in the way is decided within so much of its room, m."""
AWAY = 0.5
"""Furniture that moves moves at least this far, m."""
TRIES = 40
"""Places that are tried for one piece."""


class RoomSurroundings:
    """One room and what is next to it, while it is being furnished.

    Connections are compared within this part of the building alone: two places that are joined only by a
    way around the building count as apart, so the answer errs on the side of free floor.

    Attributes:
        regions: of floor where a robot fits, in and around the room.
    """

    def __init__(self, plan: BuildingPlan, room: Rectangle, most_regions: int | None = None) -> None:
        """Measure the free floor.

        Args:
            plan: with the furniture so far.
            room: upright, of the plan.
            most_regions: into which what a piece leaves of the floor may fall, if fewer than now.
        """
        x, y = room.length / 2 + AROUND, room.width / 2 + AROUND
        window = (room.x - x, room.y - y, room.x + x, room.y + y)
        window_rectangle = Rectangle.spanning(*window)
        self.room = room
        self._solids = [s for s in (*plan.walls, *plan.furniture) if _near(s, window_rectangle)]
        rooms = [r for r in plan.rooms if _near(r, window_rectangle)]
        self._grid = Grid.of(rooms, self._solids, plan.bounds, window)
        self._middles = [cells for r in rooms if (cells := self._middle(r)).any()]
        self.regions = _components(self._grid, ROBOT)[0]
        self._most = self.regions if most_regions is None else min(self.regions, most_regions)
        passages = _components(self._grid, PASSAGE)[1]
        self._joined = [_labels(passages, cells) for cells in self._middles]

    def allows(self, piece: Rectangle) -> bool:
        """Whether a piece is in the room, cuts nothing, and leaves every way open."""
        return self._fits(piece) and self._leaves_way(piece)

    def add(self, piece: Rectangle) -> None:
        """Add the piece to the plan."""
        self._grid.add(piece)
        self._solids.append(piece)
        self.regions = _components(self._grid, ROBOT)[0]
        self._most = min(self._most, self.regions)

    def _fits(self, piece: Rectangle) -> bool:
        beyond = np.abs(piece.corners - [self.room.x, self.room.y])
        if (beyond > [self.room.length / 2, self.room.width / 2]).any():
            return False
        return not overlap(piece, self._solids)

    def _leaves_way(self, piece: Rectangle) -> bool:
        grid = self._grid.with_box(piece)
        if _components(grid, ROBOT)[0] > self._most:
            return False
        passages = _components(grid, PASSAGE)[1]
        now = [_labels(passages, cells) for cells in self._middles]
        # Rooms that one region reached are still reached by one region.
        for k, before in enumerate(self._joined):
            for other in range(k + 1):
                if before & self._joined[other] and not now[k] & now[other]:
                    return False
        return True

    def _middle(self, room: Rectangle) -> NDArray[np.bool_]:
        """(rows, columns) the cells that count as a room's middle."""
        slack = min(MIDDLE, max(DOORWAY, 0.35 * min(room.length, room.width)))
        return np.asarray(np.abs(self._grid.centres - [room.x, room.y]).max(axis=2) <= slack)


@dataclass(frozen=True)
class Move:
    """A piece of furniture at another place.

    Attributes:
        index: in the plan's furniture.
        place: where now.
    """

    index: int
    place: Rectangle


def rearrange(
    plan: BuildingPlan,
    movable: Sequence[int],
    wanted: int,
    rng: np.random.Generator,
    keep_clear: Sequence[Pose2],
    clearance: float,
) -> tuple[BuildingPlan, list[Move]]:
    """Move furniture to other places in its room.

    Args:
        plan: the building.
        movable: indices into its furniture.
        wanted: how many pieces; fewer move where there is no other place for more.
        rng: random numbers.
        keep_clear: robots, `world_from_robot`.
        clearance: from the middle of a robot to a piece that moves, m.

    Returns:
        The new plan, its furniture in the same order, and what moved.
    """
    robots = np.array([[pose.x, pose.y] for pose in keep_clear]).reshape(-1, 2)
    moves: list[Move] = []
    for index in rng.permutation(np.asarray(movable, dtype=np.intp)).tolist():
        if len(moves) >= wanted:
            break
        piece = plan.furniture[index]
        name = plan.room_at(piece.x, piece.y)
        if name is None:
            continue
        room = plan.room(name)
        others = (*plan.furniture[:index], *plan.furniture[index + 1 :])
        # The piece may have filled a corner that must not become a trap without it.
        site = RoomSurroundings(
            replace(plan, furniture=others), room, most_regions=RoomSurroundings(plan, room).regions
        )
        for _ in range(TRIES):
            place = (against_wall if rng.random() < 0.6 else standing)(rng, room, piece)
            if math.hypot(place.x - piece.x, place.y - piece.y) < AWAY:
                continue
            if len(robots) and distances_to([place], robots).min() < clearance:
                continue
            if site.allows(place):
                moves.append(Move(index, place))
                furniture = (*plan.furniture[:index], place, *plan.furniture[index + 1 :])
                plan = replace(plan, furniture=furniture)
                break
    return plan, moves


def against_wall(rng: np.random.Generator, room: Rectangle, piece: Rectangle) -> Rectangle:
    """A piece of the same size somewhere along a side of an upright room."""
    side = int(rng.integers(4))
    across, along = (room.length, room.width) if side % 2 == 0 else (room.width, room.length)
    slide = float(rng.uniform(-0.5, 0.5)) * max(along - piece.length, 0.0)
    reach = across / 2 - piece.width / 2 - GAP
    heading = side * math.pi / 2
    x = room.x + math.cos(heading) * reach - math.sin(heading) * slide
    y = room.y + math.sin(heading) * reach + math.cos(heading) * slide
    return replace(piece, x=x, y=y, heading=heading + math.pi / 2)


def standing(rng: np.random.Generator, room: Rectangle, piece: Rectangle) -> Rectangle:
    """A piece of the same size anywhere in an upright room, turned anyhow."""
    x = room.x + float(rng.uniform(-0.5, 0.5)) * max(room.length - 1.2, 0.0)
    y = room.y + float(rng.uniform(-0.5, 0.5)) * max(room.width - 1.2, 0.0)
    return replace(piece, x=x, y=y, heading=float(rng.uniform(0.0, math.pi)))


def overlap(piece: Rectangle, others: Iterable[Rectangle]) -> bool:
    """Whether a piece covers any of several rectangles in part."""
    box = _box(piece)
    boxes = (_box(other) for other in others if _near(piece, other))
    return any(cv2.rotatedRectangleIntersection(box, other)[0] != cv2.INTERSECT_NONE for other in boxes)


def _components(grid: Grid, radius: float) -> tuple[int, NDArray[np.int32]]:
    """How many regions a disc of a radius has, and (rows, columns) which one each cell is in; 0 is none."""
    count, labels = cv2.connectedComponents((grid.clearances >= radius).astype(np.uint8), connectivity=4)
    return count - 1, np.asarray(labels, np.int32)


def _labels(labels: NDArray[np.int32], cells: NDArray[np.bool_]) -> set[int]:
    return set(np.unique(labels[cells]).tolist()) - {0}


def _near(a: Rectangle, b: Rectangle) -> bool:
    """Whether the circles around two rectangles meet."""
    reach = math.hypot(a.length, a.width) / 2 + math.hypot(b.length, b.width) / 2
    return math.hypot(a.x - b.x, a.y - b.y) <= reach


def _box(piece: Rectangle) -> tuple[tuple[float, float], tuple[float, float], float]:
    """OpenCV's form of a rectangle."""
    return (piece.x, piece.y), (piece.length, piece.width), math.degrees(piece.heading)

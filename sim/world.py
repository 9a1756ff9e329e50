"""A world: solid blocks for the physics, textured panels for the cameras, a floor plan for people."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.sim.floorplan import BuildingPlan, Rectangle
from mapweave.sim.furnishing import rearrange
from mapweave.sim.start_poses import spread
from mapweave.sim.texture import Texture


@dataclass(frozen=True, slots=True)
class Block:
    """A solid box that stands on, or hangs above, a rectangle of the floor.

    Attributes:
        base: where.
        bottom: height of its lower face, m.
        top: height of its upper face, m.
    """

    base: Rectangle
    bottom: float
    top: float


@dataclass(frozen=True, eq=False)
class Panel:
    """A textured parallelogram, seen from its front alone.

    Attributes:
        corner: (3,) m, in world (or in the robot that carries it): upper left as seen from the front.
        along: (3,) m, from the upper left to the upper right corner.
        down: (3,) m, from the upper left to the lower left corner.
        texture: what is on it.
    """

    corner: Array
    along: Array
    down: Array
    texture: Texture


class PanelSet:
    """N panels in columns, the form in which they are drawn.

    Attributes:
        corner: (N, 3) m.
        along: (N, 3) m.
        down: (N, 3) m.
        textures: N.
    """

    def __init__(self, corner: Array, along: Array, down: Array, textures: Sequence[Texture]) -> None:
        """Take columns of equal length."""
        self.corner = corner
        self.along = along
        self.down = down
        self.textures = tuple(textures)

    @staticmethod
    def of(panels: Sequence[Panel]) -> PanelSet:
        """Make it of single panels."""
        columns = [
            np.array([getattr(p, name) for p in panels], dtype=np.float64).reshape(-1, 3)
            for name in ("corner", "along", "down")
        ]
        return PanelSet(columns[0], columns[1], columns[2], [p.texture for p in panels])

    @staticmethod
    def joined(sets: Sequence[PanelSet]) -> PanelSet:
        """All panels of several sets."""
        return PanelSet(
            np.concatenate([s.corner for s in sets]),
            np.concatenate([s.along for s in sets]),
            np.concatenate([s.down for s in sets]),
            [texture for s in sets for texture in s.textures],
        )


def upright_panel(
    start: tuple[float, float], end: tuple[float, float], bottom: float, top: float, texture: Texture
) -> Panel:
    """A panel on a wall. Its front is where, looking at it, `start` is left and `end` is right."""
    return Panel(
        np.array([*start, top]),
        np.array([end[0] - start[0], end[1] - start[1], 0.0]),
        np.array([0.0, 0.0, bottom - top]),
        texture,
    )


def block_panels(block: Block, sides: Sequence[Texture], top: Texture | None = None) -> list[Panel]:
    """The four sides, and the upper face, of a block.

    Args:
        block: the block.
        sides: four, for the faces towards its own +x, +y, -x and -y.
        top: for the upper face, if it can be seen.
    """
    base = block.base
    frame = Pose2(base.x, base.y, base.heading)
    panels = []
    for quarter, texture in enumerate(sides):
        face = frame @ Pose2(heading=quarter * math.pi / 2)
        reach, half = (base.length / 2, base.width / 2)[:: 1 if quarter % 2 == 0 else -1]
        ends = face.apply(np.array([[reach, -half], [reach, half]]))
        # Seen from outside, with the face's normal towards the viewer, -y is on the left.
        panels.append(
            upright_panel(
                (float(ends[0, 0]), float(ends[0, 1])),
                (float(ends[1, 0]), float(ends[1, 1])),
                block.bottom,
                block.top,
                texture,
            )
        )
    if top is not None:
        corners = np.column_stack([base.corners, np.full(4, block.top)])
        panels.append(Panel(corners[3], corners[2] - corners[3], corners[0] - corners[3], top))
    return panels


@dataclass(frozen=True, slots=True)
class FurniturePiece:
    """The blocks and panels of one piece of furniture.

    Attributes:
        blocks: which of the world's blocks, a range.
        panels: which of the world's panels, a range.
        movable: whether people push it around.
    """

    blocks: range
    panels: range
    movable: bool = True


START_CLEARANCE = 0.45
"""Of a robot that starts, from its middle to walls and furniture, m."""
ROBOT_CLEARANCE = 0.5
"""From the middle of a robot to where furniture is put down, m."""


@dataclass(frozen=True, eq=False)
class World:
    """All static things.

    Attributes:
        name: of the world.
        plan: seen from above.
        blocks: solid for robots and rangers.
        panels: visible for cameras.
        background: grey where no panel is (the ceiling).
        pieces: one for each of `plan.furniture`, in the same order; empty if unknown, and then nothing can be
            moved.
        start_rooms: names of the rooms in which robots start; by default those called "room ...".
        look_along: whether robots start facing along the longer side of their room.
    """

    name: str
    plan: BuildingPlan
    blocks: tuple[Block, ...]
    panels: tuple[Panel, ...]
    background: int = 200
    pieces: tuple[FurniturePiece, ...] = ()
    start_rooms: tuple[str, ...] = ()
    look_along: bool = False

    def start_poses(self, robots: int, seed: int) -> tuple[Pose2, ...]:
        """Free poses, robot i in room i (counted around), where no two robots come close.

        Raises:
            InvalidValue: there is no room to start in, or so many robots do not fit.
        """
        names = [room.name for room in self.plan.rooms]
        rooms = self.start_rooms or tuple(name for name in names if name.startswith("room"))
        if not rooms:
            raise InvalidValue(f"world {self.name} has no room to start in")
        return spread(self.plan, rooms, robots, START_CLEARANCE, self.look_along, seed)

    def rearranged(self, seed: int, share: float, keep_clear: Sequence[Pose2] = ()) -> World:
        """The same world after people have moved furniture: other places in the same rooms.

        Blocks, panels and furniture keep their order and textures, so what did not move is the same object
        at the same index. Every room that could be reached still can.

        Args:
            seed: other seeds, other pieces and places.
            share: of the furniture that moves, 0 to 1, at least one piece; less where there is no place.
            keep_clear: robots, `world_from_robot`, near which nothing is put down.

        Raises:
            InvalidValue: no such share, or nothing that can be moved.
        """
        if not 0.0 < share <= 1.0:
            raise InvalidValue(f"a share of the furniture is more than 0 and at most 1, not {share}")
        movable = [k for k, piece in enumerate(self.pieces) if piece.movable]
        rng = np.random.default_rng([seed, 0x3E44A])
        wanted = max(1, round(share * len(movable)))
        plan, moves = rearrange(self.plan, movable, wanted, rng, keep_clear, ROBOT_CLEARANCE)
        if not moves:
            raise InvalidValue(f"world {self.name} has no furniture that can be moved within its room")
        blocks, panels = list(self.blocks), list(self.panels)
        for move in moves:
            piece, old = self.pieces[move.index], self.plan.furniture[move.index]
            motion = (
                Pose2(move.place.x, move.place.y, move.place.heading)
                @ Pose2(old.x, old.y, old.heading).inverse()
            )
            for k in piece.blocks:
                blocks[k] = replace(blocks[k], base=moved_rectangle(blocks[k].base, motion))
            for k in piece.panels:
                panels[k] = moved_panel(panels[k], motion)
        return replace(self, plan=plan, blocks=tuple(blocks), panels=tuple(panels))


def moved_rectangle(rectangle: Rectangle, motion: Pose2) -> Rectangle:
    """Where a rectangle is after a motion of the floor, `new_from_old`."""
    place = motion @ Pose2(rectangle.x, rectangle.y, rectangle.heading)
    return replace(rectangle, x=place.x, y=place.y, heading=place.heading)


def moved_panel(panel: Panel, motion: Pose2) -> Panel:
    """Where a panel is after a motion over the floor, `new_from_old`."""
    turn = Pose2(heading=motion.heading)
    return replace(
        panel, corner=motion.apply(panel.corner), along=turn.apply(panel.along), down=turn.apply(panel.down)
    )

"""Worlds measured by their blocks and panels, not by their own plan."""

import cv2
import numpy as np
import pytest

from mapweave import Camera, Pose2
from mapweave.sim.floorplan import Rectangle
from mapweave.sim.renderer import Renderer
from mapweave.sim.world import Block, Panel, PanelSet, World
from mapweave.sim.worlds.catalog import make_world

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, mount_height=0.3)
ROBOT = 0.28
"""Radius of the robot, and what it keeps from walls, m."""
SCALE = 40
"""Pixels a metre of drawn floor plans."""
SLACK = 1.5 / SCALE
"""What drawn distances are uncertain by, m."""
CASES: dict[str, tuple[str, dict[str, object]]] = {
    "office": ("office", {}),
    "corridor": ("corridor", {}),
    "warehouse": ("warehouse", {}),
    "twins": ("twins", {}),
    "joined twins": ("twins", {"joined": True}),
    "arena": ("arena", {"boxes": 5}),
    "large corridor": ("corridor", {"length": 21.0, "width": 6.5, "breadth": 2.4, "spacing": 4.0}),
    "small warehouse": ("warehouse", {"rows": 1, "bays": 2, "stacks": 2}),
    "large twins": ("twins", {"joined": True, "length": 7.31, "width": 5.17}),
}
SEEDS = (1, 5)
WORLDS = [(name, seed) for name in CASES for seed in SEEDS]
_built: dict[tuple[str, int], World] = {}


def world_of(name: str, seed: int) -> World:
    """Built once for all tests: worlds do not change, and their pictures are painted once."""
    if (name, seed) not in _built:
        kind, parameters = CASES[name]
        _built[name, seed] = make_world(kind, seed, **parameters)
    return _built[name, seed]


def walls_of(world: World) -> list[Block]:
    """Blocks that are no furniture."""
    furniture = {k for piece in world.pieces for k in piece.blocks}
    return [block for k, block in enumerate(world.blocks) if k not in furniture]


def corners_of(panel: Panel) -> np.ndarray:
    """(4, 3) m."""
    c, a, d = panel.corner, panel.along, panel.down
    return np.array([c, c + a, c + a + d, c + d])


def local_to(base: Rectangle, points: np.ndarray) -> np.ndarray:
    """(N, 2) points in a rectangle's frame, by complex numbers rather than by `Pose2`."""
    z = (points[:, 0] + 1j * points[:, 1] - (base.x + 1j * base.y)) * np.exp(-1j * base.heading)
    return np.column_stack([z.real, z.imag])


def lies_on(panel: Panel, block: Block, off: float) -> bool:
    """Whether a panel lies on a side or the top of a block, or so far before a side, and looks outward."""
    corners = corners_of(panel)
    local = local_to(block.base, corners[:, :2])
    half = np.array([block.base.length, block.base.width]) / 2
    beyond = local - np.clip(local, -half, half)
    heights = corners[:, 2]
    if (
        np.abs(beyond).max() > off + 1e-5
        or heights.min() < block.bottom - 1e-5
        or heights.max() > block.top + 1e-5
    ):
        return False
    outward = -np.cross(panel.along, panel.down)
    outward /= np.linalg.norm(outward)
    if np.ptp(heights) < 1e-5:
        return bool(np.abs(heights - block.top).max() < 1e-5 and outward[2] > 0.999)
    middle = local.mean(axis=0)
    ahead = local_to(block.base, (corners.mean(axis=0) + outward)[None, :2])[0] - middle
    axis = int(np.argmax(np.abs(ahead)))
    side = np.sign(ahead[axis]) * (half[axis] + off)
    return bool(abs(abs(ahead[axis]) - 1.0) < 1e-5 and np.abs(local[:, axis] - side).max() < 1e-5)


def area(panel: Panel) -> float:
    """m^2."""
    return float(np.linalg.norm(np.cross(panel.along, panel.down)))


def check_panels(world: World) -> None:
    """Every panel is on a block, a poster before a wall, or floor; and nothing is left bare."""
    furniture = {k: n for n, piece in enumerate(world.pieces) for k in piece.panels}
    walls, floors, papered = walls_of(world), 0.0, 0.0
    for number, panel in enumerate(world.panels):
        if number in furniture:
            piece = world.pieces[furniture[number]]
            assert any(lies_on(panel, world.blocks[k], 0.0) for k in piece.blocks)
        elif np.abs(corners_of(panel)[:, 2]).max() < 1e-9:
            middle = corners_of(panel).mean(axis=0)
            assert world.plan.room_at(middle[0], middle[1]) is not None
            assert np.cross(panel.down, panel.along)[2] > 0
            floors += area(panel)
        elif any(lies_on(panel, block, 0.0) for block in walls):
            papered += area(panel)
        else:
            assert any(lies_on(panel, block, 0.004) for block in walls)
    assert floors == pytest.approx(sum(r.length * r.width for r in world.plan.rooms), rel=1e-4)
    bare = sum(2 * (b.base.length + b.base.width) * (b.top - b.bottom) for b in walls)
    assert papered == pytest.approx(bare, rel=1e-4)


class Drawing:
    """Solid things of a world's blocks drawn as polygons; distances by OpenCV's transform."""

    def __init__(self, world: World) -> None:
        """Draw."""
        corners = np.concatenate([block.base.corners for block in world.blocks])
        self._origin = corners.min(axis=0)
        size = np.ceil((corners.max(axis=0) - self._origin) * SCALE).astype(int) + 2
        free = np.full((size[1], size[0]), 255, np.uint8)
        for block in world.blocks:
            cv2.fillPoly(free, [np.round((block.base.corners - self._origin) * SCALE).astype(np.int32)], 0)
        free[0], free[-1], free[:, 0], free[:, -1] = 0, 0, 0, 0
        self.distances = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) / SCALE

    def at(self, x: float, y: float) -> tuple[int, int]:
        """Row and column."""
        column, row = np.round((np.array([x, y]) - self._origin) * SCALE).astype(int)
        return int(row), int(column)

    def regions(self, world: World) -> dict[str, set[int]]:
        """For each room the regions of floor that a robot can start in there.

        Drawn edges are rounded: regions are joined wherever a robot may just fit, and count where it
        fits in any case.
        """
        _, labels = cv2.connectedComponents((self.distances > ROBOT - SLACK).astype(np.uint8))
        labels[self.distances < ROBOT + SLACK] = 0
        collected = {}
        for room in world.plan.rooms:
            low, high = self.at(*room.corners[0]), self.at(*room.corners[2])
            inside = labels[low[0] : high[0] + 1, low[1] : high[1] + 1]
            collected[room.name] = set(np.unique(inside).tolist()) - {0}
        return collected


def picture(world: World, pose: Pose2) -> np.ndarray:
    """What a camera sees."""
    rotation = np.eye(3)
    rotation[:2, :2] = pose.rotation
    return Renderer(CAMERA, world.background).render(
        PanelSet.of(world.panels), rotation, np.array([pose.x, pose.y, 0.0])
    )

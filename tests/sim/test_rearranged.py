"""Worlds whose furniture has been moved: everything else stays, and robots get through."""

import math

import cv2
import numpy as np
import pytest

from mapweave.hybridmap.errors import InvalidValue
from tests.quick import first_quick
from tests.sim.measured_world import SEEDS, Drawing, check_panels, local_to, world_of

MOVING = [
    (name, seed) for name in ("office", "warehouse", "twins", "joined twins", "arena") for seed in SEEDS
]


@pytest.mark.parametrize(("name", "seed"), first_quick(MOVING, 1))
def test_rearranged_worlds_keep_everything_else(name: str, seed: int):
    """What did not move is the same object; what did is the same box with the same pictures elsewhere."""
    world = world_of(name, seed)
    moved = world.rearranged(seed, 0.4)
    again = world.rearranged(seed, 0.4)
    assert moved.plan == again.plan
    assert moved.blocks == again.blocks
    assert (moved.plan.rooms, moved.plan.walls) == (world.plan.rooms, world.plan.walls)
    assert (len(moved.blocks), len(moved.panels)) == (len(world.blocks), len(world.panels))
    check_panels(moved)
    changed = [
        k for k, (a, b) in enumerate(zip(world.plan.furniture, moved.plan.furniture, strict=True)) if a != b
    ]
    movable = sum(piece.movable for piece in world.pieces)
    assert 1 <= len(changed) <= max(1, round(0.4 * movable))
    blocks = {k for n in changed for k in world.pieces[n].blocks}
    panels = {k for n in changed for k in world.pieces[n].panels}
    for k, (old, new) in enumerate(zip(world.blocks, moved.blocks, strict=True)):
        assert (old is new) == (k not in blocks)
    for k, (seen, now) in enumerate(zip(world.panels, moved.panels, strict=True)):
        assert (seen is now) == (k not in panels)
        assert seen.texture is now.texture
    for n in changed:
        old_place, place = world.plan.furniture[n], moved.plan.furniture[n]
        assert world.pieces[n].movable
        assert (old_place.length, old_place.width, old_place.name) == (place.length, place.width, place.name)
        assert math.dist((old_place.x, old_place.y), (place.x, place.y)) >= 0.5
        assert world.plan.room_at(old_place.x, old_place.y) == world.plan.room_at(place.x, place.y)
        base = moved.blocks[world.pieces[n].blocks[0]].base
        np.testing.assert_allclose(base.corners, place.corners, atol=1e-9)


@pytest.mark.parametrize(("name", "seed"), first_quick(MOVING, 1))
def test_rearranged_worlds_can_be_driven_through(name: str, seed: int):
    """However often: no room is cut off, no corner catches a robot, nothing stands in anything."""
    world = world_of(name, seed)
    before = Drawing(world).regions(world)
    for step in range(2):
        world = world.rearranged(step, 1.0)
        after = Drawing(world).regions(world)
        assert len(set.union(*after.values())) <= len(set.union(*before.values()))
        names = list(before)
        for k, first in enumerate(names):
            for second in names[: k + 1]:
                assert bool(before[first] & before[second]) == bool(after[first] & after[second])
        solid = [*world.plan.walls, *world.plan.furniture]
        for piece in (f for f, p in zip(world.plan.furniture, world.pieces, strict=True) if p.movable):
            for second in (s for s in solid if s is not piece):
                boxes = [
                    ((b.x, b.y), (b.length - 0.01, b.width - 0.01), np.degrees(b.heading))
                    for b in (piece, second)
                ]
                assert cv2.rotatedRectangleIntersection(*boxes)[0] == cv2.INTERSECT_NONE


def test_furniture_is_not_put_down_near_robots():
    """Half a metre stays clear around each; without that wish, over many seeds, it does not."""
    world = world_of("arena", 1)
    robots = world.start_poses(12, 4)
    points = np.array([[p.x, p.y] for p in robots])
    nearest = {True: math.inf, False: math.inf}
    for seed in range(8):
        for keep in (True, False):
            moved = world.rearranged(seed, 1.0, robots if keep else ())
            for old, new in zip(world.plan.furniture, moved.plan.furniture, strict=True):
                if old != new:
                    local = np.abs(local_to(new, points)) - [new.length / 2, new.width / 2]
                    gaps = np.linalg.norm(np.maximum(local, 0.0), axis=1)
                    nearest[keep] = min(nearest[keep], float(gaps.min()))
    assert nearest[True] >= 0.5
    assert nearest[False] < 0.5


@pytest.mark.parametrize("share", [0.0, -0.1, 1.01, math.nan, math.inf])
def test_shares_that_are_none_are_refused(share: float):
    with pytest.raises(InvalidValue, match="share of the furniture"):
        world_of("office", 1).rearranged(1, share)


def test_a_world_without_furniture_cannot_be_rearranged():
    with pytest.raises(InvalidValue, match="no furniture that can be moved"):
        world_of("corridor", 1).rearranged(1, 0.5)

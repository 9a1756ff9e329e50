"""Worlds of every kind and several seeds, measured by their blocks and panels, not by their own plan."""

import math

import numpy as np
import pytest

from mapweave.hybridmap.errors import InvalidValue
from mapweave.sim.worlds.catalog import make_world
from tests.quick import first_quick
from tests.sim.measured_world import (
    CASES,
    WORLDS,
    Drawing,
    check_panels,
    local_to,
    picture,
    walls_of,
    world_of,
)


@pytest.mark.parametrize(("name", "seed"), WORLDS)
def test_panels_lie_on_their_blocks(name: str, seed: int):
    """Walls are papered all over, furniture looks outward, posters hang before walls, floors are laid."""
    check_panels(world_of(name, seed))


@pytest.mark.parametrize(("name", "seed"), WORLDS)
def test_walls_are_closed(name: str, seed: int):
    """No ray from anywhere in a room leaves the building without meeting a wall, by the slab method."""
    world = world_of(name, seed)
    rng = np.random.default_rng(seed)
    angles = np.linspace(-math.pi, math.pi, 720, endpoint=False) + rng.uniform(0, 0.01)
    for room in world.plan.rooms:
        x, y = (
            room.x + rng.uniform(-0.45, 0.45) * room.length,
            room.y + rng.uniform(-0.45, 0.45) * room.width,
        )
        nearest = np.full(angles.shape, np.inf)
        for block in walls_of(world):
            assert block.bottom == 0.0
            start = local_to(block.base, np.array([[x, y]]))[0]
            turned = angles - block.base.heading
            way = np.stack([np.cos(turned), np.sin(turned)])
            half = np.array([block.base.length, block.base.width])[:, None] / 2
            first, second = (-half - start[:, None]) / way, (half - start[:, None]) / way
            enter = np.minimum(first, second).max(axis=0)
            leave = np.maximum(first, second).min(axis=0)
            nearest = np.where((enter <= leave) & (enter >= 0), np.minimum(nearest, enter), nearest)
        assert np.isfinite(nearest).all(), room.name


@pytest.mark.parametrize(("name", "seed"), WORLDS)
def test_all_floor_is_one_region(name: str, seed: int):
    """For a robot with a margin; but the closed twins are two."""
    world = world_of(name, seed)
    regions = Drawing(world).regions(world)
    if name == "twins":
        assert len(regions["room 0"]) == len(regions["room 1"]) == 1
        assert not regions["room 0"] & regions["room 1"]
    else:
        assert len(set.union(*regions.values())) == len(set.intersection(*regions.values())) == 1


@pytest.mark.parametrize(("name", "seed"), WORLDS)
def test_sixteen_robots_can_start(name: str, seed: int):
    """Clear of everything and of one another, robot by robot in the rooms in turn, the same every time."""
    world = world_of(name, seed)
    small = name in ("small warehouse",)
    robots = 8 if small else 16
    poses = world.start_poses(robots, seed)
    assert poses == world.start_poses(robots, seed)
    assert poses != world.start_poses(robots, seed + 1)
    drawing = Drawing(world)
    for robot, pose in enumerate(poses):
        assert drawing.distances[drawing.at(pose.x, pose.y)] > 0.45 - 0.05
        assert all(pose.distance(other) >= 0.61 for other in poses[:robot])
    rooms = [world.plan.room_at(pose.x, pose.y) for pose in poses]
    if "twins" in name:
        assert rooms == [f"room {k % 2}" for k in range(robots)]
    if "corridor" in name:
        assert rooms[:4] == ["south", "east", "north", "west"]
        for room, pose in zip(rooms, poses, strict=True):
            across = math.sin(pose.heading) if room in ("south", "north") else math.cos(pose.heading)
            assert abs(across) < math.sin(0.16)


@pytest.mark.parametrize("name", ["twins", "small warehouse"])
def test_too_many_robots_are_refused_with_the_number_that_fits(name: str):
    world = world_of(name, 1)
    with pytest.raises(InvalidValue, match="make the world larger") as caught:
        world.start_poses(400, 1)
    fit = int(str(caught.value).split()[1])
    assert fit >= 8
    poses = world.start_poses(fit, 1)
    assert len(poses) == fit
    assert all(p.distance(q) >= 0.61 for k, p in enumerate(poses) for q in poses[:k])


@pytest.mark.parametrize("name", first_quick(["office", "joined twins", "corridor", "warehouse", "arena"], 2))
def test_the_same_seed_gives_the_same_world(name: str):
    """To the last bit of its places and pictures; another seed gives another."""
    kind, parameters = CASES[name]
    first, again, second = world_of(name, 1), make_world(kind, 1, **parameters), world_of(name, 2)
    assert first.plan == again.plan
    assert first.blocks == again.blocks
    for a, b in zip(first.panels, again.panels, strict=True):
        assert all((getattr(a, n) == getattr(b, n)).all() for n in ("corner", "along", "down"))
        assert (a.texture.seed, a.texture.painter) == (b.texture.seed, b.texture.painter)
    pose = first.start_poses(1, 3)[0]
    assert (picture(first, pose) == picture(again, pose)).all()
    assert not (picture(first, pose) == picture(second, pose)).all()

"""What there is to see in worlds of every kind: what is alike, what differs, and how much there is."""

import math

import cv2
import numpy as np
import pytest

from mapweave.hybridmap.pose import Pose2
from mapweave.sim.world import World
from mapweave.sim.worlds.catalog import make_design
from tests.quick import first_quick
from tests.sim.measured_world import ROBOT, SEEDS, corners_of, picture, world_of


def twin_poses(world: World) -> list[Pose2]:
    """Poses in the first of two rooms, on a grid to which whole metres are added without rounding."""
    rng = np.random.default_rng(8)
    poses = []
    while len(poses) < 12:
        pose = world.plan.random_free_pose(rng, ROBOT, "room 0")
        poses.append(Pose2(round(pose.x * 1024) / 1024, round(pose.y * 1024) / 1024, pose.heading))
    return poses


@pytest.mark.parametrize("name", first_quick(["joined twins", "twins", "large twins"], 1))
@pytest.mark.parametrize("seed", SEEDS)
def test_twins_look_exactly_the_same(name: str, seed: int):
    """The same pose in the other room gives the same image to the last bit, unless one sees the corridor."""
    world = world_of(name, seed)
    rooms = [world.plan.room(f"room {k}") for k in (0, 1)]
    east = rooms[1].x - rooms[0].x
    assert east == round(east)
    seen = 0
    for pose in twin_poses(world):
        toward_door = "joined" in name or "large" in name
        if toward_door and math.sin(pose.heading) < 0.55:
            continue
        seen += 1
        first, second = picture(world, pose), picture(world, Pose2(pose.x + east, pose.y, pose.heading))
        assert (first == second).all()
        assert first.std() > 3
    assert seen >= 2


def test_joined_twins_differ_where_the_corridor_shows():
    """Nothing in the corridor is there twice: neither on its walls nor on its floor."""
    world = world_of("joined twins", 1)
    corridor = world.plan.room("corridor")
    textures = []
    for panel in world.panels:
        outward = -np.cross(panel.along, panel.down)
        before = corners_of(panel).mean(axis=0) + 0.05 * outward / np.linalg.norm(outward)
        if world.plan.room_at(before[0], before[1]) == corridor.name:
            textures.append((panel.texture.seed, panel.texture.width_px, panel.texture.height_px))
    assert len(textures) > 20
    assert len(set(textures)) == len(textures)


@pytest.mark.parametrize("seed", SEEDS)
def test_no_two_prints_of_the_corridor_are_the_same(seed: int):
    """As small pictures, each differs from each."""
    design = make_design("corridor", seed)
    world = world_of("corridor", seed)
    floors = sum(np.abs(corners_of(p)[:, 2]).max() < 1e-9 for p in world.panels)
    prints = world.panels[-floors - len(design.posters) : -floors]
    assert len(prints) >= 10
    small = [cv2.resize(p.texture.level(0, 0), (24, 32), interpolation=cv2.INTER_AREA) for p in prints]
    for k, first in enumerate(small):
        for second in small[:k]:
            assert np.abs(first.astype(float) - second).mean() > 4.0


def test_racks_are_equal_but_for_some_cartons():
    """Most bays show one and the same picture, some another, and every aisle has signs of its own."""
    world = world_of("warehouse", 1)
    racks = [k for k, piece in enumerate(world.plan.furniture) if piece.name == "rack"]
    faces = [world.panels[world.pieces[k].panels[0]].texture for k in racks]
    pictures = [face.level(0, 0) for face in faces]
    same = [np.array_equal(pictures[0], p) for p in pictures]
    common = max(sum(np.array_equal(p, q) for q in pictures) for p in pictures)
    assert len(racks) // 2 <= common < len(racks), same
    signs = [p.texture for p in make_design("warehouse", 1).posters if p.texture[:5] == "sign "]
    assert len(signs) == len(set(signs)) == 8


def feature_counts(name: str, poses: int, along: bool) -> np.ndarray:
    """SIFT features from random free poses, or from start poses, over all seeds."""
    sift = cv2.SIFT_create()
    counts = []
    for seed in SEEDS:
        world = world_of(name, seed)
        rng = np.random.default_rng(seed)
        starts = world.start_poses(poses, seed) if along else ()
        chosen = starts or [world.plan.random_free_pose(rng, ROBOT) for _ in range(poses)]
        counts += [len(sift.detect(picture(world, pose))) for pose in chosen]
    return np.array(counts)


@pytest.mark.parametrize("name", first_quick(["warehouse", "twins", "arena"], 1))
def test_there_is_enough_to_see(name: str):
    """From almost everywhere; for offices see their own test."""
    counts = feature_counts(name, 4, along=False)
    assert np.median(counts) >= 120
    assert np.quantile(counts, 0.15) >= 30


@pytest.mark.parametrize("seed", range(8))
def test_a_print_hangs_at_every_end_of_the_ring(seed: int):
    """Where one looks to when driving along a side: on both ends of all four outer walls."""
    posters = np.array([poster.at for poster in make_design("corridor", seed).posters])
    x, y = 12.0, 8.0
    for corner in ((0.0, 0.0), (x, 0.0), (x, y), (0.0, y)):
        near = np.abs(posters - corner)
        assert ((near[:, 0] < 0.06) & (near[:, 1] < 1.8)).any()
        assert ((near[:, 1] < 0.06) & (near[:, 0] < 1.8)).any()


@pytest.mark.slow
def test_the_corridor_is_sparse_but_not_empty():
    """Along the corridor there is always something in view, and much less than in an office."""
    counts = feature_counts("corridor", 6, along=True)
    assert counts.min() >= 15
    assert np.median(counts) < 0.7 * np.median(feature_counts("office", 4, along=False))

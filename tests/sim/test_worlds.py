"""Worlds of every kind and several seeds, measured by their blocks and panels, not by their own plan."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from hybridmap.camera import Camera
from hybridmap.errors import InvalidValue, MapweaveError, SettingsError
from hybridmap.pose import Pose2
from sim.floorplan import Rectangle
from sim.renderer import Renderer
from sim.world import Block, Panel, PanelSet, World
from sim.worlds.catalog import KINDS, make_design, make_world, parameter_names, world_from_table

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
        found = {}
        for room in world.plan.rooms:
            low, high = self.at(*room.corners[0]), self.at(*room.corners[2])
            inside = labels[low[0] : high[0] + 1, low[1] : high[1] + 1]
            found[room.name] = set(np.unique(inside).tolist()) - {0}
        return found


def picture(world: World, pose: Pose2) -> np.ndarray:
    """What a camera sees."""
    rotation = np.eye(3)
    rotation[:2, :2] = pose.rotation
    return Renderer(CAMERA, world.background).render(
        PanelSet.of(world.panels), rotation, np.array([pose.x, pose.y, 0.0])
    )


@pytest.mark.parametrize(("name", "seed"), WORLDS)
def test_panels_lie_on_their_blocks(name: str, seed: int) -> None:
    """Walls are papered all over, furniture looks outward, posters hang before walls, floors are laid."""
    check_panels(world_of(name, seed))


@pytest.mark.parametrize(("name", "seed"), WORLDS)
def test_walls_are_closed(name: str, seed: int) -> None:
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
            one, other = (-half - start[:, None]) / way, (half - start[:, None]) / way
            enter = np.minimum(one, other).max(axis=0)
            leave = np.maximum(one, other).min(axis=0)
            nearest = np.where((enter <= leave) & (enter >= 0), np.minimum(nearest, enter), nearest)
        assert np.isfinite(nearest).all(), room.name


@pytest.mark.parametrize(("name", "seed"), WORLDS)
def test_all_floor_is_one_region(name: str, seed: int) -> None:
    """For a robot with a margin; but the closed twins are two."""
    world = world_of(name, seed)
    regions = Drawing(world).regions(world)
    if name == "twins":
        assert len(regions["room 0"]) == len(regions["room 1"]) == 1
        assert not regions["room 0"] & regions["room 1"]
    else:
        assert len(set.union(*regions.values())) == len(set.intersection(*regions.values())) == 1


@pytest.mark.parametrize(("name", "seed"), WORLDS)
def test_sixteen_robots_can_start(name: str, seed: int) -> None:
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
def test_too_many_robots_are_told_how_many_fit(name: str) -> None:
    """And so many do fit."""
    world = world_of(name, 1)
    with pytest.raises(InvalidValue, match="make the world larger") as caught:
        world.start_poses(400, 1)
    fit = int(str(caught.value).split()[1])
    assert fit >= 8
    poses = world.start_poses(fit, 1)
    assert len(poses) == fit
    assert all(p.distance(q) >= 0.61 for k, p in enumerate(poses) for q in poses[:k])


@pytest.mark.parametrize("name", ["office", "corridor", "warehouse", "joined twins", "arena"])
def test_the_same_seed_gives_the_same_world(name: str) -> None:
    """To the last bit of its places and pictures; another seed gives another."""
    kind, parameters = CASES[name]
    one, again, other = world_of(name, 1), make_world(kind, 1, **parameters), world_of(name, 2)
    assert one.plan == again.plan
    assert one.blocks == again.blocks
    for a, b in zip(one.panels, again.panels, strict=True):
        assert all((getattr(a, n) == getattr(b, n)).all() for n in ("corner", "along", "down"))
        assert (a.texture.seed, a.texture.painter) == (b.texture.seed, b.texture.painter)
    pose = one.start_poses(1, 3)[0]
    assert (picture(one, pose) == picture(again, pose)).all()
    assert not (picture(one, pose) == picture(other, pose)).all()


def twin_poses(world: World) -> list[Pose2]:
    """Poses in the first of two rooms, on a grid to which whole metres are added without rounding."""
    rng = np.random.default_rng(8)
    poses = []
    while len(poses) < 12:
        pose = world.plan.random_free_pose(rng, ROBOT, "room 0")
        poses.append(Pose2(round(pose.x * 1024) / 1024, round(pose.y * 1024) / 1024, pose.heading))
    return poses


@pytest.mark.parametrize("name", ["twins", "joined twins", "large twins"])
@pytest.mark.parametrize("seed", SEEDS)
def test_twins_look_exactly_alike(name: str, seed: int) -> None:
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
        one, other = picture(world, pose), picture(world, Pose2(pose.x + east, pose.y, pose.heading))
        assert (one == other).all()
        assert one.std() > 3
    assert seen >= 2


def test_joined_twins_differ_where_the_corridor_shows() -> None:
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
def test_no_two_prints_of_the_corridor_are_alike(seed: int) -> None:
    """As small pictures, each differs from each."""
    design = make_design("corridor", seed)
    world = world_of("corridor", seed)
    floors = sum(np.abs(corners_of(p)[:, 2]).max() < 1e-9 for p in world.panels)
    prints = world.panels[-floors - len(design.posters) : -floors]
    assert len(prints) >= 10
    small = [cv2.resize(p.texture.level(0, 0), (24, 32), interpolation=cv2.INTER_AREA) for p in prints]
    for k, one in enumerate(small):
        for other in small[:k]:
            assert np.abs(one.astype(float) - other).mean() > 4.0


def test_racks_are_alike_but_for_some_cartons() -> None:
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


MOVING = [
    (name, seed) for name in ("office", "warehouse", "twins", "joined twins", "arena") for seed in SEEDS
]


@pytest.mark.parametrize(("name", "seed"), MOVING)
def test_rearranged_worlds_keep_everything_else(name: str, seed: int) -> None:
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


@pytest.mark.parametrize(("name", "seed"), MOVING)
def test_rearranged_worlds_can_be_driven_through(name: str, seed: int) -> None:
    """However often: no room is cut off, no corner catches a robot, nothing stands in anything."""
    world = world_of(name, seed)
    before = Drawing(world).regions(world)
    for step in range(2):
        world = world.rearranged(step, 1.0)
        after = Drawing(world).regions(world)
        assert len(set.union(*after.values())) <= len(set.union(*before.values()))
        names = list(before)
        for k, one in enumerate(names):
            for other in names[: k + 1]:
                assert bool(before[one] & before[other]) == bool(after[one] & after[other])
        solid = [*world.plan.walls, *world.plan.furniture]
        for piece in (f for f, p in zip(world.plan.furniture, world.pieces, strict=True) if p.movable):
            for other in (s for s in solid if s is not piece):
                boxes = [
                    ((b.x, b.y), (b.length - 0.01, b.width - 0.01), np.degrees(b.heading))
                    for b in (piece, other)
                ]
                assert cv2.rotatedRectangleIntersection(*boxes)[0] == cv2.INTERSECT_NONE


def test_furniture_is_not_put_down_near_robots() -> None:
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
def test_shares_that_are_none_are_refused(share: float) -> None:
    """One line says what a share is."""
    with pytest.raises(InvalidValue, match="share of the furniture"):
        world_of("office", 1).rearranged(1, share)


def test_what_has_no_furniture_cannot_be_rearranged() -> None:
    """One line says so."""
    with pytest.raises(InvalidValue, match="no furniture that can stand elsewhere"):
        world_of("corridor", 1).rearranged(1, 0.5)


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


@pytest.mark.parametrize("name", ["warehouse", "twins", "arena"])
def test_there_is_enough_to_see(name: str) -> None:
    """From almost everywhere; for offices see their own test."""
    counts = feature_counts(name, 4, along=False)
    assert np.median(counts) >= 120
    assert np.quantile(counts, 0.15) >= 30


@pytest.mark.parametrize("seed", range(8))
def test_a_print_hangs_at_every_end_of_the_ring(seed: int) -> None:
    """Where one looks to when driving along a side: on both ends of all four outer walls."""
    posters = np.array([poster.at for poster in make_design("corridor", seed).posters])
    x, y = 12.0, 8.0
    for corner in ((0.0, 0.0), (x, 0.0), (x, y), (0.0, y)):
        near = np.abs(posters - corner)
        assert ((near[:, 0] < 0.06) & (near[:, 1] < 1.8)).any()
        assert ((near[:, 1] < 0.06) & (near[:, 0] < 1.8)).any()


def test_the_corridor_is_sparse_but_not_empty() -> None:
    """Along the corridor there is always something in view, and much less than in an office."""
    counts = feature_counts("corridor", 6, along=True)
    assert counts.min() >= 15
    assert np.median(counts) < 0.7 * np.median(feature_counts("office", 4, along=False))


@pytest.mark.parametrize(
    ("kind", "parameters", "says"),
    [
        ("offices", {}, "no kind of world 'offices'; there are office, corridor"),
        ("office", {"rooms": 0}, "rooms is 0; use 1 to 32"),
        ("office", {"rooms": 2.5}, "is no int"),
        ("office", {"room": 2}, "did you mean 'rooms'"),
        ("corridor", {"breadth": math.nan}, "is no float"),
        ("corridor", {"breadth": 0.2}, "use 1.2 to 5"),
        ("corridor", {"width": 5.0, "breadth": 3.0}, "has no middle"),
        ("warehouse", {"rows": 21}, "use 1 to 20"),
        ("warehouse", {"bays": True}, "is no int"),
        ("twins", {"joined": 1}, "is no bool"),
        ("arena", {"length": -3.0}, "use 2 to 60"),
    ],
)
def test_wrong_parameters_are_one_line(kind: str, parameters: dict[str, object], says: str) -> None:
    """Which parameter, and what it may be."""
    with pytest.raises(MapweaveError, match=says) as caught:
        make_world(kind, 1, **parameters)
    assert "\n" not in str(caught.value)


def test_negative_seeds_are_refused() -> None:
    """Numpy would say something else."""
    with pytest.raises(InvalidValue, match="seed is -1"):
        make_world("arena", -1)


@pytest.mark.parametrize("kind", KINDS)
def test_unusual_sizes_can_be_built(kind: str) -> None:
    """Or are refused in one line; and a robot can start there."""
    for name in parameter_names(kind):
        for value in (1, 2.5, 40.0, True):
            try:
                world = make_world(kind, 1, **{name: value})
            except MapweaveError:
                continue
            assert world.panels
            assert world.start_poses(1, 1)


def test_scenario_tables_name_a_kind_or_a_file(tmp_path) -> None:
    """Not both; an empty table is an office."""
    assert world_from_table({}, 3, tmp_path).plan == make_world("office", 3).plan
    table = {"kind": "arena", "length": 5.0}
    assert world_from_table(table, 3, tmp_path).plan == make_world("arena", 3, length=5.0).plan
    assert table == {"kind": "arena", "length": 5.0}
    for wrong in ({"file": "a.toml", "kind": "office"}, {"file": 3}, {"kind": 3}, {"file": "not there.toml"}):
        with pytest.raises(MapweaveError, match=r"file|kind"):
            world_from_table(wrong, 3, tmp_path)
    with pytest.raises(SettingsError, match="no setting 'rows'"):
        world_from_table({"kind": "arena", "rows": 2}, 3, tmp_path)

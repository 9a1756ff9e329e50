"""Worlds from files: what is written is what is built, and what is wrong is said in one line."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mapweave import Camera, MapweaveError, Pose2
from mapweave.sim import worlds
from mapweave.sim.renderer import Renderer
from mapweave.sim.world import PanelSet, World
from mapweave.sim.worlds.build import build_world
from mapweave.sim.worlds.catalog import KINDS, make_design
from mapweave.sim.worlds.design import Design, Furniture, Poster, Room, Wall
from mapweave.sim.worlds.file import ITEMS, load_design, load_world, save_design
from mapweave.sim.worlds.textures import NOTHING, PAINTERS, WALLS, WITH_ARGUMENT, Textures
from mapweave.storage.settings_file import build

EXAMPLE = Path(worlds.__file__).parent / "examples" / "flat.toml"
DOCS = Path(__file__).parents[2] / "docs" / "worlds.md"
ROOM = '[[rooms]]\nname = "room 0"\nlow = [0.0, 0.0]\nhigh = [4.0, 3.0]\n'
"""The least that a file needs."""
WALL = "[[walls]]\nstart = [0.0, 3.05]\nend = [4.0, 3.05]\nthickness = 0.1\n"
"""North of it."""


def load(folder: Path, text: str) -> World:
    """The world of a file with this text."""
    path = folder / "my.toml"
    path.write_text(text, encoding="utf-8")
    return load_world(path)


def same(first: World, second: World) -> bool:
    """Whether two worlds are equal in all that can be run into or seen."""
    names = ("plan", "blocks", "pieces", "name", "background", "start_rooms", "look_along")
    if any(getattr(first, name) != getattr(second, name) for name in names):
        return False
    return len(first.panels) == len(second.panels) and all(
        all((getattr(a, name) == getattr(b, name)).all() for name in ("corner", "along", "down"))
        and (a.texture.seed, a.texture.painter) == (b.texture.seed, b.texture.painter)
        for a, b in zip(first.panels, second.panels, strict=True)
    )


def test_the_example_is_a_flat_to_drive_in():
    """One region of floor, room for a fleet, and much to see."""
    world = load_world(EXAMPLE)
    assert len(world.plan.free_regions(0.28)) == 1
    rooms = [world.plan.room_at(p.x, p.y) for p in world.start_poses(10, 1)]
    assert rooms[:5] == ["living room", "bedroom", "study", "kitchen", "hall"]
    moved = world.rearranged(1, 0.5)
    assert sum(a != b for a, b in zip(world.plan.furniture, moved.plan.furniture, strict=True)) >= 1
    assert moved.plan.furniture[0] == world.plan.furniture[0], "the kitchen unit is fixed"


@pytest.mark.parametrize("kind", KINDS)
def test_saved_worlds_are_the_same_again(kind: str, tmp_path):
    """Of every kind, to the last bit."""
    design = make_design(kind, 4)
    path = tmp_path / "saved.toml"
    save_design(design, path)
    assert load_design(path) == design
    assert same(load_world(path), build_world(design))


def test_an_unwritable_file_is_reported_in_one_line(tmp_path):
    with pytest.raises(MapweaveError, match="No such file"):
        save_design(make_design("arena", 1), tmp_path / "nowhere" / "a.toml")


def test_missing_values_keep_their_defaults(tmp_path):
    """One room is a world; it is called like its file."""
    world = load(tmp_path, ROOM)
    assert world.name == "my"
    assert world.start_rooms == ("room 0",)
    assert len(world.blocks) == 0
    assert world.start_poses(1, 0)


def test_posters_hang_on_the_nearest_wall_as_painted(tmp_path):
    """A picture with four different quarters, seen by a camera that looks at it: nothing is mirrored."""
    greys = np.array([[20, 90], [160, 240]], np.uint8)
    picture = np.kron(greys, np.ones((50, 80), np.uint8))
    assert cv2.imwrite(str(tmp_path / "four.png"), picture)
    camera = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, mount_height=0.6)
    slanted = "[[walls]]\nstart = [2.5, 0.2]\nend = [3.5, 1.4]\n"
    for at, wall in (((1.9, 2.9), WALL), ((2.93, 0.9), slanted)):
        poster = (
            f'[[posters]]\nat = {list(at)}\nwidth = 0.8\nheight = 0.5\nbottom = 0.35\ntexture = "four.png"\n'
        )
        world = load(tmp_path, ROOM + wall + poster)
        panel = next(p for p in world.panels if np.linalg.norm(p.along) == pytest.approx(0.8, abs=1e-4))
        middle = panel.corner + panel.along / 2 + panel.down / 2
        outward = -np.cross(panel.along, panel.down)
        outward /= np.linalg.norm(outward)
        np.testing.assert_allclose(middle[:2] - 0.004 * outward[:2], _foot(at, world), atol=1e-5)
        assert (np.array(at) - middle[:2]) @ outward[:2] > 0
        eye = Pose2(*(middle + 1.2 * outward)[:2], math.atan2(-outward[1], -outward[0]))
        rotation = np.eye(3)
        rotation[:2, :2] = eye.rotation
        image = Renderer(camera, 200).render(
            PanelSet.of(world.panels), rotation, np.array([eye.x, eye.y, 0.0])
        )
        seen = np.array([[image[90, 110], image[90, 210]], [image[150, 110], image[150, 210]]], float)
        # As bright as the room's lamp makes it, the four greys are in their places.
        ratio = seen / greys
        assert ratio.max() / ratio.min() < 1.25
        assert 0.5 < ratio.mean() < 1.2


def _foot(at: tuple[float, float], world: World) -> np.ndarray:
    """The point of the wall's surface that is nearest to a point, by search along its outline."""
    corners = world.plan.walls[0].corners
    outline = np.concatenate(
        [
            a + np.linspace(0, 1, 40001)[:, None] * (b - a)
            for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)
        ]
    )
    return np.asarray(outline[np.linalg.norm(outline - at, axis=1).argmin()])


FURNITURE = '[[furniture]]\nname = "box"\nat = [1.0, 1.0]\nlength = 0.5\nwidth = 0.4\nheight = 0.6\n'
POSTER = "[[posters]]\nat = [2.0, 2.9]\nwidth = 0.5\nheight = 0.4\n"

WRONG = [
    ("", "there is no room"),
    ("rooms = 3", r"rooms must be a list of tables: write \[\[rooms\]\]"),
    ("[rooms]\nlow = [0, 0]", "rooms must be a list of tables"),
    ("low = ", "my.toml"),
    (ROOM + ROOM, "two rooms are called 'room 0'"),
    (ROOM.replace("4.0", "0.0"), r"rooms\[0\]: high must be at least 2 cm"),
    (ROOM.replace("4.0", "nan"), r"rooms\[0\]: high.*no float"),
    (ROOM.replace("4.0", "inf"), r"rooms\[0\]: high.*no float"),
    (ROOM.replace("4.0", "4e9"), r"rooms\[0\]: high is 4000000000.0; use -1000 to 1000"),
    (ROOM.replace("[4.0, 3.0]", "[900.0, 900.0]"), "too large"),
    (ROOM.replace("[4.0, 3.0]", "[4.0]"), "expected list of length 2"),
    (ROOM.replace('"room 0"', '""'), "name is ''"),
    (ROOM.replace('"room 0"', r'"a\u0007"'), "that can be printed"),
    (ROOM + "floor = 'parket'", r"rooms\[0\]: no texture 'parket'"),
    (ROOM + "paint = 0", r"rooms\[0\]: paint is 0; use 1 to 255"),
    (ROOM + "seed = -4", r"rooms\[0\]: seed is -4"),
    ("seed = -1\n" + ROOM, "seed is -1"),
    ("height = 0.0\n" + ROOM, "height is 0.0; use 0.5 to 10"),
    ("background = 256\n" + ROOM, "background is 256"),
    ("start_rooms = ['hall']\n" + ROOM, "start_rooms: no room 'hall'; there are room 0"),
    ("lamps = 3\n" + ROOM, "no setting 'lamps'"),
    (ROOM + WALL.replace("4.0", "0.0"), r"walls\[0\]: start and end"),
    (ROOM + WALL.replace("0.1", "0.0"), r"walls\[0\]: thickness is 0.0"),
    (ROOM + WALL + "texture = 'platser'", r"walls\[0\]: no texture 'platser'; did you mean 'plaster'"),
    (ROOM + WALL + "height = 40", r"walls\[0\]: height is 40.0"),
    (ROOM + FURNITURE.replace("0.5", "0"), r"furniture\[0\]: length is 0"),
    (ROOM + FURNITURE.replace("height", "hight"), "did you mean 'height'"),
    (ROOM + FURNITURE.replace("height = 0.6", ""), r"furniture\[0\]: height is missing"),
    (ROOM + FURNITURE + "ends = ['wood']", "expected list of length 2"),
    (ROOM + FURNITURE + "texture = 'grey 256'", "use grey and 0 to 255"),
    (ROOM + FURNITURE + "texture = 'rack full'", "use rack, or rack changed"),
    (ROOM + FURNITURE + "texture = 'mine.png'", r"furniture\[0\]: no picture .*mine.png"),
    (ROOM + FURNITURE + "texture = 'my.toml.png'", r"is no PNG or JPEG picture"),
    (ROOM + FURNITURE + r"texture = 'a\u0000.png'".replace("'", '"'), r"furniture\[0\]:"),
    (ROOM + FURNITURE + "texture = 'folder.png'", r"furniture\[0\]:"),
    (ROOM + POSTER, r"posters\[0\]: at must be in front of a wall"),
    (ROOM + WALL + POSTER.replace("2.9", "2.2"), r"posters\[0\]: at must be in front of a wall"),
    (ROOM + WALL + POSTER.replace("2.9", "3.04"), r"posters\[0\]: at must be in front of a wall"),
    (ROOM + WALL + POSTER.replace("2.0", "0.1"), r"posters\[0\]: wider than its wall \(walls\[0\]\)"),
    (ROOM + WALL + POSTER + "bottom = 2.0", r"posters\[0\]: higher than its wall"),
    (ROOM + WALL + POSTER + "texture = 'none'", "needs a texture"),
    (ROOM + WALL * 2049, "2049 walls are too many"),
    (ROOM + WALL.replace("0.0, 3.05", "-999.0, 3.05") * 6, "walls are too many|too large"),
]


@pytest.mark.parametrize(("text", "says"), WRONG)
def test_errors_are_reported_in_one_line(text: str, says: str, tmp_path):
    (tmp_path / "my.toml.png").write_text("no picture")
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(MapweaveError, match=says) as caught:
        load(tmp_path, text)
    assert "my.toml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_bomb_of_pixels_is_not_decoded(tmp_path, monkeypatch):
    """A PNG of 1 MB may have 30000x30000 px."""
    png = bytearray(cv2.imencode(".png", np.zeros((4, 4), np.uint8))[1].tobytes())
    png[16:24] = (30_000).to_bytes(4, "big") * 2
    (tmp_path / "mine.png").write_bytes(png)
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    with pytest.raises(MapweaveError, match=r"mine\.png .*more than 8192 pixels across or down"):
        load(tmp_path, ROOM + FURNITURE + "texture = 'mine.png'")


def test_a_missing_file_is_reported_in_one_line(tmp_path):
    with pytest.raises(MapweaveError, match=r"gone\.toml: no such file"):
        load_world(tmp_path / "gone.toml")


def test_the_page_names_everything():
    page = DOCS.read_text(encoding="utf-8")
    names = [field.name for cls in (Design, *ITEMS.values()) for field in dataclasses.fields(cls)]
    names += [*WALLS, *PAINTERS, *WITH_ARGUMENT, NOTHING, *KINDS]
    names += [field.name for kind in KINDS.values() for field in dataclasses.fields(kind.parameters)]
    assert [name for name in names if f"`{name}`" not in page] == []


@pytest.mark.parametrize("size", [(4, 4), (6, 90), (300, 5), (41, 33), (240, 180)])
@pytest.mark.parametrize(
    "name", [*WALLS, *PAINTERS, "sign", "sign EXIT 12", "grey 7", "rack", "rack changed", "carton"]
)
def test_painters_paint_any_size(name: str, size: tuple[int, int]):
    """The size that was asked for, the same for the same seed."""
    painter = Textures(Path(), 3).painter(name, 170.0, "here")
    one, again = (painter(np.random.default_rng([5]), *size) for _ in range(2))
    assert one.shape == size[::-1]
    assert one.dtype == np.uint8
    assert (one == again).all()
    if min(size) > 100 and not name.startswith("grey"):
        assert one.std() > 2


NUMBERS = st.one_of(
    st.floats(-5, 12), st.integers(-3, 6), st.sampled_from([0, 1e12, -1e300, 2**70, math.inf, math.nan])
)
TEXTS = st.sampled_from(
    ["room 0", "", "wood", "plaster", "grey 300", "sign A", "none", "x.png", "\x07", "wall"]
)
ODD = st.one_of(
    NUMBERS, TEXTS, st.booleans(), st.none(), st.lists(NUMBERS, max_size=3), st.dictionaries(TEXTS, NUMBERS)
)
POINTS = st.lists(st.floats(-2, 6), min_size=2, max_size=2)
LOWS = st.lists(st.floats(-2, 0), min_size=2, max_size=2)
HIGHS = st.lists(st.floats(1, 5), min_size=2, max_size=2)


def tables(cls: type[Any], good: dict[str, st.SearchStrategy[Any]]) -> st.SearchStrategy[dict[str, Any]]:
    """Tables of a dataclass, mostly sensible; now and then a value of any kind, or a name too many."""
    plain = st.fixed_dictionaries(good)
    names = [field.name for field in dataclasses.fields(cls)]
    spoiled = st.dictionaries(st.sampled_from([*names, "other"]), ODD, max_size=1)
    return st.builds(
        lambda a, b: {**a, **b},
        plain,
        st.integers(0, 9).flatmap(lambda n: spoiled if n == 0 else st.just({})),
    )


SIZES = st.floats(0.1, 2.0)
DESIGNS = st.fixed_dictionaries(
    {
        "rooms": st.lists(
            tables(Room, {"name": st.sampled_from("abcd"), "low": LOWS, "high": HIGHS}), max_size=2
        ).map(lambda rooms: [*rooms, {"name": "room 9", "low": [0, 0], "high": [3, 2]}]),
        "walls": st.lists(tables(Wall, {"start": POINTS, "end": POINTS}), max_size=2),
        "furniture": st.lists(
            tables(
                Furniture, {"name": TEXTS, "at": POINTS, "length": SIZES, "width": SIZES, "height": SIZES}
            ),
            max_size=2,
        ),
        "posters": st.lists(tables(Poster, {"at": POINTS, "width": SIZES, "height": SIZES}), max_size=1),
    }
)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    DESIGNS, st.dictionaries(st.sampled_from([f.name for f in dataclasses.fields(Design)]), ODD, max_size=1)
)
def test_any_table_makes_a_world_or_one_line(lists: dict[str, Any], top: dict[str, Any]):
    """Any content of the file; and a built world has poses, and can be rearranged."""
    try:
        table = {**lists, **top}
        for name, cls in ITEMS.items():
            if isinstance(table.get(name), list):
                table[name] = tuple(build(cls, item, name) for item in table[name] if isinstance(item, dict))
        world = build_world(build(Design, table, "file"), "file")
        assert all(np.isfinite(p.corner).all() and np.isfinite(p.along).all() for p in world.panels)
        for panel in world.panels[-2:]:
            assert panel.texture.level(0, 0).size > 0
        world.start_poses(2, 1)
        world.rearranged(1, 0.5)
    except MapweaveError as error:
        assert "\n" not in str(error)

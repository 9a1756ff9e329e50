"""Light and faces of walls: against a loop over points, and over many random walls."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from mapweave.sim.texture import Texture
from mapweave.sim.worlds.catalog import make_world
from mapweave.sim.worlds.design import Wall
from mapweave.sim.worlds.faces import SEGMENT, cut_face, nearest_face
from mapweave.sim.worlds.layout import wall_rectangle
from mapweave.sim.worlds.light import AMBIENT, FULL, MOST, Lit
from mapweave.sim.worlds.textures import Plain

LAMPS = ((1.0, 2.0, 2.15), (4.0, 2.0, 2.15))


def lit(
    corner: tuple[float, float, float], along: tuple[float, float, float], down: tuple[float, float, float]
) -> Lit:
    """A plain surface below two lamps."""
    return Lit(Plain(150), corner, along, down, LAMPS)


SURFACES = {
    "wall to the south": lit((0.0, 4.0, 2.3), (5.0, 0.0, 0.0), (0.0, 0.0, -2.3)),
    "wall to the east": lit((0.0, 0.0, 2.3), (0.0, 4.0, 0.0), (0.0, 0.0, -2.3)),
    "floor": lit((0.0, 4.0, 0.0), (5.0, 0.0, 0.0), (0.0, -4.0, 0.0)),
}


@pytest.mark.parametrize("name", SURFACES)
def test_light_is_that_of_points_under_lamps(name: str):
    surface = SURFACES[name]
    outward = {"wall to the south": (0, -1, 0), "wall to the east": (1, 0, 0), "floor": (0, 0, 1)}[name]
    columns, rows = 7, 5
    bright = surface.brightness(columns, rows)
    for row in range(rows):
        for column in range(columns):
            p, q = column / (columns - 1), row / (rows - 1)
            x, y, z = (
                c + p * a + q * d for c, a, d in zip(surface.corner, surface.along, surface.down, strict=True)
            )
            light = 0.0
            for lx, ly, lz in LAMPS:
                ray = (lx - x, ly - y, lz - z)
                distance = math.sqrt(sum(v * v for v in ray) + 0.05)
                cosine = max(0.0, sum(v * n for v, n in zip(ray, outward, strict=True))) / distance
                down = max(0.0, ray[2]) / distance
                light += cosine * (0.4 + 0.6 * down) / distance**2
            expected = min(MOST, AMBIENT + (1 - AMBIENT) * light / FULL)
            assert bright[row, column] == pytest.approx(expected, rel=1e-9)


def test_pictures_are_brightest_below_the_lamps_and_dark_in_corners():
    """On the floor, in grey levels."""
    picture = SURFACES["floor"](np.random.default_rng(0), 250, 200).astype(float)
    below = picture[95:105, 45:55].mean()
    assert below > picture[95:105, 120:130].mean() + 5
    assert picture[95:105, 120:130].mean() > picture[:5, :5].mean() + 10


def test_no_seam_shows_between_lengths_of_wall():
    """Light is the same where two pieces of a face meet."""
    world = make_world("corridor", 1)
    panels = [p for p in world.panels if p.down[2] < 0]
    met = 0
    for first, second in itertools.pairwise(panels):
        here, there = first.texture.painter, second.texture.painter
        straight = (
            np.linalg.norm(np.cross(first.along, second.along)) < 1e-4 and first.along @ second.along > 0
        )
        joined = straight and np.allclose(first.corner + first.along, second.corner, atol=1e-5)
        if joined and isinstance(here, Lit) and isinstance(there, Lit) and here.lamps == there.lamps:
            met += 1
            rows = here.brightness(9, 20), there.brightness(9, 20)
            np.testing.assert_allclose(rows[0][:, -1], rows[1][:, 0], atol=1e-4)
    assert met > 20


NUMBER = st.floats(-4.0, 4.0)
POINT = st.tuples(NUMBER, NUMBER)
ROOMS = st.lists(st.tuples(NUMBER, NUMBER, st.floats(0.1, 5.0), st.floats(0.1, 5.0)), min_size=1, max_size=4)


@example((0.0, 0.0), (1.0, 1e-310), [(0.5, -1.0, 1.0, 2.0)])
@given(POINT, POINT, ROOMS)
def test_faces_are_cut_where_the_room_changes(
    start: tuple[float, float], end: tuple[float, float], rooms: list[tuple[float, float, float, float]]
):
    """Pieces follow one another, none too wide, none before two rooms but for a centimetre."""
    a, b = np.array(start), np.array(end)
    size = float(np.linalg.norm(b - a))
    if size < 0.02:
        return
    low = np.array([[x, y] for x, y, _, _ in rooms])
    high = low + [[w, h] for _, _, w, h in rooms]
    pieces = cut_face(a, b, low, high)
    np.testing.assert_allclose([pieces[0][0], pieces[-1][1]], [a, b], atol=1e-9)
    for (_, stop), (begin, _) in itertools.pairwise(pieces):
        np.testing.assert_allclose(stop, begin, atol=1e-12)
    right = np.array([b[1] - a[1], a[0] - b[0]]) / size
    for begin, stop in pieces:
        wide = float(np.linalg.norm(stop - begin))
        assert 0.004 < wide <= SEGMENT + 1e-6
        seen = set()
        for share in np.linspace(0.0, 1.0, 60):
            # A centimetre at either end is too narrow to be a piece of its own.
            if not 0.011 < share * wide < wide - 0.011:
                continue
            x, y = begin + share * (stop - begin) + 0.05 * right
            inside = [k for k in range(len(rooms)) if (low[k] <= [x, y]).all() and ([x, y] <= high[k]).all()]
            seen |= set(inside[:1])
        assert len(seen) <= 1


@given(POINT, POINT, POINT)
def test_the_nearest_face_is_found(
    start: tuple[float, float], end: tuple[float, float], at: tuple[float, float]
):
    """The frame's origin is on the outline and looks at the point; the distance is that of a search."""
    if math.dist(start, end) < 0.1:
        return
    base = wall_rectangle(Wall(start, end, 0.2))
    frame, half, gap = nearest_face(base, np.array(at))
    corners = base.corners
    sides = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    outline = np.concatenate([a + np.linspace(0, 1, 500)[:, None] * (b - a) for a, b in sides])
    if gap > 0.0:
        assert gap == pytest.approx(float(np.linalg.norm(outline - at, axis=1).min()), abs=0.02)
        assert frame.inverse().apply(np.array(at))[0] > -1e-9
    ends = frame.apply(np.array([[0.0, -half], [0.0, half]]))
    for corner in ends:
        assert np.linalg.norm(corners - corner, axis=1).min() < 1e-9


def test_plain_textures_are_plain():
    """Without a lamp, what is left is the ambient share."""
    dark = Lit(Plain(200), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0), ())
    picture = Texture(40, 30, (1,), dark).level(0, 0)
    assert np.unique(picture).tolist() == [round(200 * AMBIENT)]

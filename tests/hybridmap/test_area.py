"""Areas: the geometry against OpenCV and against exact fractions."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave.hybridmap.area import Area, crosses, inside
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Pose2

NODE = NodeId("r0", 1, 3)
whole = st.integers(-4, 4)
points = st.tuples(whole, whole)
polygons = st.lists(points, min_size=3, max_size=8, unique=True)


@given(polygons, points)
def test_a_point_is_inside_as_opencv_finds(corners, point) -> None:
    shape = np.array(corners, float)
    # Off the corners and borders, where a point is neither in nor out.
    at = np.add(point, (0.2371, 0.1113))
    expected = cv2.pointPolygonTest(shape.astype(np.float32), tuple(map(float, at)), False)
    assert inside(shape, at[None])[0] == (expected > 0)


@given(polygons, points, points)
def test_a_segment_crosses_the_border_as_exact_fractions_say(corners, begin, end) -> None:
    ring = [*corners, corners[0]]
    expected = any(meet(a, b, begin, end) for a, b in pairwise(ring))
    got = crosses(np.array(corners, float), np.array([begin], float), np.array([end], float))
    assert got.tolist() == [expected]


def meet(a, b, c, d) -> bool:
    """Whether two segments have a point in common, by solving a + s (b - a) = c + t (d - c) exactly."""
    ux, uy, vx, vy = b[0] - a[0], b[1] - a[1], d[0] - c[0], d[1] - c[1]
    wx, wy, det = c[0] - a[0], c[1] - a[1], ux * vy - uy * vx
    if det:
        s, t = Fraction(wx * vy - wy * vx, det), Fraction(wx * uy - wy * ux, det)
        return 0 <= s <= 1 and 0 <= t <= 1
    return any(on(p, q, r) for p, q, r in ((c, a, b), (d, a, b), (a, c, d), (b, c, d)))


def on(p, q, r) -> bool:
    cross = (r[0] - q[0]) * (p[1] - q[1]) - (r[1] - q[1]) * (p[0] - q[0])
    return cross == 0 and all(min(q[k], r[k]) <= p[k] <= max(q[k], r[k]) for k in (0, 1))


def test_an_area_moves_with_its_anchor() -> None:
    anchor, corners = Pose2(3.0, -1.0, 0.7), [(2.0, -2.0), (5.0, -2.0), (5.0, 1.0), (2.0, 1.0)]
    area = Area.of_merged(NODE, anchor, corners)
    assert area.polygon(anchor) == pytest.approx(np.array(corners))
    assert area.size == pytest.approx(9.0)
    moved = Pose2(10.0, 20.0, 1.2)
    (back,) = ((moved.inverse() @ Pose2(*area.polygon(moved).mean(axis=0))).vector[:2],)
    assert back == pytest.approx(np.mean(area.corners, axis=0))


def test_a_circle_is_within_its_polygon() -> None:
    area = Area.around(NODE, 2.0)
    angles = np.linspace(0.0, 6.3, 400)
    circle = 1.9999 * np.column_stack([np.cos(angles), np.sin(angles)])
    assert inside(area.polygon(Pose2()), circle).all()
    assert not inside(area.polygon(Pose2()), 1.02 * circle).all()


@pytest.mark.parametrize(
    "corners",
    [
        ((0.0, 0.0), (1.0, 0.0)),
        ((0.0, 0.0), (1.0, 1.0), (2.0, 2.0)),
        ((0.0, 0.0), (float("nan"), 1.0), (0.0, 1.0)),
        ((0.0, 0.0), (1e7, 0.0), (0.0, 1.0)),
        tuple((float(k), float(k * k)) for k in range(65)),
    ],
)
def test_what_is_no_area_is_refused(corners) -> None:
    with pytest.raises(InvalidValue):
        Area(NODE, corners)


@pytest.mark.parametrize("radius", [0.0, -1.0, float("nan"), float("inf")])
def test_a_radius_is_positive(radius) -> None:
    with pytest.raises(InvalidValue, match="give metres"):
        Area.around(NODE, radius)

"""Areas: the geometry against OpenCV, exact fractions and winding numbers."""

from dataclasses import replace
from fractions import Fraction
from itertools import combinations, pairwise

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from mapweave.hybridmap.area import Area, crosses, inside, read_corner
from mapweave.hybridmap.constraint_subject import RetiredArea
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.manual_constraint import ConstraintRequest, ManualConstraint
from mapweave.hybridmap.pose import Pose2
from mapweave.wire.messages import decode, encode

NODE = NodeId("r0", 1, 3)
whole = st.integers(-4, 4)
points = st.tuples(whole, whole)
polygons = st.lists(points, min_size=3, max_size=8, unique=True)


@given(polygons, points)
def test_a_point_is_inside_as_opencv_finds(corners, point):
    shape = np.array(corners, float)
    # Off the corners and borders, where a point is neither in nor out.
    at = np.add(point, (0.2371, 0.1113))
    expected = cv2.pointPolygonTest(shape.astype(np.float32), tuple(map(float, at)), False)
    assert inside(shape, at[None])[0] == (expected > 0)


@given(polygons, points, points)
def test_a_segment_crosses_the_border_as_exact_fractions_say(corners, begin, end):
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


def test_an_area_moves_with_its_anchor():
    anchor, corners = Pose2(3.0, -1.0, 0.7), [(2.0, -2.0), (5.0, -2.0), (5.0, 1.0), (2.0, 1.0)]
    area = Area.of_merged(NODE, anchor, corners)
    assert area.polygon(anchor) == pytest.approx(np.array(corners))
    assert area.size == pytest.approx(9.0)
    moved = Pose2(10.0, 20.0, 1.2)
    (back,) = ((moved.inverse() @ Pose2(*area.polygon(moved).mean(axis=0))).vector[:2],)
    assert back == pytest.approx(np.mean(area.corners, axis=0))


def test_a_circle_is_within_its_polygon():
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
def test_what_is_no_area_is_refused(corners):
    with pytest.raises(InvalidValue):
        Area(NODE, corners)


@pytest.mark.parametrize("radius", [0.0, -1.0, float("nan"), float("inf")])
def test_a_radius_is_positive(radius):
    with pytest.raises(InvalidValue, match="give metres"):
        Area.around(NODE, radius)


def crosses_itself(corners) -> bool:
    try:
        Area(NODE, tuple((float(x), float(y)) for x, y in corners)).check_outline()
    except InvalidValue as error:
        assert "the outline of the area crosses itself" in str(error)
        return True
    return False


def on_one_line(corners) -> bool:
    (x, y), *rest = corners
    ways = [(a - x, b - y) for a, b in rest]
    return all(a * d == b * c for a, b in ways for c, d in ways)


def sides_of(corners) -> list:
    return list(pairwise([*corners, corners[0]]))


def clean(corners) -> bool:
    """Whether no corner lies on a side that does not end there: then sides meet only where they cross."""
    return not any(on(p, *side) for p in corners for side in sides_of(corners) if p not in side)


@given(polygons.filter(lambda corners: not on_one_line(corners)))
def test_an_outline_crosses_itself_where_two_sides_meet_as_exact_fractions_say(corners):
    sides = sides_of(corners)
    apart = [(p, q) for p, q in combinations(sides, 2) if not {*p} & {*q}]
    assume(clean(corners))
    assert crosses_itself(corners) == any(meet(*p, *q) for p, q in apart)


@given(polygons.filter(lambda corners: not on_one_line(corners)))
def test_an_outline_that_winds_twice_around_a_point_crosses_itself(corners):
    """Winding numbers by the angle at each point of a grid that no side meets, of any polygon."""
    steps = np.arange(-4.0, 4.0, 0.25) + np.sqrt(2.0) / 31.0
    grid = np.stack(np.meshgrid(steps, steps + 0.017), -1).reshape(-1, 2)
    ring = np.array([*corners, corners[0]], float)
    to = ring[None] - grid[:, None]
    angles = np.diff(np.arctan2(to[..., 1], to[..., 0]), axis=1)
    winding = np.rint(((angles + np.pi) % (2.0 * np.pi) - np.pi).sum(axis=1) / (2.0 * np.pi))
    if np.ptp([0.0, *winding]) > 1.0:
        assert crosses_itself(corners)


@given(polygons.filter(lambda corners: not on_one_line(corners)), st.floats(-3.2, 3.2), st.integers(0, 7))
def test_how_an_outline_is_written_down_does_not_matter(corners, heading, first):
    """The other way around, from another corner, with the first one repeated, or turned with rounding."""
    expected = crosses_itself(corners)
    assert crosses_itself(corners[::-1]) == expected
    assert crosses_itself([*corners, corners[0]]) == expected
    turned = Area.of_merged(NODE, Pose2(2.1, -0.3, heading), [*corners[first:], *corners[:first]])
    assert crosses_itself(turned.corners) == expected


tiny = st.sampled_from([0.0, 1e-10, -1e-12, 1e-170, -1e-300, 1e-310, 5e-324])


close = st.tuples(st.integers(-1, 1), st.integers(-1, 1))
tight = st.lists(close, min_size=3, max_size=8, unique=True).filter(lambda corners: not on_one_line(corners))


@settings(max_examples=200)
@given(tight, st.data())
def test_corners_off_by_less_than_a_sliver_change_nothing_and_overflow_nowhere(corners, data):
    """A byte of a message gone bad makes 4.0 a number of 1e-310."""
    near = [(x + data.draw(tiny), y + data.draw(tiny)) for x, y in corners]
    assert crosses_itself(near) == crosses_itself(corners)


@pytest.mark.parametrize(
    ("corners", "where"),
    [
        ("0,0 2,2 2,0 0,2", "(its side from corner 1 to 2 and that from corner 3 to 4)"),
        ("0,0 2,2 2,0 0,2 0,0", "(its side from corner 1 to 2 and that from corner 3 to 4)"),
        ("0,2 2,0 4,3 2,3 0,0", "(its side from corner 1 to 2 and that from corner 4 to 5)"),
        ("0,0 1,1 2,2 2,0 1,1 0,2", ""),  # at a corner
        ("0,0 4,0 4,2 2,0 1,-2", ""),  # at a corner on a side
        ("0,0 2,0 2,2 0,0 2,0 2,2", ""),  # twice around
    ],
)
def test_the_words_say_where_an_outline_crosses_itself_and_what_to_do(corners, where):
    area = Area(NODE, tuple(map(read_corner, corners.split())))
    with pytest.raises(InvalidValue) as refused:
        area.check_outline()
    more = f" {where}" if where else ""
    advice = "give the corners in order around it"
    assert str(refused.value) == f"the outline of the area crosses itself{more}: {advice}"


@pytest.mark.parametrize(
    "corners",
    [
        "0,0 2,0 2,2 0,2 0,0",  # ends with its first corner
        "0,0 0,0 2,0 2,2 0,2",
        "0,0 2,0 2,2 1,0 0,2",  # touches a side with a corner
        "0,0 9,0 9,9 0,9 0,0 3,3 3,6 6,6 6,3 3,3",  # a ring, by way of a cut
        "0,0 3,0 3,1 1,1 1,2 3,2 3,3 0,3",
    ],
)
def test_an_outline_may_touch_itself(corners):
    Area(NODE, tuple(map(read_corner, corners.split()))).check_outline()


def test_what_is_round_does_not_cross_itself():
    for radius in (1e-3, 0.5, 9e3):
        Area.around(NODE, radius).check_outline()


def test_an_area_that_was_kept_before_outlines_were_checked_can_be_read_and_taken_back():
    area = Area(NODE, ((0.0, 0.0), (2.0, 2.0), (2.0, 0.0), (0.0, 2.0)))
    kept = ManualConstraint(RetiredArea(area), True, "anna", 5)
    assert decode(encode(kept), ManualConstraint) == kept
    back = ConstraintRequest(replace(kept, holds=False))
    assert decode(encode(back), ConstraintRequest) == back
    with pytest.raises(InvalidValue, match="crosses itself"):
        ConstraintRequest(kept)

"""Manual constraints: the last one counts, the whole record stays."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave.hybridmap.area import Area, read_corner
from mapweave.hybridmap.constraint_subject import (
    Apart,
    Linked,
    RetiredMap,
    RetiredNodes,
    RetiredWindow,
    read_pose,
    read_retired,
    read_window,
)
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.limits import MAX_STAMP_NS
from mapweave.hybridmap.manual_constraint import (
    ConstraintRequest,
    ManualConstraint,
    ManualConstraints,
    event_words,
    to_take_back,
)
from mapweave.hybridmap.pose import Pose2, PoseGaussian

A, B = NodeId("a", 1, 3), NodeId("b", 1, 5)
POSE = PoseGaussian(Pose2(1.0, 2.0, 0.5), np.diag([1e-3, 4e-3, 1e-4]))


def test_what_it_is_about_is_put_in_order():
    assert Apart((B, A)).ends == (A, B)
    assert Apart((B.map, A.map)).ends == (A.map, B.map)
    assert RetiredNodes((B, A, B)).nodes == (A, B)
    turned = Linked.of(B, A, POSE.inverse(), np.array([[1, 2]]), {"inliers": 40.0})
    assert (turned.a, turned.b, turned.shared) == (A, B, ((2, 1),))
    assert np.allclose(turned.a_from_b.mean.vector, POSE.mean.vector)
    assert np.allclose(turned.a_from_b.covariance, POSE.covariance)


@pytest.mark.parametrize(("who", "why"), [("x\ny", ""), ("x", "w" * 301)])
def test_words_that_are_no_line_are_refused(who: str, why: str):
    with pytest.raises(InvalidValue):
        ManualConstraint(Apart((A, B)), True, who, 0, why)


@pytest.mark.parametrize(("x", "y"), [(2e4, 0.0), (0.0, -1e308), (float("nan"), 0.0), (0.0, float("nan"))])
def test_no_link_by_hand_joins_nodes_that_are_far_apart(x: float, y: float):
    """Their maps could not be merged, and were set apart; a link of before can be taken back."""
    link = Linked(NodeId("r0", 1, 1), NodeId("r1", 1, 1), Pose2(x, y, 0.0))
    with pytest.raises(InvalidValue, match="nodes that see one place are at most 10000 m apart"):
        ConstraintRequest(ManualConstraint(link, True, "anna", 1))
    assert not ConstraintRequest(ManualConstraint(link, False, "anna", 1)).constraint.holds


def test_a_constraint_on_maps_holds_for_all_their_nodes():
    constraints = ManualConstraints([ManualConstraint(Apart((A.map, B.map)), True, "anna", 1)])
    assert (
        constraints.against(A, B)
        is constraints.against(NodeId("b", 1, 99), NodeId("a", 1, 98))
        is constraints.made[0]
    )
    assert constraints.against(A, NodeId("b", 2, 5)) is None
    assert constraints.about(B, A) == constraints.about(MapId("b", 1), MapId("a", 1)) == constraints.made


def test_what_was_taken_back_already_is_not_taken_back_again():
    apart, other = Apart((A.map, B.map)), RetiredMap(A.map)
    made = [
        ManualConstraint(apart, True, "anna", 0),
        ManualConstraint(other, True, "anna", 1),
        ManualConstraint(apart, False, "bob", 3_600_000_000_000, "one kitchen"),
    ]
    assert to_take_back(made, 2) == other
    back = 'constraint 1 was taken back already by bob on 1970-01-01 01:00 UTC: "one kitchen"'
    with pytest.raises(InvalidValue, match=f"^{back}$"):
        to_take_back(made, 1)
    made.append(ManualConstraint(apart, True, "carl", 7_200_000_000_000))
    with pytest.raises(InvalidValue, match=f"^{back}; what holds now is number 4, by carl on 1970-01-01"):
        to_take_back(made, 1)
    assert to_take_back(made, 4) == apart
    with pytest.raises(
        InvalidValue, match=r"constraint 3 takes another one back .*: there is nothing to undo"
    ):
        to_take_back(made, 3)
    for number in (0, 5):
        with pytest.raises(InvalidValue, match=f"there is no constraint {number}: the record has 4"):
            to_take_back(made, number)


subjects = st.sampled_from(
    [
        Apart((A, B)),
        Apart((A, NodeId("b", 1, 7))),
        Apart((A.map, B.map)),
        RetiredMap(A.map),
        RetiredNodes((A, B)),
        Linked.of(A, B, POSE),
        Linked(A, B),
    ]
)


@given(st.lists(st.tuples(subjects, st.booleans()), max_size=8), st.integers(0, 8))
def test_the_last_constraint_counts_in_any_order(made, cut):
    """Against a replay into a plain dictionary; and two halves joined are the whole."""
    constraints = [ManualConstraint(about, holds, "x", k) for k, (about, holds) in enumerate(made)]
    last = {}
    for constraint in constraints:
        last[constraint.about.key] = constraint
    whole = ManualConstraints(constraints)
    assert set(whole.in_force) == {c for c in last.values() if c.holds}
    assert (ManualConstraints(constraints[cut:]) + ManualConstraints(constraints[:cut])).made == whole.made
    excluding = {Apart((A, B)).key, Apart((A.map, B.map)).key, RetiredMap(A.map).key}
    excluded = any(c.holds and c.about.key in excluding for c in last.values())
    assert (whole.against(B, A) is not None) == excluded
    linked = last.get(Linked(A, B).key)
    holds = linked is not None and linked.holds and linked.about.pose is not None
    assert ((A, B) in whole.links) == (holds and not excluded)


def test_retired_nodes_are_linked_with_nothing():
    retired = ManualConstraint(RetiredNodes((A,)), True, "anna", 10**18, "repainted")
    constraints = ManualConstraints([retired], {A: retired})
    assert constraints.retires(A) is constraints.against(B, A) is retired
    assert constraints.retires(B) is None and constraints.about(A, B) == (retired,)
    assert constraints.about(A.map, B.map) == (retired,) and not constraints.about(B, NodeId("b", 1, 6))
    assert event_words(retired) == 'node a.1.3 is retired by anna on 2001-09-09 01:46 UTC: "repainted"'


def test_a_retired_map_is_about_all_of_its_nodes():
    first, second = MapId("r0", 1), MapId("r1", 1)
    retired = ManualConstraint(RetiredMap(first), True, "anna", 1)
    constraints = ManualConstraints([retired])
    assert constraints.retired == {first: retired}
    assert constraints.against(NodeId("r0", 1, 1), NodeId("r1", 1, 1)) is retired
    assert constraints.against(NodeId("r1", 1, 1), NodeId("r1", 1, 2)) is None
    assert constraints.about(first, second) == (retired,)
    assert not ManualConstraints([retired, ManualConstraint(RetiredMap(first), False, "bob", 2)]).retired


metres = st.floats(-20.0, 20.0)


points = st.lists(st.tuples(metres, metres), max_size=9)


@given(points.filter(lambda some: len(some) > 2), points)
def test_an_area_contains_what_its_sides_go_round_an_odd_number_of_times(corners, asked):
    """Against the angle by which the polygon winds round a point."""
    try:
        area = Area(A, tuple(corners))
    except InvalidValue:
        return  # On one line.
    for point in asked:
        to = np.array(corners) - point
        cross = to[:, 0] * np.roll(to[:, 1], -1) - to[:, 1] * np.roll(to[:, 0], -1)
        dot = (to * np.roll(to, -1, axis=0)).sum(axis=1)
        if (np.abs(cross) < 1e-6).any():
            continue  # On a side, or beside one.
        turns = round(float(np.arctan2(cross, dot).sum()) / (2.0 * np.pi))
        assert area.contains(np.array([point]))[0] == (turns % 2 != 0)


def test_subjects_as_people_write_them():
    assert read_retired(["a.1"]) == RetiredMap(A.map) and read_retired(["b.1.5", "a.1.3"]).nodes == (A, B)
    assert read_corner("1.5,-2") == (1.5, -2.0) and read_pose([1, 2, 180]).heading == pytest.approx(np.pi)
    assert read_pose([1, 2, -360]).heading == pytest.approx(-2.0 * np.pi)
    with pytest.raises(InvalidValue, match="a heading of 400 degrees is more than a whole turn"):
        read_pose([1, 2, 400])
    window = read_window(A.map, "1970-01-01T00:01", "1970-01-01T01:02+01:00", 0)
    assert (window.begin_ns, window.end_ns) == (60 * 10**9, 120 * 10**9)
    # In the afternoon, all until noon: not what is mapped until tomorrow's.
    day, hour = 86_400 * 10**9, 3600 * 10**9
    assert read_window(A.map, "", "12:00", day + 15 * hour) == RetiredWindow(A.map, 0, day + 12 * hour)
    assert read_window(A.map, "7", 9, 0) == RetiredWindow(A.map, 7, 9)
    assert read_window(A.map, "", "", 0) == RetiredWindow(A.map, 0, MAX_STAMP_NS)
    for wrong in (
        lambda: read_retired(["a.1", "b.1"]), lambda: read_retired([]), lambda: read_corner("1;2"),
        lambda: read_pose([1.0, float("nan"), 0.0]), lambda: read_window(A.map, "noon", "", 0),
        lambda: read_window(A.map, 5000 * "9", "", 0),
        lambda: read_window(A.map, 5, 4, 0), lambda: Area(A, ((0.0, 0.0), (1.0, 0.0), (1e5, 1.0))),
    ):  # fmt: skip
        with pytest.raises(InvalidValue):
            wrong()

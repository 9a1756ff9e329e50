"""Manual constraints: the last one counts, the whole record stays."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.hybridmap.node import MapId, NodeId

A, B = NodeId("a", 1, 3), NodeId("b", 1, 5)


def test_the_ends_are_put_in_order():
    assert ManualConstraint((B, A), True, "x", 0).ends == (A, B)
    assert ManualConstraint((B.map, A.map), True, "x", 0).ends == (A.map, B.map)


@pytest.mark.parametrize(
    ("ends", "who", "why"),
    [((A, A), "x", ""), ((A, B.map), "x", ""), ((A, B), "x\ny", ""), ((A, B), "x", "w" * 301)],
)
def test_invalid_constraints_are_refused(ends, who, why):
    with pytest.raises(InvalidValue):
        ManualConstraint(ends, True, who, 0, why)


def test_a_constraint_on_maps_holds_for_all_their_nodes():
    constraints = ManualConstraints([ManualConstraint((A.map, B.map), True, "anna", 1)])
    assert (
        constraints.against(A, B)
        is constraints.against(NodeId("b", 1, 99), NodeId("a", 1, 98))
        is constraints.made[0]
    )
    assert constraints.against(A, NodeId("b", 2, 5)) is None
    assert constraints.about(B, A) == constraints.about(MapId("b", 1), MapId("a", 1)) == constraints.made


ends = st.sampled_from([(A, B), (A, NodeId("b", 1, 7)), (A.map, B.map)])


@given(st.lists(st.tuples(ends, st.booleans()), max_size=8), st.integers(0, 8))
def test_the_last_constraint_counts_in_any_order(made, cut):
    """Against a replay into a plain dictionary; and two halves joined are the whole."""
    constraints = [ManualConstraint(e, apart, "x", k) for k, (e, apart) in enumerate(made)]
    last = {}
    for constraint in constraints:
        last[constraint.ends] = constraint
    whole = ManualConstraints(constraints)
    assert set(whole.in_force) == {r for r in last.values() if r.apart}
    assert (ManualConstraints(constraints[cut:]) + ManualConstraints(constraints[:cut])).made == whole.made
    assert (whole.against(B, A) is not None) == any(
        r.apart for r in last.values() if r.ends in ((A, B), (A.map, B.map))
    )


def test_the_same_map_twice_retires_it_and_a_node_twice_is_refused() -> None:
    first, second = MapId("r0", 1), MapId("r1", 1)
    retired = ManualConstraint((first, first), True, "anna", 1)
    assert retired.retires == first and ManualConstraint((first, second), True, "anna", 1).retires is None
    constraints = ManualConstraints([retired])
    assert constraints.retired == {first: retired}
    assert constraints.against(NodeId("r0", 1, 1), NodeId("r1", 1, 1)) is retired
    assert constraints.against(NodeId("r1", 1, 1), NodeId("r1", 1, 2)) is None
    assert constraints.about(first, second) == (retired,)
    assert not ManualConstraints([retired, ManualConstraint((first, first), False, "bob", 2)]).retired
    with pytest.raises(InvalidValue, match="two different nodes, or two maps"):
        ManualConstraint((NodeId("r0", 1, 1), NodeId("r0", 1, 1)), True, "anna", 1)

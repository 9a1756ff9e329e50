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
    rulings = ManualConstraints([ManualConstraint((A.map, B.map), True, "anna", 1)])
    assert rulings.against(A, B) is rulings.against(NodeId("b", 1, 99), NodeId("a", 1, 98)) is rulings.made[0]
    assert rulings.against(A, NodeId("b", 2, 5)) is None
    assert rulings.about(B, A) == rulings.about(MapId("b", 1), MapId("a", 1)) == rulings.made


ends = st.sampled_from([(A, B), (A, NodeId("b", 1, 7)), (A.map, B.map)])


@given(st.lists(st.tuples(ends, st.booleans()), max_size=8), st.integers(0, 8))
def test_the_last_constraint_counts_in_any_order(made, cut):
    """Against a replay into a plain dictionary; and two halves joined are the whole."""
    rulings = [ManualConstraint(e, apart, "x", k) for k, (e, apart) in enumerate(made)]
    last = {}
    for ruling in rulings:
        last[ruling.ends] = ruling
    whole = ManualConstraints(rulings)
    assert set(whole.in_force) == {r for r in last.values() if r.apart}
    assert (ManualConstraints(rulings[cut:]) + ManualConstraints(rulings[:cut])).made == whole.made
    assert (whole.against(B, A) is not None) == any(
        r.apart for r in last.values() if r.ends in ((A, B), (A.map, B.map))
    )


def test_the_same_map_twice_retires_it_and_a_node_twice_is_refused() -> None:
    one, other = MapId("r0", 1), MapId("r1", 1)
    retired = ManualConstraint((one, one), True, "anna", 1)
    assert retired.retires == one and ManualConstraint((one, other), True, "anna", 1).retires is None
    rulings = ManualConstraints([retired])
    assert rulings.retired == {one: retired}
    assert rulings.against(NodeId("r0", 1, 1), NodeId("r1", 1, 1)) is retired
    assert rulings.against(NodeId("r1", 1, 1), NodeId("r1", 1, 2)) is None
    assert rulings.about(one, other) == (retired,)
    assert not ManualConstraints([retired, ManualConstraint((one, one), False, "bob", 2)]).retired
    with pytest.raises(InvalidValue, match="two different nodes, or two maps"):
        ManualConstraint((NodeId("r0", 1, 1), NodeId("r0", 1, 1)), True, "anna", 1)

"""Annotations: the last one of a name holds, the whole record stays, and messages bring them unchanged."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave.hybridmap.annotation import (
    Annotation,
    Annotations,
    Closure,
    Floor,
    Place,
    Preference,
    check_place_name,
)
from mapweave.hybridmap.area import Area
from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.portal import Portal, PortalMeans
from mapweave.storage.map_file import MapFile, pack_map_file, unpack_map_file
from mapweave.wire.messages import decode, encode
from mapweave.wire.packing import pack

A, B = NodeId("r0", 1, 3), NodeId("r0", 1, 5)
FLOOR = Area.around(A, 2.0)

nodes = st.builds(NodeId, st.sampled_from(["r0", "r1"]), st.integers(0, 9), st.integers(0, 2**53))
coordinates = st.floats(-1e6, 1e6)
corners = st.lists(st.tuples(coordinates, coordinates), min_size=3, max_size=64).map(tuple)


def area_or_nothing(anchor: NodeId, points: tuple[tuple[float, float], ...]) -> Area | None:
    try:
        return Area(anchor, points)
    except InvalidValue:
        return None


areas = st.builds(area_or_nothing, nodes, corners).filter(lambda area: area is not None)
pairs = st.tuples(nodes, nodes).filter(lambda pair: pair[0] != pair[1])
stamps = st.integers(0, 2**63 - 1)
spans = st.tuples(st.none() | stamps, st.none() | stamps).filter(
    lambda span: span[1] is None or (span[0] or 0) < span[1]
)
factors = st.floats(0.1, 100.0).filter(lambda factor: factor != 1.0)
bodies = st.one_of(
    st.builds(Place, node=nodes),
    st.builds(Place, area=areas),
    st.builds(lambda edge, span: Closure(edge, None, *span), pairs, spans),
    st.builds(lambda area, span: Closure(None, area, *span), areas, spans),
    st.builds(Preference, factors, edge=pairs),
    st.builds(Preference, factors, area=areas),
    st.builds(lambda pair, means: Portal(*pair, means, "key: desk"), pairs, st.sampled_from(PortalMeans)),
)
lines = st.text(st.characters(categories=["L", "N", "P", "Zs"], codec="utf-8"), max_size=40).filter(
    str.isprintable
)


def is_name(name: str) -> bool:
    try:
        check_place_name(name)
    except InvalidValue:
        return False
    return bool(name)


floors = st.builds(Floor, nodes, lines.filter(bool))
entries = st.one_of(
    st.builds(Annotation, lines.filter(is_name), bodies, st.booleans(), lines, stamps, lines),
    floors.map(lambda floor: Annotation(str(floor.node.map), floor, False, "anna", 1)),
)


@pytest.mark.slow
@given(st.lists(entries, max_size=6))
def test_messages_and_files_bring_annotations_unchanged(made):
    record = Annotations(tuple(made))
    assert decode(encode(record), Annotations) == record
    for entry in made:
        assert decode(encode(entry), Annotation) == entry
    content = MapFile("merged", "", (), annotations=record.made)
    assert unpack_map_file(pack_map_file(content)).annotations == record.made


@given(st.lists(entries, max_size=8), st.integers(0, 8))
def test_two_records_join_by_their_dates(made, cut):
    first, second = Annotations(tuple(made[:cut])), Annotations(tuple(made[cut:]))
    assert set((first + second).made) == set(made)
    stamps_ns = [entry.stamp_ns for entry in (first + second).made]
    assert stamps_ns == sorted(stamps_ns)
    assert (first + second) + first == first + second


def test_the_last_of_a_kind_and_name_holds():
    kitchen = Annotation("kitchen", Place(A), False, "anna", 1)
    moved = replace(kitchen, body=Place(B), stamp_ns=2)
    closed = Annotation("kitchen", Closure((A, B)), False, "bob", 3)
    record = Annotations((kitchen, moved, closed))
    assert record.last("place", "kitchen") == moved and record.last("closure", "kitchen") == closed
    assert [entry for entry, _ in record.in_force(Place)] == [moved]
    gone = Annotations((*record.made, replace(moved, removed=True, stamp_ns=4)))
    assert gone.last("place", "kitchen") is None and gone.in_force(Place) == ()
    assert gone.last("closure", "kitchen") == closed
    back = Annotations((*gone.made, replace(kitchen, stamp_ns=5)))
    assert [body for _, body in back.in_force(Place)] == [Place(A)]


@pytest.mark.parametrize(
    "name",
    ["", "x" * 65, "a\nb", " kitchen", "kitchen ", "-kitchen", "home", "Home", "area", "r0.1.17", "R0.1",
     "3,4", "3.1, -2.0", "nan,inf", "1,2,3"],
)  # fmt: skip
def test_names_that_commands_would_misread_are_refused(name):
    with pytest.raises(InvalidValue):
        Annotation(name, Place(A), False, "anna", 1)


@pytest.mark.parametrize("name", ["kitchen", "Küche 2", "12", "r0", "b.c", "anna's desk", "台所"])
def test_other_names_are_taken(name):
    assert Annotation(name, Place(A), False, "anna", 1).name == name


@pytest.mark.parametrize(
    "make",
    [
        lambda: Place(),
        lambda: Place(A, FLOOR),
        lambda: Closure((A, A)),
        lambda: Closure((A, B), FLOOR),
        lambda: Closure((A, B), None, 5, 5),
        lambda: Preference(1.0, (A, B)),
        lambda: Preference(0.01, (A, B)),
        lambda: Preference(2.0),
        lambda: Annotation("x", Place(A), False, "a\nb", 1),
        lambda: Annotation("x", Place(A), False, "", 1, "w" * 301),
    ],
)
def test_what_makes_no_sense_is_refused(make):
    with pytest.raises(InvalidValue):
        make()


def test_a_closure_holds_from_its_beginning_until_its_end():
    closure = Closure((A, B), None, 10, 20)
    assert [closure.holds(at) for at in (9, 10, 19, 20)] == [False, True, True, False]
    assert Closure((A, B)).holds(0) and Closure((A, B), None, 10).holds(2**63 - 1)


def test_kinds_of_a_newer_program_are_left_out_of_files_and_refused_alone():
    entry = {
        "name": "x",
        "body": {"kind": "hologram", "node": [*A]},
        "removed": False,
        "who": "",
        "stamp_ns": 1,
    }
    known = {**entry, "body": {"kind": "place", "node": [*A]}}
    record = decode(pack({"made": [entry, known]}), Annotations)
    assert [one.body for one in record.made] == [Place(A)]
    with pytest.raises(InvalidMessage, match="`kind` must be one of place"):
        decode(pack(entry), Annotation)
    with pytest.raises(InvalidMessage, match="a place is a node or an area"):
        decode(pack({**entry, "body": {"kind": "place"}}), Annotation)

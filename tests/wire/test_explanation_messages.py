"""Explanations and manual constraints round-trip, and invalid ones are refused."""

import math
import struct
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave.hybridmap.area import Area
from mapweave.hybridmap.change import NodeRetired
from mapweave.hybridmap.constraint_subject import (
    Apart,
    Linked,
    RetiredArea,
    RetiredMap,
    RetiredNodes,
    RetiredWindow,
)
from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.explanation import (
    FleetExplanation,
    Hop,
    LinkAgreement,
    MapsExplanation,
    Misfit,
    NearMiss,
    PairExplanation,
    RouteExplanation,
    Standing,
)
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ConstraintList, ConstraintRequest, ManualConstraint
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import ExplainRequest
from mapweave.wire.codec import encode_body
from mapweave.wire.messages import decode, encode
from synthetic.world import room, take_map

A, B = MapId("a", 1), MapId("b", 2)
APART = ManualConstraint(Apart((A, B)), True, "anna", 1, "why")
NODE_A, NODE_B = NodeId("a", 1, 3), NodeId("b", 2, 5)


MISFIT = {
    "merged_a_from_b": struct.pack("<9f", 0, 0, 0, 1, 0, 0, 1, 0, 1), "off": ["f8", [3], bytes(24)],
    "strain2": 4.5, "alone": True,
}  # fmt: skip


def nodes() -> tuple[Node, Node]:
    rng = np.random.default_rng(0)
    world = room(0, 0, 5, 4, 500, rng)
    return take_map(world, A, [Pose2(2, 2, 0)], rng)[0][0], take_map(world, B, [Pose2(2, 2, 0.1)], rng)[0][0]


def explanation() -> PairExplanation:
    a, b = nodes()
    pose = PoseGaussian.from_sigmas(Pose2(0.25, -0.5, 0.125), 0.5, 0.25)
    matches, misfit = np.array([[1, 2], [3, 4]]), Misfit(pose, np.array([0.1, 0.2, -0.3]), 4.5, False)
    return PairExplanation(
        a, b, Standing.LINKED, "because", matches, matches[:1], np.array([math.nan]), pose,
        {"inliers": 12.0, "rms_px": 0.7}, 0.9, misfit, (LinkAgreement(NODE_A, NODE_B, 2.5, True, False),),
        ("a has recognised the one at the other",), (APART,),
    )  # fmt: skip


def test_two_nodes_come_back():
    result, back = explanation(), decode(encode(explanation()), PairExplanation)
    assert (back.a.id, back.b.id) == (result.a.id, result.b.id)
    assert (back.standing, back.reason) == (result.standing, result.reason)
    assert np.array_equal(back.matches, result.matches) and np.array_equal(back.shared, result.shared)
    assert np.array_equal(back.residuals_px, result.residuals_px, equal_nan=True)
    assert back.a_from_b is not None and np.allclose(back.a_from_b.mean.vector, [0.25, -0.5, 0.125])
    assert (back.evidence, back.probability, back.other_links) == (result.evidence, 0.9, result.other_links)
    assert back.misfit is not None and np.allclose(back.misfit.off, [0.1, 0.2, -0.3])
    assert (back.misfit.strain2, back.misfit.alone) == (4.5, False)
    assert (back.claims, back.constraints) == (result.claims, result.constraints)
    assert np.array_equal(back.a.landmarks.pixels, decode(encode(back), PairExplanation).a.landmarks.pixels)


def test_nothing_but_words_comes_back_too():
    a, b = nodes()
    nothing = np.zeros((0, 2), np.int64)
    back = decode(
        encode(PairExplanation(a, b, Standing.REFUSED, "no", nothing, nothing, np.zeros(0))), PairExplanation
    )
    assert back.a_from_b is None and back.misfit is None and back.probability is None and not back.other_links


ids = st.builds(NodeId, st.sampled_from(["a", "b9"]), st.integers(0, 9), st.integers(0, 2**53))
words = st.text(st.characters(codec="utf-8", categories=["L", "N", "P", "Zs"]), max_size=40).filter(
    str.isprintable
)
counts = st.integers(0, 2**40)
amounts = st.floats(0, 4e6)
pairs_of_nodes = st.tuples(ids, ids).filter(lambda e: e[0] != e[1])
pairs_of_maps = st.tuples(ids, ids).map(lambda e: (e[0].map, e[1].map)).filter(lambda e: e[0] != e[1])
metres = st.floats(-1e3, 1e3)
links_by_hand = st.builds(
    lambda pair, mean, sigma, shared, evidence: Linked.of(
        *pair, PoseGaussian.from_sigmas(Pose2(*mean), sigma, sigma),
        np.array(shared, np.int64).reshape(-1, 2), evidence,
    ),
    pairs_of_nodes, st.tuples(metres, metres, st.floats(-3, 3)), st.floats(1e-3, 1.0),
    st.lists(st.tuples(st.integers(0, 150), st.integers(0, 150)), max_size=5),
    st.dictionaries(st.sampled_from(["inliers", "rms_px"]), st.floats(0, 1e3)),
)  # fmt: skip
corners = st.lists(st.tuples(metres, metres), max_size=8)
areas = st.builds(
    lambda anchor, more: Area(anchor, ((0.0, 0.0), (1.0, 0.0), (0.5, 1.5), *more)), ids, corners
)
windows = st.builds(
    lambda node, begin, length: RetiredWindow(node.map, begin, begin + length),
    ids, st.integers(0, 2**62), st.integers(0, 2**61),
)  # fmt: skip
# Around the place, so that no side crosses another.
outlines = st.lists(st.floats(0.5, 1e3), min_size=3, max_size=11).map(
    lambda radii: [
        (radius * math.cos(math.tau * k / len(radii)), radius * math.sin(math.tau * k / len(radii)))
        for k, radius in enumerate(radii)
    ]
)
simple_areas = st.builds(lambda anchor, around: Area(anchor, tuple(around)), ids, outlines)
other_subjects = st.one_of(
    (pairs_of_nodes | pairs_of_maps).map(Apart), links_by_hand, ids.map(lambda node: RetiredMap(node.map)),
    st.lists(ids, min_size=1, max_size=5).map(lambda nodes: RetiredNodes(tuple(nodes))), windows,
)  # fmt: skip


def constraints_on(subjects: st.SearchStrategy[Any]) -> st.SearchStrategy[ManualConstraint]:
    return st.builds(ManualConstraint, subjects, st.booleans(), words, st.integers(0, 2**62), words)


constraints = constraints_on(other_subjects | areas.map(RetiredArea))
"""Also on areas that were drawn before outlines were checked."""
maps = st.builds(
    MapsExplanation, ids.map(lambda n: n.map), ids.map(lambda n: n.map), st.booleans(), words, counts, counts,
    counts, counts, st.lists(st.builds(NearMiss, ids, ids, counts, counts, words), max_size=3).map(tuple),
    st.lists(constraints, max_size=3).map(tuple), st.lists(ids.map(lambda n: n.map), max_size=3).map(tuple),
)  # fmt: skip


hops = st.builds(
    Hop, ids, ids, st.sampled_from(["driven", "near"]), amounts, st.floats(-6, 6), amounts, words
)
routes = st.builds(
    RouteExplanation, ids, ids, st.booleans(), words, st.lists(hops, max_size=3).map(tuple),
    st.lists(hops, max_size=3).map(tuple), st.none() | maps,
)  # fmt: skip


@given(routes)
def test_routes_come_back(explanation: RouteExplanation):
    assert decode(encode(explanation), RouteExplanation) == explanation


@given(st.lists(maps, max_size=4).map(lambda some: FleetExplanation(tuple(some))))
def test_maps_come_back(explanation: FleetExplanation):
    assert decode(encode(explanation), FleetExplanation) == explanation


@given(constraints)
def test_constraints_round_trip(constraint: ManualConstraint):
    assert decode(encode(constraint), ManualConstraint) == constraint
    assert decode(encode(ConstraintList((constraint,))), ConstraintList).made == (constraint,)


@given(constraints_on(other_subjects | simple_areas.map(RetiredArea)))
def test_constraints_and_questions_round_trip(constraint: ManualConstraint):
    assert decode(encode(constraint), ManualConstraint) == constraint
    asked = ConstraintRequest(constraint, True)
    assert decode(encode(asked), ConstraintRequest) == asked
    assert decode(encode(ConstraintList((constraint,))), ConstraintList).made == (constraint,)
    for ends in ((A, B), (NODE_A, NODE_B)):
        assert decode(encode(ExplainRequest(ends)), ExplainRequest).ends == ends
    assert decode(encode(ExplainRequest()), ExplainRequest).ends is None


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("standing", "perhaps"), ("matches", ["i8", [3], b"123"]), ("matches", b"123"),
        ("matches", ["i8", [1, 2], bytes(15)]), ("matches", ["i8", [1, 2], b"\xff" * 16]),
        ("matches", ["i8", [1, 2], bytes(8) + b"\0\x10" + bytes(6)]), ("matches", ["O", [1], bytes(8)]),
        ("matches", ["i8", [1, 1], bytes(8)]), ("matches", ["i8", [-1, -2], bytes(16)]),
        ("matches", ["i8", [2**62, 2**62, 0], b""]), ("shared", ["f8", [1, 2], bytes(16)]),
        ("residuals_px", ["f8", [0], b""]), ("residuals_px", ["f8", [1], struct.pack("<d", -1.0)]),
        ("probability", 1.5), ("misfit", [1, 2]), ("misfit", {**MISFIT, "merged_a_from_b": b""}),
        ("misfit", {**MISFIT, "off": ["f8", [2], bytes(16)]}), ("misfit", {**MISFIT, "alone": 1}),
        ("misfit", {**MISFIT, "off": ["f8", [3], struct.pack("<3d", 0.0, math.nan, 0.0)]}),
        ("misfit", {**MISFIT, "strain2": -1.0}), ("other_links", [[1]]),
        ("other_links", [{"a": ["a", 1, 2]}]),
        ("constraints", [[1, 2]]), ("reason", "two\nlines"), ("evidence", {"inliers": "many"}),
        ("a", b"no node"), ("a", encode_body(NodeRetired(NODE_A))), ("claims", [7]),
    ],
)  # fmt: skip
def test_a_damaged_explanation_is_refused_in_one_line(field: str, value: Any):
    fields = msgpack.unpackb(encode(explanation()))
    with pytest.raises(InvalidMessage) as refused:
        decode(msgpack.packb({**fields, field: value}), PairExplanation)
    assert len(str(refused.value).splitlines()) == 1
    assert decode(msgpack.packb({**fields, "misfit": MISFIT}), PairExplanation).misfit is not None


def constrained(kind: str, **about: Any) -> bytes:
    rest = {"holds": True, "who": "x", "stamp_ns": 0, "because": ""}
    return msgpack.packb({"v": 1, "about": {"kind": kind, **about}, **rest})


@pytest.mark.parametrize(
    ("kind", "about", "words"),
    [
        ("apart", {"ends": [["a", 1, 2], ["a", 1, 2]]}, "two different"),
        ("apart", {"ends": [["a", 1], ["b", 1, 2]]}, "two different"),
        ("apart", {"ends": [["a", 1]]}, "length 2"),
        ("apart", {"ends": [["a", 1, 2, 3]] * 2}, "length"),
        ("link", {"a": ["a", 1, 2], "b": ["a", 1, 2]}, "a.1.2 twice"),
        ("link", {"a": ["a", 1, 2], "b": ["a", 1, 3], "covariance": [1.0] * 6}, "neither"),
        ("link", {"a": ["a", 1, 2], "b": ["a", 1, 3], "pose": [0.0] * 3, "covariance": [-1.0] * 6}, "semi"),
        ("area", {"area": {"anchor": ["a", 1, 2], "corners": [[0.0, 0.0], [1.0, 1.0]]}}, "3 to 64"),
        ("area", {"area": {"anchor": ["a", 1, 2], "corners": [[0, 0], [1, 1], [2, 2]]}}, "one line"),
        ("window", {"map": ["a", 1], "begin_ns": 2, "end_ns": 1}, "after it begins"),
        ("nodes", {"nodes": []}, "1 to 1000"),
        ("burnt", {"map": ["a", 1]}, "`kind` must be one of apart, link, map, nodes, area, window"),
    ],
)
def test_invalid_constraints_are_refused_in_one_line(kind: str, about: dict[str, Any], words: str):
    with pytest.raises(InvalidMessage, match=words):
        decode(constrained(kind, **about), ManualConstraint)


def test_undecodable_values_are_not_encoded():
    with pytest.raises(InvalidValue):
        encode(
            PairExplanation(*nodes(), Standing.LINKED, "x" * 5000, *[np.zeros((0, 2), int)] * 2, np.zeros(0))
        )

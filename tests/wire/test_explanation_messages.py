"""Explanations and manual constraints round-trip, and invalid ones are refused."""

from __future__ import annotations

import math
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.explanation import (
    MapsExplanation,
    Misfit,
    NearMiss,
    PairExplanation,
    Standing,
    Witness,
)
from mapweave.hybridmap.manual_constraint import ManualConstraint
from mapweave.hybridmap.node import MapId, Node, NodeId
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.wire.explanation_messages import (
    ExplainRequest,
    decode_explain_request,
    decode_maps,
    decode_pair,
    decode_ruling,
    encode_explain_request,
    encode_maps,
    encode_pair,
    encode_ruling,
)
from synthetic.world import room, take_map

A, B = MapId("a", 1), MapId("b", 2)
NODE_A, NODE_B = NodeId("a", 1, 3), NodeId("b", 2, 5)


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
        {"inliers": 12.0, "rms_px": 0.7}, 0.9, misfit, (Witness(NODE_A, NODE_B, 2.5, True, False),),
        ("a has recognised the one at the other",), (ManualConstraint((A, B), True, "anna", 1, "why"),),
    )  # fmt: skip


def test_two_nodes_come_back() -> None:
    told, back = explanation(), decode_pair(encode_pair(explanation()))
    assert (back.a.id, back.b.id, back.standing, back.reason) == (
        told.a.id,
        told.b.id,
        told.standing,
        told.reason,
    )
    assert np.array_equal(back.matches, told.matches) and np.array_equal(back.shared, told.shared)
    assert np.array_equal(back.residuals_px, told.residuals_px, equal_nan=True)
    assert back.a_from_b is not None and np.allclose(back.a_from_b.mean.vector, [0.25, -0.5, 0.125])
    assert (back.evidence, back.probability, back.witnesses) == (told.evidence, 0.9, told.witnesses)
    assert back.misfit is not None and np.allclose(back.misfit.off, [0.1, 0.2, -0.3])
    assert (back.misfit.strain2, back.misfit.alone) == (4.5, False)
    assert (back.claims, back.rulings) == (told.claims, told.rulings)
    assert np.array_equal(back.a.landmarks.pixels, decode_pair(encode_pair(back)).a.landmarks.pixels)


def test_nothing_but_words_comes_back_too() -> None:
    a, b = nodes()
    nothing = np.zeros((0, 2), np.int64)
    back = decode_pair(
        encode_pair(PairExplanation(a, b, Standing.REFUSED, "no", nothing, nothing, np.zeros(0)))
    )
    assert back.a_from_b is None and back.misfit is None and back.probability is None and not back.witnesses


ids = st.builds(NodeId, st.sampled_from(["a", "b9"]), st.integers(0, 9), st.integers(0, 2**53))
words = st.text(st.characters(codec="utf-8", categories=["L", "N", "P", "Zs"]), max_size=40).filter(
    str.isprintable
)
counts = st.integers(0, 2**40)
rulings = st.builds(
    ManualConstraint,
    st.tuples(ids, ids).filter(lambda e: e[0] != e[1])
    | st.tuples(ids, ids).map(lambda e: (e[0].map, e[1].map)).filter(lambda e: e[0] != e[1]),
    st.booleans(), words, st.integers(0, 2**62), words,
)  # fmt: skip
maps = st.builds(
    MapsExplanation, ids.map(lambda n: n.map), ids.map(lambda n: n.map), st.booleans(), words, counts, counts,
    counts, counts, st.lists(st.builds(NearMiss, ids, ids, counts, counts, words), max_size=3).map(tuple),
    st.lists(rulings, max_size=3).map(tuple),
)  # fmt: skip


@given(st.lists(maps, max_size=4).map(tuple))
def test_maps_come_back(told: tuple[MapsExplanation, ...]) -> None:
    assert decode_maps(encode_maps(told)) == told


@given(rulings)
def test_constraints_and_questions_round_trip(ruling: ManualConstraint) -> None:
    assert decode_ruling(encode_ruling(ruling)) == ruling
    request = ExplainRequest(ruling.ends)
    assert decode_explain_request(encode_explain_request(request)) == request
    assert decode_explain_request(encode_explain_request(ExplainRequest())).ends is None


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("y", "perhaps"), ("m", b"123"), ("h", b"\xff\xff\x00\x00"), ("u", []), ("u", [-1.0]), ("q", 1.5),
        ("f", [b"", [0, 0, 0], 1.0, True]), ("f", [1, 2]), ("w", [[1]]), ("g", [[1, 2]]), ("r", "two\nlines"),
        ("a", b"no node"), ("c", [7]),
    ],
)  # fmt: skip
def test_a_damaged_explanation_is_refused_in_one_line(field: str, value: Any) -> None:
    fields = msgpack.unpackb(encode_pair(explanation()))
    with pytest.raises(InvalidMessage) as refused:
        decode_pair(msgpack.packb({**fields, field: value}))
    assert len(str(refused.value).splitlines()) == 1


@pytest.mark.parametrize(
    "value", [[["a", 1, 2], ["a", 1, 2], True, "x", 0, ""], [["a", 1], ["b", 1, 2], True, "x", 0, ""]]
)
def test_a_constraint_without_effect_is_refused(value: list[Any]) -> None:
    with pytest.raises(InvalidMessage):
        decode_ruling(msgpack.packb({"v": 1, "r": value}))


def test_a_constraint_on_one_map_retires_it() -> None:
    ruling = decode_ruling(msgpack.packb({"v": 1, "r": [["a", 1], ["a", 1], True, "x", 0, ""]}))
    assert ruling.retires == MapId("a", 1)


def test_undecodable_values_are_not_encoded() -> None:
    with pytest.raises(InvalidValue):
        encode_pair(
            PairExplanation(*nodes(), Standing.LINKED, "x" * 5000, *[np.zeros((0, 2), int)] * 2, np.zeros(0))
        )

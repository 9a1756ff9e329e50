"""Files that earlier programs wrote open for ever; refusals and rulings come back as they went."""

from __future__ import annotations

import hashlib
from pathlib import Path

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.errors import InvalidMessage
from mapweave.hybridmap.manual_constraint import ManualConstraint
from mapweave.hybridmap.node import Edge, EdgeKind, MapId, NodeId
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.storage.map_file import (
    HEADER,
    MapFile,
    RefusedPair,
    pack_map_file,
    read_map_file,
    unpack_map_file,
)

HERE = Path(__file__).parent
POSTURE = PoseGaussian.from_sigmas(Pose2(0.25, -0.5, 0.125), 0.0625, 0.03125)


def test_a_merged_map_of_version_1() -> None:
    """Written once, when files began to hold refusals and rulings; never written anew."""
    content = read_map_file(HERE / "merged_version_1.mapweave", "merged")
    assert content.title == "two maps"
    nodes = [body.node for body in content.changes if isinstance(body, NodePut)]
    edges = {body.edge.id: body.edge for body in content.changes if isinstance(body, EdgePut)}
    assert [str(node.id) for node in nodes] == ["a.1.1", "a.1.3", "b.1.1", "b.1.3"]
    assert {len(node.landmarks) for node in nodes} == {12}
    link = edges[NodeId("merge", 0, 77)]
    assert link.evidence == {"inliers": 12.0, "probability": 0.75} and link.shared.tolist() == [
        [0, 1],
        [2, 3],
    ]
    assert np.allclose(link.a_from_b.covariance, POSTURE.covariance)
    assert {str(node): component for node, (component, _) in content.poses.items()} == {
        "a.1.1": 0, "a.1.3": 0, "b.1.1": 0, "b.1.3": 0,
    }  # fmt: skip
    assert [(str(r.a), str(r.b), r.reason) for r in content.refused] == [
        ("a.1.3", "b.1.1", "0 features match"), ("a.1.3", "b.1.3", "strains"), ("a.1.1", "a.1.3", "own"),
    ]  # fmt: skip
    assert [None if r.edge is None else str(r.edge.id) for r in content.refused] == [
        None,
        "merge.0.78",
        "a.1.8",
    ]
    assert content.rulings == (
        ManualConstraint(
            (NodeId("a", 1, 3), NodeId("b", 1, 3)), True, "anna", 1772366400 * 10**9, "two kitchens"
        ),
        ManualConstraint((MapId("a", 1), MapId("b", 1)), False, "bob", 1772366400 * 10**9 + 1),
    )
    assert unpack_map_file(pack_map_file(content)).rulings == content.rulings


def test_a_file_of_before_has_no_refusals() -> None:
    content = read_map_file(HERE / "first_version.mapweave")
    assert content.refused == () and content.rulings == ()


ids = st.builds(NodeId, st.sampled_from(["a", "b"]), st.integers(0, 3), st.integers(0, 2**53))
pairs = st.tuples(ids, ids).filter(lambda ends: ends[0] != ends[1])
words = st.text(max_size=60).filter(str.isprintable)
refusals = st.builds(
    lambda ends, reason, number: RefusedPair(
        *ends, reason, None if number is None else Edge(NodeId("a", 1, number), *ends, POSTURE, EdgeKind.LOOP)
    ),
    pairs, words, st.none() | st.integers(0, 99),
)  # fmt: skip
rulings = st.builds(ManualConstraint, pairs, st.booleans(), words, st.integers(0, 2**62), words)


@given(st.lists(refusals, max_size=4), st.lists(rulings, max_size=4))
def test_refusals_and_rulings_come_back(refused: list[RefusedPair], made: list[ManualConstraint]) -> None:
    content = MapFile("merged", "m", (), {}, tuple(refused), tuple(made))
    back = unpack_map_file(pack_map_file(content))
    assert back.rulings == tuple(made)
    assert [(r.a, r.b, r.reason) for r in back.refused] == [(r.a, r.b, r.reason) for r in refused]
    for one, two in zip(back.refused, refused, strict=True):
        assert (one.edge is None) == (two.edge is None)
        if one.edge is not None and two.edge is not None:
            assert (one.edge.id, one.edge.a, one.edge.b) == (two.edge.id, two.edge.a, two.edge.b)
    assert pack_map_file(back) == pack_map_file(content)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("refused", 7), ("refused", [[1]]), ("refused", [[["a", 1, 1], ["b", 1, 1], "two\nlines", b""]]),
        ("refused", [[["a", 1, 1], ["b", 1, 1], "no", b"rubbish"]]), ("rulings", [[1, 2]]), ("rulings", "x"),
    ],
)  # fmt: skip
def test_what_no_refusal_or_ruling_is_is_refused(field: str, value: object) -> None:
    data = pack_map_file(MapFile("merged", "m", ()))
    fields = msgpack.unpackb(data[HEADER.size : -32])
    content = msgpack.packb({**fields, field: value})
    magic, version, _ = HEADER.unpack_from(data)
    whole = HEADER.pack(magic, version, len(content)) + content
    with pytest.raises(InvalidMessage) as refused:
        unpack_map_file(whole + hashlib.sha256(whole).digest())
    assert len(str(refused.value).splitlines()) == 1

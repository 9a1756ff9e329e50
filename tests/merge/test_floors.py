"""Maps on different floors are never one, however alike they are."""

from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraints
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.merge.floors import across_floors, parted_by
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.offline_merge import merge_parts
from synthetic.maps import looked_around

NAMES = [MapId(name, 1) for name in "abcdef"]
HERE = PoseGaussian(Pose2(), np.eye(3))


def link(a: MapId, b: MapId, shared: int) -> Link:
    first, second = sorted((a, b))
    pairs = np.zeros((shared, 2), np.int64)
    return Link(NodeId(*first, 1), NodeId(*second, 1), HERE, pairs, {"inliers": float(shared)})


pairs = st.tuples(st.sampled_from(NAMES), st.sampled_from(NAMES)).filter(lambda pair: pair[0] != pair[1])


@given(
    st.lists(st.tuples(pairs, st.integers(10, 60)), max_size=12),
    st.dictionaries(st.sampled_from(NAMES), st.sampled_from(["first", "second", "third"])),
)
def test_no_component_has_two_floors_and_no_link_is_excluded_without_need(drawn, floors):
    links = [link(*pair, shared) for pair, shared in drawn]
    excluded = across_floors(links, floors)
    left = {one.maps for one in links} - excluded.keys()
    for part in components(left):
        assert len({floors[name] for name in part if name in floors}) <= 1
    for pair in excluded:
        # With it alone two labels would be in one component.
        (part,) = [part for part in components({*left, pair}) if pair[0] in part]
        assert len({floors[name] for name in part if name in floors}) == 2
    shuffled = across_floors(links[::-1], floors)
    assert shuffled == excluded


def components(edges: set[tuple[MapId, MapId]]) -> list[set[MapId]]:
    """By flooding."""
    parts = []
    left = {name for pair in edges for name in pair}
    while left:
        part, front = set(), {left.pop()}
        while front:
            part |= front
            front = {b for a, b in [*edges, *(pair[::-1] for pair in edges)] if a in part} - part
        left -= part
        parts.append(part)
    return parts


def test_a_map_without_a_label_goes_with_those_it_has_most_in_common_with():
    a, b, c, d = NAMES[:4]
    links = [link(a, c, 30), link(b, c, 20), link(c, d, 40), link(b, d, 12)]
    excluded = across_floors(links, {a: "first", b: "second"})
    assert excluded == {
        (b, c): "b.1 is on floor second and c.1 is on floor first, by what it has in common with others",
        (b, d): "b.1 is on floor second and d.1 is on floor first, by what it has in common with others",
    }
    assert across_floors(links, {a: "first", b: "first"}) == {}


@pytest.mark.parametrize(
    ("ties", "words"),
    [
        ({(0, 1): 30, (1, 2): 20, (0, 2): 12}, "2 links fall and c.1 parts from a.1 and b.1"),
        ({(0, 1): 20, (1, 2): 30, (0, 2): 12}, "2 links fall and b.1 and c.1 part from a.1"),
        ({(0, 1): 30, (1, 2): 20}, "1 link falls and c.1 parts from a.1 and b.1"),
        ({(0, 1): 30}, ""),
    ],
)
def test_what_a_label_parts_counts_maps_that_are_on_a_floor_by_inference(ties, words):
    """A map without a label goes with the better supported side, and its links with the other one fall."""
    links = tuple(link(NAMES[a], NAMES[b], shared) for (a, b), shared in ties.items())
    which = [tuple(NAMES[k]) for k in sorted({end for pair in ties for end in pair})]
    graphs = (SimpleNamespace(maps=which),)
    merged = SimpleNamespace(links=links, graphs=graphs, constraints=ManualConstraints())
    (a, _, c), label = NAMES[:3], "first"
    parting = parted_by(merged, {a: "ground"}, NodeId(*c, 1), label)  # type: ignore[arg-type]
    assert parting.words == words and bool(parting.parts) == bool(words)
    known = parted_by(merged, {a: "ground", c: label}, NodeId(*c, 1), label)  # type: ignore[arg-type]
    assert known.words == "", "what has fallen before does not fall once more"


@pytest.fixture(scope="module")
def twins() -> dict[MapId, HybridMap]:
    """Three robots in rooms that look the same: two on one floor, one above."""
    return {map_id: HybridMap(log) for map_id, log in looked_around(NAMES[:3], seed=6).items()}


def parts(merged: MergedMap) -> Counter[frozenset[MapId]]:
    return Counter(frozenset(node.map for node in component) for component in merged.components)


def test_twin_rooms_on_two_floors_are_kept_apart(twins: dict[MapId, HybridMap]):
    a, b, c = NAMES[:3]
    assert parts(merge_parts(twins, ManualConstraints())) == {frozenset((a, b, c)): 1}, "they look the same"
    floors = {a: "first", b: "second"}
    merged = merge_parts(twins, ManualConstraints(floors=floors))
    assert len(merged.components) == 2 and all(not {a, b} <= part for part in parts(merged))
    assert not any(one.maps == (a, b) for one in merged.links)
    reasons = {refusal.reason for refusal in merged.refused if {refusal.a.map, refusal.b.map} == {a, b}}
    assert "a.1 is on floor first and b.1 is on floor second" in reasons
    every = merge_parts(twins, ManualConstraints(floors={**floors, c: "second"}))
    assert parts(every) == {frozenset((a,)): 1, frozenset((b, c)): 1}
    assert replace(every, refused=()).links, "maps of one floor are joined as before"

"""Two maps that show the same places and cannot be one: both are named, in one line, wherever people look."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from mapweave.explanation_text import maps_words
from mapweave.hybridmap.ids import MapId
from mapweave.mapserver.map_history import MapHistory
from mapweave.merge.explanation.map_explanation import explain_maps
from mapweave.merge.explanation.map_standing import map_standings
from mapweave.merge.explanation.twin_maps import LEAST_NODES, TWINS
from mapweave.merge.mutual_exclusion.collision import Collision
from mapweave.merge.pose_graph.links import Link, refuse
from mapweave.merge.pose_graph.merged_map import MergedMap
from synthetic.maps import changes_of, looking_around, merger_of
from synthetic.world import room, take_map

A, B = MapId("a", 1), MapId("b", 1)
COLLISION = Collision("a", "b", "utc", 17, 0.2, 1.0, 99.0).reason
ALIASED = "most of what the 76 links that agree show is found at other places too"
OTHER = "they contradict each other"


@pytest.fixture(scope="module")
def one() -> MergedMap:
    """Two robots in one room."""
    rng = np.random.default_rng(6)
    here = room(0, 0, 5, 4, 700, rng)
    drives = {which: changes_of(*take_map(here, which, looking_around(6), rng)) for which in (A, B)}
    return merger_of(drives).merged()


def parted(one: MergedMap, reason: str, links: Sequence[Link]) -> MergedMap:
    """The same maps as two, with these links refused."""
    parts = tuple(frozenset(node for node in one.poses if node.map == which) for which in (A, B))
    poses = {node: one.poses[node]._replace(component=k) for k, part in enumerate(parts) for node in part}
    refused = tuple(refuse(link, reason) for link in links)
    return replace(one, links=(), refused=refused, components=parts, poses=poses)


def across(merged: MergedMap) -> list[Link]:
    return [link for link in merged.links if {link.a.map, link.b.map} == {A, B}]


@pytest.mark.parametrize("reason", [COLLISION, ALIASED])
def test_twins_are_named_in_explanation_status_and_history(one: MergedMap, reason: str):
    two = parted(one, reason, across(one))
    explanation = explain_maps(two, A, B)
    assert "a.1 and b.1 are not one map" in explanation.reason and TWINS in explanation.reason
    assert reason in explanation.reason, "the evidence stays"
    for which in (A, B):
        apart = map_standings(two)[which].apart
        assert apart.startswith(f"a.1 and b.1 show the same places and cannot be one map: {TWINS}")
        assert reason in apart
    history = MapHistory()
    history.follow(two)
    assert "a.1 and b.1 are kept apart" in history.newest and TWINS in history.newest
    # The page shows these; the shell adds its command.
    assert "mapweave" not in TWINS and "--" not in TWINS
    assert any("mapweave map retire a.1 --because TEXT" in line for line in maps_words(explanation))


def test_a_few_alike_nodes_or_another_reason_make_no_twins(one: MergedMap):
    first = across(one)[0].a
    few = [link for link in across(one) if link.a == first]
    assert len({link.b for link in across(one)}) >= LEAST_NODES
    for two in (parted(one, COLLISION, few), parted(one, OTHER, across(one))):
        assert TWINS not in explain_maps(two, A, B).reason
        assert all(TWINS not in standing.apart for standing in map_standings(two).values())


def test_maps_that_other_links_join_are_no_twins(one: MergedMap):
    joined = replace(one, refused=tuple(refuse(link, ALIASED) for link in across(one)[1:]))
    assert TWINS not in explain_maps(joined, A, B).reason
    assert all(standing.apart == "" for standing in map_standings(joined).values())
    history = MapHistory()
    history.follow(joined)
    assert TWINS not in history.newest

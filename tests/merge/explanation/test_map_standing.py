"""Why maps are not merged, in a line each, of merges that were really made."""

from collections.abc import Sequence

import numpy as np

from mapweave.hybridmap.constraint_subject import RetiredMap
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.mapserver.merging.merger import Merger
from mapweave.merge.explanation.map_standing import map_standings
from synthetic.maps import changes_of, looking_around, merger_of
from synthetic.world import World, room, take_map

FIRST, SECOND, THIRD = MapId("a", 1), MapId("b", 1), MapId("c", 1)


def mapping(*maps: tuple[MapId, World]) -> Merger:
    rng = np.random.default_rng(6)
    return merger_of(
        {map_id: changes_of(*take_map(world, map_id, looking_around(4), rng)) for map_id, world in maps}
    )


def worlds(*seeds: int) -> Sequence[World]:
    return [room(0, 0, 5, 4, 700, np.random.default_rng(seed)) for seed in seeds]


def test_links_and_the_newest_node_are_those_of_the_map():
    here, elsewhere = worlds(1, 2)
    merged = mapping((FIRST, here), (SECOND, here), (THIRD, elsewhere)).merged()
    standings = map_standings(merged)
    across = [link for link in merged.links if link.a.map != link.b.map]
    assert len(across) > 0
    for map_id, standing in standings.items():
        assert standing.links == sum(map_id in (link.a.map, link.b.map) for link in across)
        assert standing.newest == max(merged.maps[map_id].nodes, key=lambda node: node.number)
    assert standings[FIRST].apart == standings[SECOND].apart == ""
    assert standings[THIRD].apart.startswith("none of its nodes looks like one of another map") or (
        "no two have a common pose" in standings[THIRD].apart
    )


def test_a_map_alone_lacks_nothing():
    (here,) = worlds(1)
    assert map_standings(mapping((FIRST, here)).merged())[FIRST].apart == ""


def test_the_reason_is_that_of_people_or_of_the_merge():
    (here,) = worlds(1)
    merger = mapping((FIRST, here), (SECOND, here), (THIRD, here))
    merger.constrain(
        ManualConstraints((ManualConstraint(RetiredMap(THIRD), True, "anna", 1, "moved house"),))
    )
    standings = map_standings(merger.merged())
    assert "anna" in standings[THIRD].apart and "moved house" in standings[THIRD].apart
    assert standings[FIRST].apart == "" and standings[FIRST].links > 0

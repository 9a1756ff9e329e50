"""A server that adopts a merge in which lengths were corrected has it bit by bit, and says the same of it."""

import pytest

from mapweave.mapserver.map_files import map_file_of, merged_of
from mapweave.merge.explanation.map_lengths import length_words
from mapweave.merge.pose_graph.component import Component
from mapweave.storage.map_file import read_map_file, write_map_file
from synthetic.maps import changes_of, merger_of
from synthetic.wrong_geometry import ODD, SCENES, OdometryFault, draw_fleet
from tests.mapserver.merging.test_stored_merges import Follower, Leader, Results, assert_same, numbered
from tests.merge.pose_graph.test_map_scales import longer

SEED, FACTOR = 9413, 1.04


@pytest.mark.slow
def test_a_corrected_map_is_adopted_bit_by_bit_and_named(tmp_path):
    fleet = draw_fleet(SEED, SCENES["room"], OdometryFault.NONE)
    maps = {**fleet.maps, ODD: longer(fleet.maps[ODD], FACTOR, FACTOR)}
    log = numbered([(which, body) for which, content in maps.items() for body in changes_of(*content)])
    results = Results()
    leader, follower = Leader(results, tmp_path), Follower(results)
    leader.put(log)
    merged = leader.merge()
    follower.take(log)
    assert follower.look()
    assert_same(follower.merged, merged)
    for one in (merged, follower.merged):
        words = length_words(one)
        assert words.keys() == {ODD}
        assert words[ODD].startswith(f"all lengths of map {ODD} are ") and "too long" in words[ODD]
        assert abs(float(words[ODD].split(" about ")[1].split(" %")[0]) - 4.0) < 1.0
        assert "beside those of r0.1, r1.1, r2.1, and are corrected" in words[ODD]
        assert "calibrate the wheels of r3 (mapweave calibrate drive)" in words[ODD]
    # Its own ways are shorter in the merged map than the robot measured them.
    graph = next(one for one in merged.graphs if ODD in one.maps)
    assert isinstance(graph, Component)
    edges = [edge for edge in maps[ODD][1] if abs(edge.a_from_b.mean.x) > 0.5]
    rows = {
        (graph.nodes[a], graph.nodes[b]): k
        for k, (a, b) in enumerate(zip(graph.factors.a, graph.factors.b, strict=True))
    }
    ratios = [
        edge.a_from_b.mean.x / graph.factors.means[rows[edge.a, edge.b], 0]
        for edge in edges
        if (edge.a, edge.b) in rows
    ]
    assert ratios and all(abs(ratio - FACTOR) < 0.01 for ratio in ratios)
    # A merge of everything says the same.
    assert_same(leader.restarted(log), merged)


@pytest.mark.slow
def test_a_map_file_of_a_corrected_map_has_its_poses(tmp_path):
    fleet = draw_fleet(SEED, SCENES["room"], OdometryFault.NONE, stops=2)
    maps = {**fleet.maps, ODD: longer(fleet.maps[ODD], FACTOR, FACTOR)}
    merged = merger_of({which: changes_of(*content) for which, content in maps.items()}).merged()
    path = tmp_path / "m.mapweave"
    write_map_file(path, map_file_of(merged))
    again = merged_of(read_map_file(path))
    assert again.components == merged.components
    # A file rounds measurements; with the lengths as they were measured nodes would be centimetres off.
    assert max(again.pose(node).distance(merged.pose(node)) for node in merged.poses) < 2e-3
    assert length_words(again).keys() == {ODD}

"""A map of which a server refused a change is implausible: also without that server."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapweave import Edge, EdgeKind, MapId, NodeId, Pose2, PoseGaussian, read_map_file, write_map_file
from mapweave.cli import main
from mapweave.hybridmap.change import EdgePut
from mapweave.hybridmap.explanation import MARGINAL
from mapweave.mapserver.base_map import BaseMap
from mapweave.mapserver.content_hash import content_hash
from mapweave.mapserver.log.entry import words_of
from mapweave.mapserver.log.salvage import all_of, salvage
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.mapserver.own_maps import marginal_links
from mapweave.mapserver.server import MapServer
from mapweave.merge.pose_graph.links import Link
from mapweave.opened_map import open_map
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from synthetic.maps import LOG_ID, entries_of, fill_store, looked_around

R0, R1 = MapId("r0", 1), MapId("r1", 1)
WORDS = "is refused (edge r1.1.98 is 99000 m long"


@pytest.fixture(scope="module")
def stores(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A store that has taken all that two robots sent, and one that has refused an edge of the second."""
    folder, changes = tmp_path_factory.mktemp("stores"), looked_around((R0, R1), seed=8)
    far = PoseGaussian(Pose2(99e3), np.eye(3))
    edge = Edge(NodeId(*R1, 98), NodeId(*R1, 1), NodeId(*R1, 3), far, EdgeKind.MAPPED)
    sound, unsound = folder / "sound", folder / "unsound"
    for path in (sound, unsound):
        store = SqliteStore(path)
        fill_store(store, changes)
        if path is unsound:
            *_, refused = entries_of(R1, [*changes[R1], EdgePut(edge)])
            applied = store.apply(R1, LOG_ID, [refused], refused.sequence)
            assert [WORDS in words_of(one) for one in applied.refusals] == [True]
        store.close()
    return sound, unsound


def implausible(path: Path) -> set[MapId]:
    """Maps of which a merge says that a change was refused."""
    found = open_map(path).merged_again().implausible
    assert all(WORDS in why for why in found.values())
    return {*found}


def merged(out: Path, *files: Path) -> Path:
    assert main(["map", "merge", *map(str, files), "-o", str(out)]) == 0
    return out


def test_a_merge_without_the_server_knows_it(stores: tuple[Path, Path], tmp_path):
    sound, unsound = stores
    assert implausible(sound) == set() and implausible(unsound) == {R1}
    whole = merged(tmp_path / "unsound", unsound)
    assert {maps: WORDS in why for maps, why in read_map_file(whole).refused_changes.items()} == {R1: True}
    assert content_hash(open_map(sound).content) != content_hash(open_map(unsound).content)
    # So do files that are made of it: merged again, or taken apart.
    assert implausible(merged(tmp_path / "again", whole)) == {R1}
    assert main(["map", "extract", str(unsound), "-o", str(tmp_path / "own")]) == 0
    assert read_map_file(tmp_path / "own" / "r0.1.mapweave").refused_changes == {}
    apart = merged(tmp_path / "apart", *sorted((tmp_path / "own").iterdir()))
    assert implausible(apart) == {R1} and read_map_file(apart).refused_changes.keys() == {R1}


def test_a_correction_keeps_what_is_left_of_pruned_nodes(stores: tuple[Path, Path], tmp_path):
    """The links between their neighbours, which no comparison of images finds again."""
    path = merged(tmp_path / "whole", stores[0])
    content = read_map_file(path)
    a, b = NodeId(*R0, 1), NodeId(*R0, 5)
    left = Link(a, b, PoseGaussian(Pose2(0.5), 0.01 * np.eye(3)), evidence={MARGINAL: 1.0}).edge()
    write_map_file(path, replace(content, changes=(*content.changes, EdgePut(left))))
    assert [edge.id for edge in marginal_links(read_map_file(path))] == [left.id]
    assert main(["map", "unmerge", "r0.1", "r1.1", "--map", str(path), "--because", "two floors"]) == 0
    assert len({number for number, _ in read_map_file(path).poses.values()}) > 1
    assert [(edge.a, edge.b) for edge in marginal_links(read_map_file(path))] == [(a, b)]


def test_a_server_that_begins_with_the_file_knows_it(stores: tuple[Path, Path], tmp_path):
    for store, known in zip(stores, (set(), {R1}), strict=True):
        base = BaseMap.of(store.name, open_map(store).content)
        with MapServer(
            MemoryBus(MemoryHub()), Keys("base"), tmp_path / store.name, "s0", base=base
        ) as server:  # fmt: skip
            assert server.settle(60) and server.merged().implausible.keys() == known


def test_a_damaged_store_still_says_which_map(stores: tuple[Path, Path], opened):
    sound, unsound = stores
    assert salvage(sound).refused_changes == {}
    found = salvage(unsound).refused_changes
    store = opened(SqliteStore(unsound))
    assert found.keys() == {R1} and all_of(store).refused_changes == found

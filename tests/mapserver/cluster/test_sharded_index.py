"""An index in shards gives what one index gives, whatever happens to the shards; else it says so."""

import random
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from mapweave.hybridmap.change import NodePut
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.query import Certainty, View
from mapweave.mapserver.cluster.sharded_index import ShardedIndex
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.relocalization.relocalizer import Relocalizer
from mapweave.mapserver.retrieval.place_database import PlaceDatabase
from mapweave.mapserver.retrieval.place_index import PlaceIndex
from mapweave.mapserver.retrieval.ranking import Ranked
from synthetic.building import Building
from tests.mapserver.cluster.local_shards import LocalShards
from tests.waiting import eventually

SHARDS = 3
TIES = 0.1
"""What equally near landmarks change in a score; a node's own score is 16."""


@cache
def fleet() -> tuple[Node, ...]:
    """Of six robots in one building."""
    building = Building.draw(6, 16, 1)
    changes = [change for robot in range(6) for _, change in building.log(robot)]
    return tuple(change.node for change in changes if isinstance(change, NodePut))


@contextmanager
def shards(nodes: tuple[Node, ...] = (), **how: float) -> Iterator[LocalShards]:
    """That have some nodes, and answer themselves."""
    cluster = LocalShards(SHARDS, **how)  # type: ignore[arg-type]
    try:
        cluster.index.extend(nodes)
        cluster.index.start()
        eventually(lambda: all(link.current for link in cluster.links))
        yield cluster
    finally:
        cluster.close()


def view_of(node: Node) -> View:
    return View(node.landmarks.pixels, node.landmarks.codes, node.camera)


def one_index(nodes: tuple[Node, ...]) -> PlaceIndex:
    index = PlaceIndex()
    index.extend(nodes)
    return index


def assert_alike(ranked: Ranked, theirs: Ranked) -> None:
    """The same nodes with the same scores, but for votes of landmarks that are equally near.

    Descriptors are quantised: of two at the same distance the index takes the one that came first as the last
    neighbour of a feature.
    """
    assert theirs and ranked[0][0] == theirs[0][0]
    scores, their_scores = dict(ranked), dict(theirs)
    last = max(ranked[-1][1], theirs[-1][1])
    for node in scores.keys() | their_scores.keys():
        assert scores.get(node, last) == pytest.approx(their_scores.get(node, last), abs=TIES)


def assert_same(index: ShardedIndex, one: PlaceIndex, nodes: tuple[Node, ...]) -> None:
    """To every question the same answer, and a whole one."""
    for node in nodes[::9]:
        hidden = [other.id for other in nodes[::3]]
        for exclude in ((), hidden):
            ranked = index.query(view_of(node), 16, exclude)
            assert not ranked.missing
            assert_alike(ranked, one.query(view_of(node), 16, exclude))
        assert index.overlaps(node, dict[object, Node]().get) == pytest.approx(
            one.overlaps(node, dict[object, Node]().get)
        )


def test_shards_answer_as_one_index_before_they_are_there_and_after():
    cluster, nodes = LocalShards(SHARDS), fleet()
    cluster.index.extend(nodes)
    assert cluster.index.status == "0 of 3 shards; 3 in this process"
    assert_same(cluster.index, one_index(nodes), nodes)
    cluster.close()
    with shards(nodes) as cluster:
        assert cluster.index.status == "3 of 3 shards" and len(cluster.index) == len(nodes)
        assert_same(cluster.index, one_index(nodes), nodes)


def test_copies_of_a_place_take_no_votes_once_they_are_hidden():
    """All nearest landmarks of each shard may be copies: then more are asked for."""
    nodes = fleet()
    copies = tuple(
        replace(node, id=NodeId(f"liar{k}", 1, node.id.number)) for node in nodes[:2] for k in range(60)
    )
    with shards((*nodes, *copies)) as cluster:
        for node in nodes[:2]:
            ranked = cluster.index.query(view_of(node), 16, [copy.id for copy in copies])
            assert not ranked.missing
            assert_alike(ranked, one_index(nodes).query(view_of(node), 16))


def test_landmarks_that_are_wanted_are_counted_as_nodes_come_and_go():
    """They decide which cells a shard searches: what is hidden, gone or put twice does not count."""
    nodes = fleet()
    shorter = replace(nodes[0], landmarks=nodes[0].landmarks.take(np.arange(5)))
    hidden = [node.id for node in nodes[10:20]]
    with shards(nodes) as cluster:
        cluster.index.extend([nodes[1], shorter, shorter])
        cluster.index.remove(nodes[2].id)
        cluster.index.remove(nodes[2].id)
        left = [shorter, nodes[1], *nodes[3:10], *nodes[20:]]
        assert sum(link.wanted(hidden) for link in cluster.links) == sum(len(one.landmarks) for one in left)
        assert sum(link.wanted(()) for link in cluster.links) == sum(
            len(one.landmarks) for one in [*left, *nodes[10:20]]
        )


def test_a_map_stays_whole_in_one_shard():
    with shards(fleet()) as cluster:
        for agent in {node.id.agent for node in fleet()}:
            ids = [node.id for node in fleet() if node.id.agent == agent]
            assert [sum(one in link for one in ids) for link in cluster.links].count(len(ids)) == 1


def test_a_dead_shard_makes_answers_partial_until_it_is_filled_again():
    nodes = fleet()
    with shards(nodes[:60]) as cluster:
        cluster.kill(1)
        ranked = cluster.index.query(view_of(nodes[0]), 16)
        assert ranked.missing == "1 of 3 shards of the map did not answer"
        assert {node for node, _ in ranked} <= {n.id for n in nodes[:60] if n.id not in cluster.links[1]}
        # What comes and goes meanwhile must be there, and not be there, afterwards.
        cluster.index.extend(nodes[60:])
        cluster.index.remove(nodes[3].id)
        cluster.restart(1)
        eventually(lambda: cluster.links[1].current)
        left = tuple(node for node in nodes if node.id != nodes[3].id)
        assert_same(cluster.index, one_index(left), left)


def test_a_shard_that_was_only_slow_is_current_again_without_being_filled():
    nodes = fleet()
    with shards(nodes, timeout=0.3) as cluster:
        server = cluster.servers[2]
        assert server is not None
        before = server._state
        cluster.gates[2].clear()
        assert cluster.index.query(view_of(nodes[0]), 16).missing
        cluster.gates[2].set()
        eventually(lambda: cluster.links[2].current)
        assert server._state == before
        assert not cluster.index.query(view_of(nodes[0]), 16).missing


def test_a_shard_lost_for_long_is_answered_for_in_this_process():
    nodes = fleet()
    with shards(nodes, stand_in_after=0.0) as cluster:
        cluster.kill(0)
        assert cluster.index.query(view_of(nodes[0]), 16).missing
        eventually(lambda: cluster.links[0].answers)
        assert cluster.index.status == "2 of 3 shards; 1 in this process"
        assert_same(cluster.index, one_index(nodes), nodes)
        cluster.restart(0)
        eventually(lambda: cluster.links[0].current)
        assert_same(cluster.index, one_index(nodes), nodes)


def test_without_the_cluster_the_server_answers_from_its_own_index():
    nodes = fleet()
    with shards(nodes) as cluster:
        cluster.gone = True
        assert "3 of 3" in cluster.index.query(view_of(nodes[0]), 16).missing
        eventually(lambda: all(link.answers for link in cluster.links))
        assert_same(cluster.index, one_index(nodes), nodes)


@pytest.mark.parametrize("seed", range(2))
def test_whatever_is_lost_killed_or_slow_nothing_is_missing_in_the_end(seed: int):
    """Against one index: a whole answer is always the right one, and in the end all are whole."""
    nodes, rng = fleet(), random.Random(seed)
    with shards(timeout=0.2, stand_in_after=0.1) as cluster:
        one, there = PlaceIndex(), dict[object, Node]()
        cluster.drop = lambda shard, request: rng.random() < 0.05
        whole = 0
        for step in range(60):
            node = rng.choice(nodes)
            if node.id in there and rng.random() < 0.3:
                del there[node.id]
                cluster.index.remove(node.id)
                one.remove(node.id)
            else:
                there[node.id] = node
                cluster.index.add(node)
                one.add(node)
            if step % 20 == 10:
                cluster.restart(rng.randrange(SHARDS))
            if step % 20 == 15:
                slow = rng.randrange(SHARDS)
                cluster.gates[slow].clear()
                cluster.index.query(view_of(node), 16)
                cluster.gates[slow].set()
            ranked = cluster.index.query(view_of(node), 16)
            if not ranked.missing:
                whole += 1
                assert_alike(ranked, one.query(view_of(node), 16))
        cluster.drop = lambda shard, request: False
        eventually(lambda: all(link.current for link in cluster.links))
        assert whole and len(cluster.index) == len(there)
        assert_same(cluster.index, one, tuple(there.values()))


@pytest.mark.slow
def test_merging_by_shards_finds_the_same_links_though_one_dies():
    building = Building.draw(4, 12, 2)
    log = [change for robot in range(4) for change in building.log(robot)]
    alone = Merger()
    alone.read(log)
    expected = alone.merged()
    with shards() as cluster:
        merger = Merger(PlaceDatabase(index=cluster.index))
        merger.read(log)
        merger.search_pairs(20)
        cluster.kill(1)

        def restart() -> None:
            eventually(lambda: not cluster.links[1].current)
            cluster.restart(1)

        ray = threading.Thread(target=restart)
        ray.start()
        merged = merger.merged()
        ray.join()
    assert len(merged.links) > 20
    assert [link.pair for link in merged.links] == [link.pair for link in expected.links]
    off = [merged.pose(node).distance(expected.pose(node)) for node in expected.poses]
    assert max(off) < 1e-3


def test_a_node_that_could_not_be_compared_with_all_does_not_pass_for_compared():
    building = Building.draw(2, 8, 3)
    cluster = LocalShards(SHARDS)
    merger = Merger(PlaceDatabase(index=cluster.index))
    cluster.index.start()
    eventually(lambda: all(link.current for link in cluster.links))
    for server in range(SHARDS):
        cluster.kill(server)
    cluster.index.close()
    for map_id, change in building.log(0):
        merger.apply(map_id, change)
    assert merger.uncompared == 8 and not merger.findings().prints
    merger.search_pairs()
    assert merger.uncompared == 8
    cluster.close()


def test_a_place_that_is_certain_on_the_whole_map_is_not_on_a_part_of_it():
    building = Building.draw(2, 16, 1)
    log = [change for robot in range(2) for change in building.log(robot)]
    nodes = [change.node for _, change in log if isinstance(change, NodePut)]
    with shards(timeout=1.0) as cluster:
        merger = Merger(PlaceDatabase(index=cluster.index))
        merger.read(log)
        relocalizer = Relocalizer(merger.places, merger.node, merger.merged())
        # Aliases are searched with the first question; these must not be kept of a part of the map.
        node = next(node for node in nodes if len(node.landmarks) > 40)
        lost = next(k for k, link in enumerate(cluster.links) if node.id not in link)
        cluster.kill(lost)
        partial = relocalizer.answer(view_of(node))
        assert partial.certainty is Certainty.AMBIGUOUS and partial.candidates[0].node == node.id
        assert partial.partial == "1 of 3 shards of the map did not answer" and "partial" in partial.reason
        assert node.id not in relocalizer.alike
        cluster.restart(lost)
        eventually(lambda: cluster.links[lost].current)
        whole = relocalizer.answer(view_of(node))
        assert whole.certainty is Certainty.FOUND and not whole.partial and node.id in relocalizer.alike

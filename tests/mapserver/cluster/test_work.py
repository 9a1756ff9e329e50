"""Nodes compared elsewhere: the same verdicts, whatever fails there."""

from concurrent.futures import Future, ThreadPoolExecutor
from itertools import combinations

import pytest

from mapweave.hybridmap.change import NodePut
from mapweave.mapserver.cluster import work
from mapweave.mapserver.cluster.work import WorkPool, answer_work
from mapweave.mapserver.merging.node_comparisons import compare
from mapweave.merge.pose_graph.links import Link
from synthetic.building import Building


@pytest.mark.parametrize("failing", [0, 3, 1])
def test_verdicts_are_those_of_one_server(failing: int, monkeypatch):
    """With workers that never fail, at every third request, or always; in order, for several requests."""
    monkeypatch.setattr(work, "PAIRS", 5)
    nodes = [change.node for _, change in Building.draw(1, 8, 1).log(0) if isinstance(change, NodePut)]
    nodes += [change.node for _, change in Building.draw(2, 8, 1).log(1) if isinstance(change, NodePut)]
    pairs = list(combinations(nodes, 2))[:48]
    asked = 0

    def call(request: bytes) -> Future[bytes]:
        nonlocal asked
        asked += 1
        if failing and asked % failing == 0:
            lost: Future[bytes] = Future()
            lost.set_exception(ConnectionError("the worker is dead"))
            return lost
        return workers.submit(answer_work, request)

    with ThreadPoolExecutor(2) as workers:
        found = [*WorkPool(call, lambda: 2).compare(pairs)]
    assert asked == 10
    expected = [*compare(pairs)]
    assert [(v.a, v.b, type(v)) for v in found] == [(v.a, v.b, type(v)) for v in expected]
    for one, other in zip(found, expected, strict=True):
        if isinstance(one, Link) and isinstance(other, Link):
            assert one.a_from_b.mean == other.a_from_b.mean


def test_without_a_cluster_all_is_done_here(monkeypatch):
    monkeypatch.setattr(work, "PAIRS", 2)
    nodes = [change.node for _, change in Building.draw(1, 4, 1).log(0) if isinstance(change, NodePut)]

    def call(request: bytes) -> Future[bytes]:
        raise AssertionError("there is no cluster")

    assert len([*WorkPool(call, lambda: 0).compare(list(combinations(nodes, 2)))]) == 6


def test_workers_that_never_answer_are_not_waited_for_twice(monkeypatch):
    monkeypatch.setattr(work, "PATIENCE", 0.5)
    nodes = [change.node for _, change in Building.draw(1, 5, 1).log(0) if isinstance(change, NodePut)]
    pairs, asked = list(combinations(nodes, 2)), []

    def call(request: bytes) -> Future[bytes]:
        asked.append(request)
        return Future()

    pool = WorkPool(call, lambda: 1)
    assert len([*pool.compare(pairs)]) == len([*pool.compare(pairs)]) == 10 and len(asked) == 3

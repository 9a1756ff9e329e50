"""Settled means merged: not when a change is taken from the queue, nor while the merge is being made."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from benchmarks.synthetic import room, take_map
from hybridmap.change import Change, EdgePut, NodePut, NodeRetired
from hybridmap.node import MapId
from hybridmap.pose import Pose2
from hybridmap.ruling import Ruling, Rulings
from mapserver.merger import Merger
from mapserver.upkeep import Upkeep
from merge.merged import MergedMap


def test_it_is_not_settled_while_it_merges(monkeypatch: pytest.MonkeyPatch) -> None:
    entered, go = threading.Event(), threading.Event()
    real = Merger.merged

    def held(merger: Merger) -> MergedMap:
        entered.set()
        assert go.wait(20)
        return real(merger)

    monkeypatch.setattr(Merger, "merged", held)
    upkeep = Upkeep(1.0)
    assert upkeep.settled
    upkeep.start()
    rulings = Rulings([Ruling((MapId("a", 1), MapId("b", 1)), True, "anna", 0)])
    upkeep.rule(rulings)
    assert entered.wait(20)
    assert not upkeep.settled
    go.set()
    end = time.monotonic() + 20
    while not upkeep.settled:
        assert time.monotonic() < end
        time.sleep(0.001)
    assert upkeep.answers.merged.rulings is rulings
    upkeep.close()


@pytest.mark.parametrize("broken", [False, True])
def test_a_store_that_is_read_at_once_merges_like_its_changes_one_by_one(
    broken: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    rng = np.random.default_rng(1)
    world, changes = room(0, 0, 5, 4, 600, rng), []
    for agent in ("a", "b"):
        tour = [Pose2(2.2 + 0.1 * k, 1.8, 0.9 * k) for k in range(4)]
        nodes, edges = take_map(world, MapId(agent, 1), tour, rng)
        bodies = [*map(NodePut, nodes), *map(EdgePut, edges), NodePut(nodes[1]), NodeRetired(nodes[3].id)]
        changes += [Change(MapId(agent, 1), k + 1, 0, body) for k, body in enumerate(bodies)]
    if broken:

        def fails(*_: object) -> None:
            raise RuntimeError("a defect")

        monkeypatch.setattr(Merger, "read", fails)
    merged = []
    for at_once in (True, False):
        upkeep = Upkeep(1.0)
        if at_once:
            upkeep.read(iter(changes))
        else:
            for change in changes:
                upkeep.take(change)
        upkeep.start()
        assert upkeep.settle(30)
        merged.append(upkeep.answers.merged)
        upkeep.close()
    assert ("one by one" in caplog.text) is broken
    one, two = merged
    assert len(one.links) > 0 and one.summary() == two.summary() and "6 nodes" in one.summary()
    assert [(link.a, link.b) for link in one.links] == [(link.a, link.b) for link in two.links]
    for node, placement in one.postures.items():
        there = two.postures[node].merged_from_robot.mean
        assert placement.merged_from_robot.mean.distance(there) < 1e-9

"""Settled means merged: not when a change is taken from the queue, nor while the merge is being made."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from mapweave.hybridmap.change import Change, EdgePut, NodePut, NodeRetired
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.hybridmap.node import MapId, Node
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import NO_COMPONENT, Certainty
from mapweave.mapserver.merge_worker import MergeWorker
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.retrieval.place_database import PlaceDatabase
from mapweave.mapserver.schedule import LiveSchedule, LockstepSchedule
from mapweave.merge.pose_graph.merged_map import MergedMap
from synthetic.world import World, room, take_map, take_view


def test_it_is_not_settled_while_it_merges(monkeypatch: pytest.MonkeyPatch) -> None:
    entered, go = threading.Event(), threading.Event()
    real = Merger.merged

    def held(merger: Merger, use: Callable[[MergedMap], object] | None = None) -> MergedMap:
        entered.set()
        assert go.wait(20)
        return real(merger, use)

    monkeypatch.setattr(Merger, "merged", held)
    upkeep = MergeWorker(LiveSchedule(), 1.0)
    assert upkeep.settled
    upkeep.start()
    rulings = ManualConstraints([ManualConstraint((MapId("a", 1), MapId("b", 1)), True, "anna", 0)])
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
def test_a_store_read_at_once_merges_as_change_by_change(
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
        upkeep = MergeWorker(LiveSchedule(), 1.0)
        upkeep.start()
        if at_once:
            upkeep.read(iter(changes))
        else:
            for change in changes:
                upkeep.take(change)
        assert upkeep.settle(30)
        merged.append(upkeep.answers.merged)
        upkeep.close()
    assert ("one by one" in caplog.text) is broken
    one, two = merged
    assert len(one.links) > 0 and one.summary() == two.summary() and "6 nodes" in one.summary()
    assert [(link.a, link.b) for link in one.links] == [(link.a, link.b) for link in two.links]
    for node, placement in one.poses.items():
        there = two.poses[node].merged_from_robot.mean
        assert placement.merged_from_robot.mean.distance(there) < 1e-9


def mapped_room(agents: tuple[str, ...]) -> tuple[World, list[Pose2], list[Change]]:
    """A room, where each robot stood in it, and their logs."""
    rng = np.random.default_rng(1)
    world = room(0, 0, 5, 4, 600, rng)
    tour, changes = [Pose2(2.2 + 0.1 * k, 1.8, 0.9 * k) for k in range(4)], []
    for agent in agents:
        bodies = [body for made in take_map(world, MapId(agent, 1), tour, rng) for body in made]
        bodies = [NodePut(one) if isinstance(one, Node) else EdgePut(one) for one in bodies]
        changes += [Change(MapId(agent, 1), k + 1, 0, body) for k, body in enumerate(bodies)]
    return world, tour, changes


def test_a_new_place_is_found_while_a_merge_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    world, tour, changes = mapped_room(("a",))
    view, _ = take_view(world, tour[1], np.random.default_rng(3))
    entered, go, real = threading.Event(), threading.Event(), Merger.merged

    def held(merger: Merger, use: Callable[[MergedMap], object] | None = None) -> MergedMap:
        entered.set()
        assert go.wait(20)
        return real(merger, use)

    monkeypatch.setattr(Merger, "merged", held)
    upkeep = MergeWorker(LiveSchedule(), 1.0)
    upkeep.start()
    upkeep.rule(ManualConstraints())
    assert entered.wait(20)
    assert upkeep.answers.relocalizer.answer(view).certainty is Certainty.UNKNOWN
    for change in changes:
        upkeep.take(change)
    began = time.monotonic()
    answer = upkeep.answers.relocalizer.answer(view)
    assert time.monotonic() - began < 1.0 and answer.certainty is Certainty.FOUND
    best = answer.candidates[0]
    assert best.component == NO_COMPONENT and best.merged_from_robot is None
    go.set()
    assert upkeep.settle(20)
    merged = upkeep.answers.relocalizer.answer(view).candidates[0]
    assert merged.node == best.node and merged.component == 0 and merged.merged_from_robot is not None
    upkeep.close()


def test_a_store_answers_map_by_map_until_its_maps_are_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    world, tour, changes = mapped_room(("a", "b"))
    view, _ = take_view(world, tour[1], np.random.default_rng(3))
    go, real = threading.Event(), Merger.search_pairs

    def held(merger: Merger, most: int | None = None) -> None:
        assert go.wait(20)
        real(merger, most)

    monkeypatch.setattr(Merger, "search_pairs", held)
    upkeep = MergeWorker(LiveSchedule(), 1.0)
    upkeep.start()
    upkeep.read(iter(changes))
    assert len(upkeep.answers.merged.components) == 2
    assert not upkeep.settled and not upkeep.answers.merged.links
    answer = upkeep.answers.relocalizer.answer(view)
    assert {one.node.agent for one in answer.candidates} == {"a", "b"}
    assert len({one.component for one in answer.candidates}) == 2
    assert answer.certainty is Certainty.AMBIGUOUS and "nothing joins" in answer.reason
    go.set()
    assert upkeep.settle(30)
    answer = upkeep.answers.relocalizer.answer(view)
    assert answer.certainty is Certainty.FOUND and len(upkeep.answers.merged.components) == 1
    upkeep.close()


def test_in_lockstep_all_changes_are_merged_before_an_answer() -> None:
    _, _, changes = mapped_room(("a",))
    places, schedule = PlaceDatabase(), LockstepSchedule()
    upkeep = MergeWorker(schedule, 1.0, places=places)
    upkeep.start()
    for change in changes:
        upkeep.take(replace(change, stamp_ns=change.sequence))
    assert len(upkeep.answers.merged.poses) == 0
    assert len(upkeep.current().merged.poses) == len(places) == 4 and upkeep.settled
    assert schedule.time_ns() == len(changes)
    upkeep.close()


def test_a_database_that_is_empty_at_first_is_the_one_that_is_filled() -> None:
    """The owner of the database saves it: a server's first start must leave a saved index, too."""
    _, _, changes = mapped_room(("a",))
    places = PlaceDatabase()
    upkeep = MergeWorker(LiveSchedule(), 1.0, places=places)
    upkeep.start()
    upkeep.read(iter(changes))
    assert len(places) == 4
    upkeep.close()

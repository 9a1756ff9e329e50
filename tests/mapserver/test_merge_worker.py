"""Settled means merged: not when a change is taken from the queue, nor while the merge is being made."""

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from mapweave.hybridmap.change import Change, NodePut, NodeRetired
from mapweave.hybridmap.constraint_subject import Apart
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import NO_COMPONENT, Certainty
from mapweave.mapserver.answers import Answers
from mapweave.mapserver.log.store import Store
from mapweave.mapserver.map_history import MapHistory
from mapweave.mapserver.merge_worker import MergeWorker
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.merging.stored_merges import StoredMerges
from mapweave.mapserver.retrieval.place_database import PlaceDatabase
from mapweave.mapserver.schedule import LiveSchedule, LockstepSchedule
from mapweave.merge.pose_graph.merged_map import MergedMap
from synthetic.maps import changes_of, map_tours, numbered
from synthetic.world import World, room, take_map, take_view
from tests.mapserver.merging.test_restart_record import drives
from tests.mapserver.merging.test_stored_merges import Leader, Results, hash_of
from tests.mapserver.merging.test_stored_merges import numbered as numbered_log
from tests.waiting import eventually


def held_merges(monkeypatch: pytest.MonkeyPatch) -> tuple[threading.Event, threading.Event]:
    """Events: a merge has begun, and it may go on."""
    entered, go = threading.Event(), threading.Event()
    real = Merger.merged

    def held(merger: Merger, use: Callable[[MergedMap], object] | None = None) -> MergedMap:
        entered.set()
        assert go.wait(20)
        return real(merger, use)

    monkeypatch.setattr(Merger, "merged", held)
    return entered, go


def test_it_is_not_settled_while_it_merges(monkeypatch):
    entered, go = held_merges(monkeypatch)
    worker = MergeWorker(LiveSchedule(), 1.0)
    assert worker.settled
    worker.start()
    constraints = ManualConstraints(
        [ManualConstraint(Apart((MapId("a", 1), MapId("b", 1))), True, "anna", 0)]
    )
    worker.constrain(constraints)
    assert entered.wait(20)
    assert not worker.settled
    go.set()
    end = time.monotonic() + 20
    while not worker.settled:
        assert time.monotonic() < end
        time.sleep(0.001)
    assert worker.answers.merged.constraints.made == constraints.made
    worker.close()


@pytest.mark.parametrize(
    ("where", "method"),
    [(StoredMerges, "read"), (PlaceDatabase, "leave_out"), (Answers, "of"), (MapHistory, "follow")],
)
def test_a_follower_that_fails_with_a_merge_goes_on_alone_and_follows_again(
    where: type, method: str, tmp_path
):
    """Who waits for it is released; a history that fails is no reason to give up."""
    log = numbered_log(drives(1))
    results, followed = Results(), Results()
    followed.leads, followed.values = False, results.values
    leader = Leader(results, tmp_path / "s0")
    worker = MergeWorker(LiveSchedule(), 1.0, stored=StoredMerges(cast(Store, followed), "s1"))
    adoption, real = worker._adoption, getattr(where, method)
    assert adoption is not None

    def fails(*args: Any) -> Any:
        if worker._following:
            raise RuntimeError("a defect")
        return real(*args)

    def merge(changes: list[Change]) -> MergedMap:
        leader.put(changes)
        return leader.merge()

    worker.start()
    worker.read(())
    with closing(worker), ThreadPoolExecutor(1) as threads:
        for change in log[:24]:
            worker.take(change)
        waiting = threads.submit(worker.settle, 20.0)
        eventually(lambda: worker.behind == 24 and bool(worker._waiting_for))
        merged = merge(log[:24])
        with pytest.MonkeyPatch.context() as broken:
            broken.setattr(where, method, fails)
            worker.follow_merges()
            assert waiting.result()
        assert worker.settled and worker.behind == 0
        assert worker.answers.merged.poses.keys() == merged.poses.keys()
        alone = "" if where is MapHistory else "a merge could not be adopted (RuntimeError: a defect)"
        assert worker.alone == alone and bool(worker.counters().merges) == bool(alone)
        # The next merge is followed again, after a while.
        merged = merge(log[24:40])
        for change in log[24:40]:
            worker.take(change)
        worker.follow_merges()
        assert worker.settle(20.0) and worker.alone == alone
        adoption._again_at = 0.0
        worker.follow_merges()
        assert worker.settle(20.0) and worker.alone == ""
        assert hash_of(worker.answers.merged) == hash_of(merged)


@pytest.mark.parametrize("broken", [False, True])
def test_a_store_read_at_once_merges_as_change_by_change(broken: bool, monkeypatch, caplog):
    rng = np.random.default_rng(1)
    world, changes = room(0, 0, 5, 4, 600, rng), []
    for agent in ("a", "b"):
        tour = [Pose2(2.2 + 0.1 * k, 1.8, 0.9 * k) for k in range(4)]
        nodes, edges = take_map(world, MapId(agent, 1), tour, rng)
        contents = [*changes_of(nodes, edges), NodePut(nodes[1]), NodeRetired(nodes[3].id)]
        changes += numbered(MapId(agent, 1), contents)
    if broken:

        def fails(*_: object) -> None:
            raise RuntimeError("a defect")

        monkeypatch.setattr(Merger, "read", fails)
    merged = []
    for at_once in (True, False):
        worker = MergeWorker(LiveSchedule(), 1.0)
        worker.start()
        if at_once:
            worker.read(iter(changes))
        else:
            for change in changes:
                worker.take(change)
        assert worker.settle(30)
        merged.append(worker.answers.merged)
        worker.close()
    assert ("one by one" in caplog.text) is broken
    first, second = merged
    assert len(first.links) > 0 and first.summary() == second.summary() and "6 nodes" in first.summary()
    assert [(link.a, link.b) for link in first.links] == [(link.a, link.b) for link in second.links]
    for node, placement in first.poses.items():
        there = second.poses[node].merged_from_robot.mean
        assert placement.merged_from_robot.mean.distance(there) < 1e-9


def mapped_room(agents: tuple[str, ...]) -> tuple[World, list[Pose2], list[Change]]:
    """A room, where each robot stood in it, and their logs."""
    rng = np.random.default_rng(1)
    world = room(0, 0, 5, 4, 600, rng)
    tour, changes = [Pose2(2.2 + 0.1 * k, 1.8, 0.9 * k) for k in range(4)], []
    for map_id, log in map_tours(world, {MapId(agent, 1): tour for agent in agents}, rng).items():
        changes += numbered(map_id, log)
    return world, tour, changes


def test_a_new_place_is_found_while_a_merge_goes_on(monkeypatch):
    world, tour, changes = mapped_room(("a",))
    view, _ = take_view(world, tour[1], np.random.default_rng(3))
    entered, go = held_merges(monkeypatch)
    worker = MergeWorker(LiveSchedule(), 1.0)
    worker.start()
    worker.constrain(ManualConstraints())
    assert entered.wait(20)
    assert worker.answers.relocalizer.answer(view).certainty is Certainty.UNKNOWN
    for change in changes:
        worker.take(change)
    began = time.monotonic()
    answer = worker.answers.relocalizer.answer(view)
    assert time.monotonic() - began < 1.0 and answer.certainty is Certainty.FOUND
    best = answer.candidates[0]
    assert best.component == NO_COMPONENT and best.merged_from_robot is None
    go.set()
    assert worker.settle(20)
    merged = worker.answers.relocalizer.answer(view).candidates[0]
    assert merged.node == best.node and merged.component == 0 and merged.merged_from_robot is not None
    worker.close()


def test_a_store_answers_map_by_map_until_its_maps_are_compared(monkeypatch):
    world, tour, changes = mapped_room(("a", "b"))
    view, _ = take_view(world, tour[1], np.random.default_rng(3))
    go, real = threading.Event(), Merger.search_pairs

    def held(merger: Merger, most: int | None = None) -> None:
        assert go.wait(20)
        real(merger, most)

    monkeypatch.setattr(Merger, "search_pairs", held)
    worker = MergeWorker(LiveSchedule(), 1.0)
    worker.start()
    worker.read(iter(changes))
    assert len(worker.answers.merged.components) == 2
    assert not worker.settled and not worker.answers.merged.links
    answer = worker.answers.relocalizer.answer(view)
    assert {candidate.node.agent for candidate in answer.candidates} == {"a", "b"}
    assert len({candidate.component for candidate in answer.candidates}) == 2
    assert answer.certainty is Certainty.AMBIGUOUS and "nothing joins" in answer.reason
    go.set()
    assert worker.settle(30)
    answer = worker.answers.relocalizer.answer(view)
    assert answer.certainty is Certainty.FOUND and len(worker.answers.merged.components) == 1
    worker.close()


def test_in_lockstep_all_changes_are_merged_before_an_answer():
    _, _, changes = mapped_room(("a",))
    places, schedule = PlaceDatabase(), LockstepSchedule()
    worker = MergeWorker(schedule, 1.0, places=places)
    worker.start()
    for change in changes:
        worker.take(replace(change, stamp_ns=change.sequence))
    assert len(worker.answers.merged.poses) == 0
    assert len(worker.current().merged.poses) == len(places) == 4 and worker.settled
    assert schedule.time_ns() == len(changes)
    worker.close()


def test_a_database_that_is_empty_at_first_is_the_one_that_is_filled():
    """The owner of the database saves it: a server's first start must leave a saved index, too."""
    _, _, changes = mapped_room(("a",))
    places = PlaceDatabase()
    worker = MergeWorker(LiveSchedule(), 1.0, places=places)
    worker.start()
    worker.read(iter(changes))
    assert len(places) == 4
    worker.close()


def test_the_last_waiting_write_of_a_node_counts():
    _, _, (first, *_) = mapped_room(("a",))
    assert isinstance(first.body, NodePut)
    worker = MergeWorker(LiveSchedule(), 1.0)
    nodes = [replace(first.body.node, stamp_ns=k) for k in range(50)]
    for k, one in enumerate(nodes):
        worker.take(Change(first.map, k + 1, 0, NodePut(one)))
    worker.start()
    assert worker.settle(30) and worker.settled
    assert worker.answers.merged.maps[first.map].nodes[first.body.node.id] is nodes[-1]
    assert worker._merger.counters.changes == 1
    worker.close()

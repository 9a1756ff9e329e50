"""Where maps are large all is decided again by a thread of its own; questions and changes go on meanwhile."""

from __future__ import annotations

import logging
import threading

import numpy as np
import pytest

from hybridmap.change import Change, EdgePut, NodePut
from hybridmap.node import MapId
from hybridmap.pose import Pose2
from mapserver.schedule import LiveSchedule
from mapserver.upkeep import Upkeep
from merge.incremental.again import Again
from merge.incremental.settings import StepSettings
from synthetic.world import room, take_map
from tests.waiting import eventually


@pytest.mark.parametrize("broken", [False, True])
def test_answers_go_on_while_all_is_decided_again(
    broken: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    always = StepSettings(anew_up_to=0, whole_up_to=0, whole_share=0.0)
    monkeypatch.setattr("merge.incremental.islands.StepSettings", lambda: always)
    entered, go = threading.Event(), threading.Event()
    real = Again.run

    def held(again: Again) -> None:
        entered.set()
        assert go.wait(60)
        if broken:
            raise RuntimeError("no room")
        real(again)

    monkeypatch.setattr(Again, "run", held)
    rng = np.random.default_rng(2)
    world = room(0, 0, 5, 4, 600, rng)
    logs = []
    for agent in ("a", "b"):
        map_id = MapId(agent, 1)
        nodes, edges = take_map(world, map_id, [Pose2(2.2 + 0.1 * k, 1.8, 0.5 * k) for k in range(9)], rng)
        steps = zip(nodes, [None, *edges], strict=True)
        bodies = [body for n, e in steps for body in (NodePut(n), EdgePut(e) if e else None) if body]
        logs.append([Change(map_id, k, 0, body) for k, body in enumerate(bodies, 1)])
    upkeep = Upkeep(LiveSchedule(), 1.0)
    upkeep.start()
    try:
        with caplog.at_level(logging.INFO):
            for change in logs[0] + logs[1][:-6]:
                upkeep.take(change)
            eventually(lambda: len(upkeep.answers.merged.postures) == 15)
            upkeep.take(logs[1][-6])
            eventually(entered.is_set)
            for change in logs[1][-5:]:
                upkeep.take(change)
            eventually(lambda: len(upkeep.answers.merged.postures) == 18)
            before = upkeep.answers.merged
            go.set()
            if broken:
                eventually(lambda: "could not be decided again" in caplog.text)
                assert upkeep.settle(30)
            else:
                eventually(lambda: upkeep.answers.merged is not before)
        after = upkeep.answers.merged
        assert len(after.postures) == 18 and len(after.components) == 1
        assert [link.pair for link in after.links] == [link.pair for link in before.links]
    finally:
        go.set()
        upkeep.close()

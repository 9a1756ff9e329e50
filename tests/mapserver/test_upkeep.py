"""Settled means merged: not when a change is taken from the queue, nor while the merge is being made."""

from __future__ import annotations

import threading
import time

import pytest

from hybridmap.node import MapId
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

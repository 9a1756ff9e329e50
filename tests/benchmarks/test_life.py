"""The benchmark of a map's life: a short one as a whole, and its ratios by hand."""

import json
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from benchmarks.life import benchmark
from benchmarks.life.benchmark import FIFTIETH, SOME, MapAfterDrive, change_of, in_the_long_run, run
from tests.programs import python

DRIVE = MapAfterDrive(20, 5, 3, 1, 5.0, 0.1, 200_000_000, 1_000_000, 100_000)


def test_the_last_drives_are_compared_with_those_about_the_fiftieth():
    drives = FIFTIETH + 2 * SOME
    about = range(FIFTIETH - 1 - SOME // 2, FIFTIETH + SOME // 2)
    last = range(drives - SOME, drives)
    curve = [DRIVE] * drives
    for k in about:
        curve[k] = replace(DRIVE, store=2_000_000)
    for k in last:
        curve[k] = replace(DRIVE, memory=240_000_000, merge_s=0.2, store=3_000_000, journal=50_000)
    assert in_the_long_run(curve) == {
        "memory_ratio": 1.2, "merge_ratio": 2.0, "store_ratio": 1.5, "journal_ratio": 0.5,
    }  # fmt: skip
    assert in_the_long_run(curve[:-1]) == {}, "too few drives to say anything"


def test_a_change_of_recall_has_the_interval_of_paired_views():
    before, after = np.zeros(200, np.bool_), np.zeros(200, np.bool_)
    before[:180] = after[6:183] = True
    # Six views are answered no longer, three that were not are now.
    change, least, most = change_of(before, after)
    assert change == -0.015
    assert least < change < most and least + most == pytest.approx(2 * -3 / 202, abs=1e-4)
    # The half width by hand: 1.96 sqrt((10 - 9 / 202) / 202 ** 2).
    assert most - least == pytest.approx(2 * 1.96 * (10 - 9 / 202) ** 0.5 / 202, abs=2e-4)
    # Views that are answered alike say nothing of a change, however many are answered.
    assert change_of(before, before)[0] == 0.0 and change_of(before, before)[2] < 0.01
    # The same counts of other views would be far less sure.
    unpaired = np.roll(before, 100)
    assert change_of(before, unpaired)[2] > 2 * most


@pytest.mark.slow
def test_the_map_after_some_drives_is_asked_as_it_was_then(monkeypatch):
    """Pruned, too: nodes that have left need no node to supersede them."""
    monkeypatch.setattr(benchmark, "EARLY", (1, 5))
    figures, drives = run(6, 65, 1, 0.0, 4, 4.0, Console(quiet=True))
    assert drives[4].pruned > 0
    assert figures["nodes_after_5"] == drives[4].nodes
    assert len(figures["recall_change_interval"]) == 2


@pytest.mark.slow
def test_a_short_life():
    arguments = "--drives 3 --stops 1 --queries 20 --seed 4 --json"
    ran = python("-m", "benchmarks.life", *arguments.split(), timeout=300)
    assert ran.returncode == 0, ran.stderr[-2000:]
    figures = json.loads(ran.stdout)
    for name in ("curve", "node_ms", "merge_s", "memory_mb", "store_mb", "journal_mb"):
        assert len(figures[name]) == figures["drives"] == 3, name
    # Some nodes are superseded by later ones, so fewer are active than there are.
    assert 0 < figures["nodes_first"] <= figures["nodes_after"] < figures["nodes_in_all"]
    assert figures["components"] == 1 and figures["routes_found"] == 1.0
    assert figures["store_mb"] == sorted(figures["store_mb"]) and figures["store_mb"][0] > 0
    for name in ("after_1", "after", "all_nodes"):
        assert figures[f"wrong_{name}"] == figures[f"wrong_visited_{name}"] == 0.0
        assert 0.0 < figures[f"recall_{name}"] <= 1.0
    assert "recall_change" not in figures, "there is none of a map after ten drives"
    # More of the rooms is known after three drives than after one.
    assert figures["recall_visited_after"] > figures["recall_visited_after_1"]

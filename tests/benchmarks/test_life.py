"""The benchmark of a map's life: a short one as a whole, and its ratios by hand."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace

import pytest

from benchmarks.life.benchmark import FIFTIETH, SOME, MapAfterDrive, in_the_long_run

DRIVE = MapAfterDrive(20, 5, 3, 1, 5.0, 0.1, 200_000_000, 1_000_000, 100_000)


def test_the_last_drives_are_compared_with_those_about_the_fiftieth() -> None:
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


@pytest.mark.slow
def test_a_short_life() -> None:
    arguments = "--drives 3 --stops 1 --queries 20 --seed 4 --json"
    ran = subprocess.run(
        [sys.executable, "-m", "benchmarks.life", *arguments.split()],
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip
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
    # More of the rooms is known after three drives than after one.
    assert figures["recall_visited_after"] > figures["recall_visited_after_1"]

"""Merging in the simulator: wrong joins are counted, and failing runs are reported."""

import json
import signal
import sys
from dataclasses import asdict

import numpy as np
import pytest
from rich.console import Console

from benchmarks.merge_sim import benchmark as merge_sim
from benchmarks.merge_sim.benchmark import Failure, figures, measure, outcome, summary
from benchmarks.merge_sim.run import MergeRun, false_merges
from mapweave import NodeId, Pose2

RUN = MergeRun("office", 3, 60, 3, 1, 0.02, 9, 0, 0, 0.7, 150.0, 90.0)


def test_maps_that_are_joined_wrongly_are_counted():
    rng = np.random.default_rng(2)
    truth = {
        NodeId(agent, 1, k): Pose2.from_vector(rng.uniform([0, 0, -3], [9, 9, 3]))
        for agent in "abc"
        for k in range(6)
    }
    merged_from_world = Pose2(3.0, -2.0, 1.0)
    right = {node: (0, merged_from_world @ pose) for node, pose in truth.items()}
    assert false_merges(right, truth) == 0
    shift = Pose2(1.8, 0.0, 0.0)
    moved = {n: (0, merged_from_world @ (shift @ truth[n] if n.agent == "c" else truth[n])) for n in truth}
    assert false_merges(moved, truth) == 2
    apart = {n: (int(n.agent == "c"), pose) for n, (_, pose) in moved.items()}
    assert false_merges(apart, truth) == 0
    near = Pose2(0.3, 0.0, 0.0)
    close = {n: (0, merged_from_world @ (near @ truth[n] if n.agent == "c" else truth[n])) for n in truth}
    assert false_merges(close, truth) == 0


def test_a_failed_or_killed_run_is_reported():
    text = json.dumps(asdict(RUN))
    assert outcome("office", 3, 0, f"noise\n{text}\n", "") == RUN
    for status, out, words, reason in (
        (-signal.SIGKILL, "", "", "killed by signal 9"),
        (1, "", "a warning\noffice, seed 3: no room\n", "no room"),
        (1, "", "", "status 1"),
        (0, "", "", "nothing that can be read"),
        (0, '{"scenario": "office"}', "", "nothing that can be read"),
    ):
        failure = outcome("office", 3, status, out, words)
        assert isinstance(failure, Failure) and reason in failure.reason
    values = summary(7, ["office", "warehouse"], [RUN, Failure("warehouse", 7000, "was killed by signal 9")])
    assert values["runs"] == {"office": 1, "warehouse": 0}
    assert values["merged_ate_m_median"] == {"office": 0.02, "warehouse": None}
    assert values["false_merges"] == {"office": 0, "warehouse": None}
    assert values["link_recall"] == {"office": 0.7, "warehouse": None}
    assert [item["reason"] for item in values["failed"]] == ["was killed by signal 9"]
    json.dumps(values, allow_nan=False)


@pytest.mark.slow
def test_runs_are_processes_and_all_are_accounted_for(monkeypatch):
    """A scenario that cannot be built beside one that there is not: each is one line, nothing hangs."""
    wrong = {"none": ("no-such-scenario",), "small": ("twin-rooms", "--set", "world.length=0.1")}
    monkeypatch.setattr(merge_sim, "SCENARIOS", wrong)
    results = measure(["none", "small"], 1, 0, 2, Console(file=sys.stderr, quiet=True))
    assert [type(result) for result in results] == [Failure, Failure]
    assert isinstance(results[0], Failure) and "no scenario 'no-such-scenario'" in results[0].reason
    assert isinstance(results[1], Failure) and "twins: length must be a number, 2.5 to" in results[1].reason


def test_median_and_sums_over_runs():
    other = MergeRun("office", 4, 60, 3, 2, 0.04, 5, 1, 1, None, 150.0, 80.0)
    values = figures([RUN, other])
    assert values["merged_ate_m_median"] == pytest.approx(0.03)
    assert values["components"] == 1.5 and values["whole"] == 0.5
    assert values["false_merges"] == 1 and values["false_links"] == 1
    assert values["link_recall"] == 0.7

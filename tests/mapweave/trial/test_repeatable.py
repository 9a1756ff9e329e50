"""The same scenario and seed give the same maps and the same drive, to the last bit: whatever the machine's
load, and whether the robots live in one process or in many.
"""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from mapweave.trial.run import TrialOptions, run_trial
from mapweave.trial.scenario import load_scenario

# Maps, merges, a question to the server and a drive by its answer: every way in which chance could enter.
SCENARIO = """
name = "repeat"
robots = 2
[world]
kind = "office"
rooms = 3
[[events]]
at = 8.0
do = "walk"
near = "r1"
seconds = 4.0
[[events]]
at = 24.0
do = "mission"
mission = "idle"
robot = "r0"
[[events]]
do = "goto"
robot = "r0"
goal = "r0.1.1"
[[events]]
plus = 8.0
do = "wait"
[expect]
maps = 2
unsaved_changes = 0
false_edges = 0
"""

# Busy now and then, for up to 40 ms: that stirs the order of things more than a steady load does.
BUSY = """
import random, time
end = time.monotonic() + 60
while time.monotonic() < end:
    until = time.monotonic() + random.uniform(0.0, 0.04)
    while time.monotonic() < until:
        sum(range(1000))
    time.sleep(random.uniform(0.0, 0.08))
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("repeat")
    path = folder / "repeat.toml"
    path.write_text(SCENARIO)
    scenario = load_scenario(path)

    def run(name, processes):
        options = TrialOptions(seed=7, out=folder / name, processes=processes, film_every=0.0, quiet=True)
        return run_trial(scenario, options)

    return run


@pytest.fixture(scope="module")
def first(run):
    return run("first", processes=False)


def same(one, other):
    """Maps, true drives, what the lost robot found out, and every figure that knows no wall clock."""
    assert one.figures.map_hash == other.figures.map_hash
    for robot, record in one.recording.robots.items():
        assert np.array_equal(record.truth.poses, other.recording.robots[robot].truth.poses)
    assert one.recording.lost == other.recording.lost
    assert one.recording.merged.postures.keys() == other.recording.merged.postures.keys()
    for name in ("nodes", "edges", "links", "merged_ate_m", "bytes_per_node", "found", "found_error_m"):
        assert getattr(one.figures, name) == getattr(other.figures, name), name


@pytest.mark.timeout(400)
def test_again_on_a_busy_machine(first, run):
    busy = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(2 * (os.cpu_count() or 2))]
    try:
        second = run("busy", processes=False)
    finally:
        for process in busy:
            process.kill()
            process.wait()
    same(first, second)
    # It was a real trial.
    assert first.figures.nodes >= 8
    assert first.recording.lost[0].goal is not None
    assert first.passed


@pytest.mark.timeout(400)
def test_in_processes(first, run):
    same(first, run("processes", processes=True))

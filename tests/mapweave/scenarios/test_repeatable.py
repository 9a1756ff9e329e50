"""The same scenario and seed give the same maps and the same drive, to the last bit: under any load of the
machine, with the robots in one process or in many.
"""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from mapweave.scenarios.run import TrialOptions, run_trial
from mapweave.scenarios.scenario import load_scenario

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
at = 18.0
do = "mission"
mission = "idle"
robot = "r0"
[[events]]
do = "goto"
robot = "r0"
goal = "r0.1.1"
[[events]]
plus = 5.0
do = "wait"
[expect]
maps = 2
unsaved_changes = 0
false_edges = 0
"""

# Busy now and then, for up to 40 ms: that stirs the order of things more than a steady load does.
BUSY = """
import random, time
end = time.monotonic() + 300
while time.monotonic() < end:
    until = time.monotonic() + random.uniform(0.0, 0.04)
    while time.monotonic() < until:
        sum(range(1000))
    time.sleep(random.uniform(0.0, 0.2))
"""


@contextmanager
def busy() -> Iterator[None]:
    """A machine on which other processes come and go."""
    processes = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(os.cpu_count() or 2)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def same(first, second):
    """Maps, true drives, what the lost robot found out, and every figure that knows no wall clock."""
    assert first.figures.map_hash == second.figures.map_hash
    for robot, record in first.recording.robots.items():
        assert np.array_equal(record.truth.poses, second.recording.robots[robot].truth.poses)
    assert first.recording.lost == second.recording.lost
    assert first.recording.merged.poses.keys() == second.recording.merged.poses.keys()
    for name in ("nodes", "edges", "links", "merged_ate_m", "bytes_per_node", "found", "found_error_m"):
        assert getattr(first.figures, name) == getattr(second.figures, name), name


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_in_one_process_and_in_many_on_a_busy_machine(tmp_path):
    """Neither the order in which threads and processes run nor where they run changes anything."""
    path = tmp_path / "repeat.toml"
    path.write_text(SCENARIO)
    scenario = load_scenario(path)

    def trial(name, processes):
        options = TrialOptions(seed=7, out=tmp_path / name, processes=processes, film_every=0.0, quiet=True)
        return run_trial(scenario, options)

    with busy():
        one, many = trial("one", processes=False), trial("many", processes=True)
    same(one, many)
    # It was a real trial.
    assert one.figures.nodes >= 8
    assert one.recording.lost[0].goal is not None
    assert one.passed

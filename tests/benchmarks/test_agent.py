"""The agent's benchmark measures a process that lacks what the base installation lacks."""

import json

import pytest

from tests.programs import python

pytest.importorskip("pybullet")


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_its_last_line_is_one_object():
    arguments = "--seconds 10 --seed 3 --json"
    done = python("-m", "benchmarks.agent", *arguments.split(), check=True, timeout=None)
    values = json.loads(done.stdout.strip().splitlines()[-1])
    assert values["ticks"] == 100 and values["nodes"] >= 1
    assert 0.0 < values["tick_ms_p50"] < values["tick_ms_p99"] < 1000.0
    assert values["with_numba"]["rss_mb"] > values["rss_mb"] + 50.0, "only one of the processes has numba"
    assert 40.0 < values["wheel_mb"] < 300.0

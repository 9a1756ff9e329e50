"""The simulator's benchmark gives the figures that others compare."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_its_last_line_is_one_object():
    command = [sys.executable, "-m", "benchmarks.sim", "--robots", "1", "2", "--seconds", "2", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    values = json.loads(done.stdout.strip().splitlines()[-1])
    assert set(values["real_time_factor"]) == set(values["share"]) == {"1", "2"}
    for name in ("real_time_factor", "real_time_factor_one_process"):
        assert all(factor > 0 for factor in values[name].values())
    for parts in values["share"].values():
        assert {"render", "physics", "features", "filter", "bus"} < set(parts)
        assert sum(parts.values()) == pytest.approx(1.0, abs=0.01)
        assert parts["render"] > 0.02
        assert parts["filter"] > 0.0
    assert 0 < values["renderer"]["ours_ms"] < values["renderer"]["bare_getCameraImage_ms"]

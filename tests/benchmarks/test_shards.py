"""The benchmark of shards: its figures by hand, and a small run with a real cluster and a killed shard."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys

import pytest

from benchmarks.shards.askers import IN_A_ROW, Tally


def test_recovery_by_hand() -> None:
    times = [1.0, 2.0, 2.1, 4.5, *(4.6 + 0.1 * k for k in range(IN_A_ROW))]
    tally = Tally([(at, at not in (2.0, 2.1)) for at in times])
    assert tally.recovery(1.5) == pytest.approx(3.0)
    assert tally.whole(4.55) and not tally.whole(5.0)


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs the extra cluster: Ray")
def test_a_small_run() -> None:
    arguments = "--shards 2 --robots 4 --nodes 12 --seconds 1 --ray-nodes 2 --kills shard --seed 1 --json"
    run = subprocess.run(
        [sys.executable, "-m", "benchmarks.shards", *arguments.split()],
        capture_output=True, text=True, timeout=220,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr[-3000:]
    figures = json.loads(run.stdout)
    assert figures["same_links"] and figures["max_pose_difference_m"] <= 0.001
    assert (figures["lost"], figures["wrong"]) == (0, 0)
    assert figures["sizes"]["2 shards"]["links"] > 20 and figures["sizes"]["2 shards"]["found"] > 10
    assert figures["sizes"]["killed"]["recovery_s"]["shard"] < 60.0

"""The load benchmark: its figures by hand, and a small run of the real thing."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.relocalize_load import benchmark as relocalize_load
from benchmarks.relocalize_load.benchmark import Building, Tally, figures, is_right
from mapweave.hybridmap.node import NodeId
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import Certainty, RelocalizeAnswer, Whereabouts
from mapweave.wire.messages import encode


def test_figures_by_hand() -> None:
    total, other = Tally([0.1, 0.2], [0.1, 2.0], refused=3, right=1), Tally([0.3], [0.3], right=1, lost=1)
    total.add(other)
    result = figures(total, [0.01, 0.03], took=1.5)
    assert (result["answered"], result["answers_per_s"], result["lost"]) == (3, 2.0, 1)
    assert (result["p50_ms"], result["max_ms"]) == (200.0, 300.0)
    assert result["refused_share"] == pytest.approx(3 / 7, abs=1e-3)
    assert result["right_share"] == pytest.approx(2 / 3, abs=1e-3)
    assert result["wait_p95_ms"] > 1000.0
    assert math.isnan(figures(Tally(), [], 1.0)["p95_ms"])


def test_an_answer_is_right_where_it_was_taken(tmp_path: Path) -> None:
    building = Building.make(20, tmp_path / "s0.sqlite", np.random.default_rng(1))
    assert len(building.truth) == 20
    query = building.query(np.random.default_rng(2))
    node = NodeId(*query[1], 1)

    def answer(off: Pose2) -> bytes:
        result = building.truth[node].inverse() @ (query[2] @ off)
        place = Whereabouts(node, PoseGaussian.from_sigmas(result, 0.1, 0.1), None, 0, 20, 0.9)
        return encode(RelocalizeAnswer(Certainty.FOUND, (place,), ""))

    assert is_right(building, query, answer(Pose2()))
    assert is_right(building, query, answer(Pose2(0.2, 0.0, 0.05)))
    assert not is_right(building, query, answer(Pose2(0.3, 0.0, 0.0)))
    assert not is_right(building, query, answer(Pose2(0.0, 0.0, 0.1)))
    nothing = encode(RelocalizeAnswer(Certainty.UNKNOWN, (), ""))
    assert not is_right(building, query, nothing)


@pytest.mark.slow
def test_a_small_run(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    arguments = [
        "relocalize_load",
        "--robots",
        "2",
        "--seconds",
        "1",
        "--nodes",
        "20",
        "--seed",
        "5",
        "--json",
    ]
    monkeypatch.setattr(sys, "argv", arguments)
    relocalize_load.main()
    values = json.loads(capfd.readouterr().out.strip().splitlines()[-1])
    assert (values["robots"], values["nodes"], values["seed"]) == (2, 20, 5)
    for server in (values, values["in_turn"]):
        assert server["answered"] >= 2
        assert server["lost"] == 0
        assert server["right_share"] > 0.8
    assert values["in_turn"]["refused_share"] == 0.0
    with pytest.raises(SystemExit) as ended:
        monkeypatch.setattr(sys, "argv", ["relocalize_load", "--robots", "0"])
        relocalize_load.main()
    assert ended.value.code == 2

"""Four real robots at a real server that a fifth one floods."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.flood.benchmark import PARTS, ROBOTS, measure
from benchmarks.flood.fleet import NODES


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_honest_robots_are_acknowledged_and_answered_in_every_flood(tmp_path: Path) -> None:
    parts = measure(5.0, 300.0, 3, tmp_path)
    quiet = parts["quiet"]
    assert quiet["nodes"] == ROBOTS * NODES and quiet["acks"] > 0 < quiet["answers"]
    for part in PARTS:
        figures = parts[part]
        assert figures["lost"] == 0, (part, figures)
        assert figures["acks"] >= quiet["acks"] / 2 and figures["answers"] >= quiet["answers"] / 2, (
            part,
            figures,
        )
    assert parts["changes"]["nodes"] > quiet["nodes"], "what it sends within its quota is taken"

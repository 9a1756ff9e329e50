"""One robot of four lies, over the real server: the others keep what they have, and the page names it."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.liar.benchmark import drawn_trial
from mapweave.scenarios.liar.lies import WAYS

pytestmark = pytest.mark.slow


def test_lies_are_contained_and_named(tmp_path: Path) -> None:
    trial = drawn_trial(3, 6, tmp_path)
    beside = trial.beside
    assert not beside.named and not beside.links_changed and beside.answers_changed <= 1
    for name in ("edges of 1e5 m", "covariance of zero", "copied places", "half copied landmarks"):
        outcome = trial.outcome(WAYS[name])
        assert outcome.contained and outcome.named, (name, outcome)

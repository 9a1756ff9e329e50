"""Steps beside iSAM2: all end near the batch optimum, and all is told."""

import numpy as np
import pytest
from rich.console import Console
from rich.progress import Progress

from benchmarks.merge.steps import STEPS, Growth, stepping


@pytest.mark.parametrize("seed", [2, 3])
def test_all_end_near_the_optimum(seed: int) -> None:
    """With seed 3 a map begins that nothing ties to the others yet."""
    with Progress(console=Console(quiet=True)) as progress:
        found = stepping(400, seed, progress)
    assert set(found) == {"mapweave", "isam2", "isam2_exact"}
    for figures in found.values():
        assert 1.0 - 1e-6 < figures["cost_ratio"] < 1.01
        assert figures["ms_per_step_median"] > 0.0


def test_what_grows_is_all_there_in_the_end() -> None:
    growth = Growth.draw(400, 0)
    assert sum(len(growth.part(step)) for step in range(STEPS + 1)) == len(growth.factors)
    assert (np.bincount(growth.nodes)[1:] == 4).all()
    # The noise is what the weights say: chi-square at the truth is that of its degrees of freedom.
    per_freedom = 2.0 * growth.factors.cost(growth.start, np.inf) / (3 * len(growth.factors))
    assert 0.9 < per_freedom < 1.1

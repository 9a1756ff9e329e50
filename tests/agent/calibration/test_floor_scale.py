"""The floor among what stands on it: mixtures of which the truth is known."""

import numpy as np
import pytest

from mapweave.agent.calibration.floor_scale import FLOOR_FLAT, FLOOR_RANGE, floor_scale

PAIRS, POINTS, DRAWS = 60, 3000, 4


def error(floor: float, above: float) -> float:
    """Mean error of the scale over a few draws; all that is neither floor nor above it is below."""
    errors = []
    for seed in range(DRAWS):
        rng = np.random.default_rng(seed)
        kind = rng.choice(3, POINTS, p=[floor, above, 1.0 - floor - above])
        far, pairs = rng.uniform(2.0, 8.0, POINTS), np.sort(rng.integers(0, PAIRS, POINTS))
        off = np.choose(kind, [0.0, 1.0, -1.0]) * rng.uniform(0.0, 0.5 * FLOOR_RANGE, POINTS)
        logs = off + 0.003 * rng.normal(size=PAIRS)[pairs] * far + FLOOR_FLAT * rng.normal(size=POINTS)
        found = floor_scale(logs, np.full(POINTS, 0.001), far, pairs, 4)
        assert found is not None
        errors.append(found.log)
    return float(np.mean(errors))


def test_what_stands_in_the_lane_does_not_raise_the_floor():
    """Feet of walls: seven points of ten stand on the floor, none is below."""
    assert error(0.3, 0.7) == pytest.approx(0.0, abs=0.003)


@pytest.mark.parametrize(("floor", "above"), [(0.8, 0.1), (0.8, 0.0)], ids=["even", "below"])
def test_false_points_do_not_move_the_floor(floor: float, above: float):
    assert error(floor, above) == pytest.approx(0.0, abs=0.001)

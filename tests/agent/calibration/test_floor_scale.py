"""The floor among what stands on it: mixtures of which the truth is known."""

import numpy as np
import pytest

from mapweave.agent.calibration import estimator as estimator_module
from mapweave.agent.calibration.estimator import Estimator
from mapweave.agent.calibration.floor_scale import FLOOR_FLAT, FLOOR_RANGE, floor_scale
from mapweave.agent.calibration.image_pairs import sigma_of
from mapweave.agent.calibration.pair_information import FloorMatches
from mapweave.agent.drive_geometry import DriveGeometry
from tests.agent.calibration.room_drive import CAMERA, drive, pairs

PAIRS, POINTS, DRAWS = 60, 3000, 4


def error(floor: float, above: float, lane: bool) -> float:
    """Mean error of the scale over a few draws; all that is neither floor nor above it is below."""
    errors = []
    for seed in range(DRAWS):
        rng = np.random.default_rng(seed)
        kind = rng.choice(3, POINTS, p=[floor, above, 1.0 - floor - above])
        far, pairs = rng.uniform(2.0, 8.0, POINTS), np.sort(rng.integers(0, PAIRS, POINTS))
        off = np.choose(kind, [0.0, 1.0, -1.0]) * rng.uniform(0.0, 0.5 * FLOOR_RANGE, POINTS)
        logs = off + 0.003 * rng.normal(size=PAIRS)[pairs] * far + FLOOR_FLAT * rng.normal(size=POINTS)
        found = floor_scale(logs, np.full(POINTS, 0.001), far, pairs, 4, lane)
        assert found is not None
        errors.append(found.log)
    return float(np.mean(errors))


def test_what_stands_in_the_lane_does_not_raise_the_floor():
    """Feet of walls: seven points of ten stand on the floor, none is below."""
    assert error(0.3, 0.7, lane=True) == pytest.approx(0.0, abs=0.003)
    assert error(0.3, 0.7, lane=False) > 0.006


@pytest.mark.parametrize(("floor", "above"), [(0.8, 0.1), (0.8, 0.0)], ids=["even", "below"])
def test_false_points_do_not_move_the_floor(floor: float, above: float):
    assert error(floor, above, lane=True) == pytest.approx(0.0, abs=0.001)


def test_tiles_show_the_lane_and_corners_do_not(monkeypatch):
    seen = []
    monkeypatch.setattr(estimator_module, "floor_scale", lambda *given: seen.append(given[-1]))
    rng = np.random.default_rng(1)
    declared = DriveGeometry(forward=CAMERA.mount_forward, height=CAMERA.mount_height)
    run = drive(rng, declared, 4.0)
    estimator = Estimator(declared, sigma_of(CAMERA))
    for pair in pairs(rng, run):
        estimator.add(pair, run.wheels)
    estimator.find_floor()
    ahead = np.array([[0.0, 0.3]])
    estimator.add_floor(FloorMatches(ahead, 1.02 * ahead, np.array([0.001])))
    estimator.find_floor()
    assert seen == [False, True]

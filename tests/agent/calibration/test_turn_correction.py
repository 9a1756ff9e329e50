"""What pairs of images say of a turn corrects the mapping filter, as far as they know it better."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from mapweave.agent.calibration.camera_motions import rotations
from mapweave.agent.calibration.online import OnlineCalibration
from mapweave.agent.calibration.turn_correction import PairTurn, TurnCorrection
from mapweave.agent.drive_geometry import DriveGeometry
from mapweave.agent.observation import Observation, Odometry, RobotDescription
from mapweave.hybridmap.pose import Array
from tests.agent.calibration.room_drive import CAMERA, SIDE, camera_poses, drive, first_in_view

BLANK = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
SOURCE = object()
TRUE = DriveGeometry(forward=0.1, height=0.3)


def corrections(seed: int, sway: float, filtered: Callable[[Array, Array], Array]) -> Array:
    """(N,) rad, what is to be corrected at each image of a drive in a room.

    Args:
        seed: of the drive, its points and its pixels.
        sway: standard deviation of pitch and roll of the camera, in each image, rad.
        filtered: makes of (N,) stamps, s, and (N,) true headings, rad, those of a mapping filter.
    """
    rng = np.random.default_rng(seed)
    run = drive(rng, TRUE, 40.0, "eight")
    online = OnlineCalibration(RobotDescription(CAMERA, geometry=TRUE))
    half = 0.5 * np.array(SIDE)
    points = np.column_stack([rng.uniform(-half, half, (8000, 2)), rng.uniform(0.0, 1.5, 8000)])
    rotation, centre = camera_poses(run)
    swaying = rng.normal(0.0, sway, (len(run.stamps), 3)) * [1.0, 0.0, 1.0]
    rotation = rotation @ rotations(swaying)
    way, turn = (np.interp(run.stamps, run.wheels.stamps, c) for c in (run.wheels.way, run.wheels.turn))
    turned = filtered(run.stamps, np.unwrap(run.poses[:, 2]))
    out = []
    for k, stamp in enumerate(run.stamps):
        wheels = Odometry(float(way[k] - way[max(k - 1, 0)]), float(turn[k] - turn[max(k - 1, 0)]))
        online.correct(Observation(round(stamp * 1e9) + 1, wheels))
        ids, pixels = first_in_view(points, rotation[k], centre[k])
        seen = pixels + rng.normal(0.0, 0.3, (len(ids), 2))
        online.watch(BLANK, SOURCE, ids, seen, float(turned[k]))
        out.append(online.take_turn())
    return np.array(out)


@pytest.mark.parametrize("sway", [0.0, math.radians(0.3)])
def test_a_filter_that_drifts_is_corrected(sway: float):
    """By 12 degrees in 40 s, whether the camera sways or not."""
    drift = math.radians(0.3)
    corrected = corrections(3, sway, lambda stamps, heading: heading + drift * (stamps - stamps[0]))
    assert math.degrees(corrected.sum()) == pytest.approx(-12.0, abs=2.0)


def test_a_filter_that_is_right_is_left_nearly_alone():
    """It knows more than any pair, so what the pairs err by is hardly taken over."""
    corrected = corrections(4, 0.0, lambda stamps, heading: heading)
    assert np.degrees(np.abs(corrected.cumsum()).max()) < 1.0


@pytest.mark.parametrize(("by_pair", "by_filter"), [(1e-4, 2e-3), (6e-4, 2e-4), (1e-3, 1e-3)])
def test_turns_are_weighed_by_their_variances(by_pair: float, by_filter: float):
    """The error that is left is that of the mean weighted by the true variances, and little more."""
    rng = np.random.default_rng(8)
    correction, left = TurnCorrection(), []
    for _ in range(4000):
        true = rng.uniform(-0.3, 0.3)
        pair, filtered = true + rng.normal(0.0, [by_pair, by_filter])
        correction.add(PairTurn(pair, by_pair**2), filtered)
        left.append(filtered + correction.take() - true)
    best = 1.0 / math.hypot(1.0 / by_pair, 1.0 / by_filter)
    assert 0.95 * best < np.std(left[500:]) < 1.15 * best


def test_a_pair_that_is_far_off_turns_nothing_by_much():
    """Tracks on what moves show a turn of 10 degrees, and are sure of it."""
    correction = TurnCorrection()
    correction.add(PairTurn(math.radians(10.0), 1e-8), 0.0)
    assert 0.0 < math.degrees(correction.take()) < 0.21


def test_whole_turns_do_not_count():
    correction = TurnCorrection()
    correction.add(PairTurn(0.2, 1e-12), 0.199 - math.tau)
    assert correction.take() == pytest.approx(0.001, rel=1e-3)
    assert correction.take() == 0.0

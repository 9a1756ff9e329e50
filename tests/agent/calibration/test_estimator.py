"""The estimator on drives with known geometry, and against a second implementation."""

import math

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mapweave.agent.calibration.camera_motions import WheelTrack
from mapweave.agent.calibration.estimate import Estimate
from mapweave.agent.calibration.estimator import Estimator, _few_blocks, _few_pulls
from mapweave.agent.calibration.image_pairs import sigma_of
from mapweave.agent.calibration.pair_information import ImagePair
from mapweave.agent.calibration.report import causes
from mapweave.agent.drive_geometry import DriveGeometry, Parameter
from tests.agent.calibration.room_drive import CAMERA, RoomDrive, drive, pairs
from tests.quick import first_quick

P = Parameter
DECLARED = DriveGeometry(forward=0.08, height=0.25)


def draw(seed: int) -> DriveGeometry:
    """A geometry near what is declared."""
    rng = np.random.default_rng([seed, 7])
    return DriveGeometry(
        math.exp(rng.uniform(-0.06, 0.06)), math.exp(rng.uniform(-0.06, 0.06)), rng.uniform(-0.02, 0.02),
        0.08 + rng.uniform(-0.1, 0.3), 0.0, rng.uniform(-0.05, 0.05), rng.uniform(0.0, 0.1),
        rng.uniform(-0.02, 0.02), 0.25, rng.uniform(-0.06, 0.06),
    )  # fmt: skip


def estimated(run: RoomDrive, seed: int, floor: bool = True) -> Estimate:
    """What a drive shows of a robot that declares nothing."""
    found = pairs(np.random.default_rng([seed, 9]), run, floor=floor)
    return Estimator(DECLARED, sigma_of(CAMERA)).batch(found, run.wheels)


@pytest.fixture(scope="module")
def trials() -> list[tuple[DriveGeometry, Estimate]]:
    """Drives of 30 s with all parameters wrong at once."""
    results = []
    for seed in range(5):
        true = draw(seed)
        run = drive(np.random.default_rng(seed), true, 30.0)
        results.append((true, estimated(run, seed)))
    return results


@pytest.mark.slow
def test_all_that_is_shown_is_right(trials: list[tuple[DriveGeometry, Estimate]]):
    """Within what a map needs, from declarations wrong in every parameter."""
    bounds = {
        P.WHEEL_SCALE: 0.04, P.TURN_SCALE: 0.03, P.DRIFT: 0.01, P.FORWARD: 0.06, P.HEADING: 0.015,
        P.PITCH: 0.01, P.ROLL: 0.005, P.DELAY: 0.012,
    }  # fmt: skip
    for true, estimate in trials:
        off = np.abs(estimate.vector - true.vector)
        for p, bound in bounds.items():
            if estimate.shown[p]:
                assert off[p] < bound, (p, estimate.vector[p], true.vector[p])
        # A curved drive shows these.
        assert estimate.shown[[P.TURN_SCALE, P.FORWARD, P.PITCH, P.DELAY]].all()


@pytest.mark.slow
def test_sigmas_cover_the_errors(trials: list[tuple[DriveGeometry, Estimate]]):
    """Most errors of what is shown are within two sigmas, nearly none beyond four."""
    z = np.concatenate([np.abs((e.vector - true.vector) / e.sigmas)[e.shown] for true, e in trials])
    assert np.mean(z < 2.0) > 0.85
    assert np.mean(z < 4.0) > 0.97


def test_a_delay_is_known_better_than_readings_are_apart():
    """Wheels are read every 0.1 s; what happens between two readings hides no delay from many turns."""
    true = DriveGeometry(forward=0.1, height=0.25, delay=0.05)
    estimate = estimated(drive(np.random.default_rng(3), true, 30.0), 3)
    off, sigma = abs(estimate.vector[P.DELAY] - true.delay), estimate.sigmas[P.DELAY]
    assert off < 3.0 * sigma < 0.02


def test_a_straight_drive_shows_no_lever():
    """Only turns tell how far ahead a camera stands; the heading shows all the same."""
    true = DriveGeometry(forward=0.3, heading=0.04, height=0.25)
    estimate = estimated(drive(np.random.default_rng(1), true, 30.0, "straight"), 1)
    assert not estimate.shown[[P.FORWARD, P.LEFT, P.TURN_SCALE]].any()
    assert estimate.usable.forward == DECLARED.forward
    assert estimate.shown[P.HEADING]
    assert abs(estimate.vector[P.HEADING] - 0.04) < 3.0 * estimate.sigmas[P.HEADING]


def test_without_floor_no_scale_is_shown():
    true = DriveGeometry(wheel_scale=1.08, forward=0.08, height=0.25)
    estimate = estimated(drive(np.random.default_rng(2), true, 30.0), 2, floor=False)
    assert not estimate.shown[P.WHEEL_SCALE]
    assert estimate.usable.wheel_scale == pytest.approx(1.0)


@pytest.mark.slow
def test_a_right_geometry_has_no_causes():
    for seed in range(3):
        run = drive(np.random.default_rng(seed), DECLARED, 30.0)
        assert not causes(estimated(run, seed)), seed


@pytest.mark.parametrize(
    ("parameter", "amount"),
    first_quick([(P.PITCH, math.radians(3)), (P.FORWARD, 0.4), (P.DELAY, 0.06)], 1),
)
def test_the_surest_cause_is_the_true_one(parameter: Parameter, amount: float):
    vector = DECLARED.vector
    vector[parameter] += amount
    run = drive(np.random.default_rng(3), DriveGeometry.of(vector), 30.0)
    named = causes(estimated(run, 3))
    assert named
    assert named[0].parameter is parameter
    assert "mapweave calibrate drive" in str(named[0])


@pytest.mark.slow
def test_the_mode_of_a_second_implementation():
    """Bundle adjustment by scipy over mount angles and lever, with one inverse depth a track."""
    true = DriveGeometry(forward=0.25, heading=0.03, pitch=0.05, height=0.25)
    rng = np.random.default_rng(4)
    run = drive(rng, true, 12.0, wheel_noise=1e-4)
    found = pairs(rng, run, pixel_sigma=0.1, outliers=0.0, tracks=40)
    estimate = Estimator(DECLARED, sigma_of(CAMERA, 0.1)).batch(found, run.wheels)
    best = _bundle(found, run.wheels)
    for p, value in zip((P.FORWARD, P.HEADING, P.PITCH), best, strict=True):
        assert value == pytest.approx(true.vector[p], abs=0.02)
        assert estimate.vector[p] == pytest.approx(value, abs=0.02)


def _bundle(found: list[ImagePair], wheels: WheelTrack) -> list[float]:
    """Lever, heading and pitch; rotations by scipy, poses by integrating the wheels in fine steps."""
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    moves = []
    for pair in found:
        t = np.linspace(pair.first_s, pair.last_s, 200)
        way, turn = np.interp(t, wheels.stamps, wheels.way), np.interp(t, wheels.stamps, wheels.turn)
        heading = turn - turn[0]
        middle = 0.5 * (heading[1:] + heading[:-1])
        moves.append(
            ((np.diff(way) * np.cos(middle)).sum(), (np.diff(way) * np.sin(middle)).sum(), heading[-1])
        )

    def residuals(v: np.ndarray) -> np.ndarray:
        mount = Rotation.from_euler("ZYX", [v[1], v[2], 0.0]).as_matrix() @ level
        rest, at = [], 3
        for pair, (x, y, turned) in zip(found, moves, strict=True):
            n = len(pair.before)
            depth = np.exp(v[at : at + n])[:, None]
            at += n
            points = (np.column_stack([pair.before, np.ones(n)]) * depth) @ mount.T + [v[0], 0.0, 0.0]
            back = Rotation.from_euler("Z", turned).as_matrix()
            there = ((points - [x, y, 0.0]) @ back - [v[0], 0.0, 0.0]) @ mount
            rest.append((there[:, :2] / np.maximum(there[:, 2:], 0.05) - pair.after).ravel())
        return np.concatenate(rest) * CAMERA.fx

    count = sum(len(pair.before) for pair in found)
    start = np.concatenate([[0.08, 0.0, 0.0], np.full(count, math.log(4.0))])
    pattern = np.zeros((2 * count, 3 + count), bool)
    pattern[:, :3] = True
    pattern[np.arange(2 * count), 3 + np.arange(2 * count) // 2] = True
    solved = least_squares(residuals, start, jac_sparsity=pattern, loss="soft_l1", max_nfev=60)
    return [float(v) for v in solved.x[:3]]


def test_where_few_blocks_show_a_parameter_two_sigmas_still_cover_the_errors():
    """Of a car in curves that slip as they like: a lever that two blocks of 13 show had too small a sigma."""
    rng = np.random.default_rng(5)
    shown = np.where(np.arange(13) < 2, 3.0, 0.3)
    covered, before = [], []
    for _ in range(2000):
        errors = rng.normal(size=13)
        off = (shown * errors).sum() / (shown**2).sum()
        pulls = shown * (errors - shown * off) / (shown**2).sum()
        sigma = _few_blocks(13) * math.sqrt((pulls**2).sum())
        before.append(abs(off) < 2.0 * sigma)
        covered.append(abs(off) < 2.0 * _few_pulls(pulls) * sigma)
    assert np.mean(before) < 0.8 and np.mean(covered) > 0.88


def test_blocks_that_all_show_a_parameter_or_of_which_none_does_keep_its_sigma():
    signs = np.where(np.arange(12) % 2, 1.0, -1.0)
    assert _few_pulls(signs) == pytest.approx(1.0)
    assert _few_pulls(0.0 * signs) == 1.0
    assert _few_pulls(np.eye(12)[3]) > 2.0


def test_a_short_drive_says_the_lever_less_surely_than_its_blocks_alone():
    """Only that: of simulated drives all other sigmas cover the errors as they are."""
    run = drive(np.random.default_rng(3), draw(3), 15.0, "turning")
    found = pairs(np.random.default_rng([3, 9]), run)
    estimator = Estimator(DECLARED, sigma_of(CAMERA))
    wide = estimator.batch(found, run.wheels).sigmas
    narrow = estimator.solve(run.wheels).sigmas
    assert wide[P.FORWARD] > 1.05 * narrow[P.FORWARD]
    np.testing.assert_allclose(np.delete(wide, P.FORWARD), np.delete(narrow, P.FORWARD), rtol=0.05)

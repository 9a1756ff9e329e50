"""Calibration while mapping, on tracks that are drawn."""

import math
import tracemalloc
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from mapweave.agent.calibration.correction import declaring
from mapweave.agent.calibration.estimate import Estimate, Lengths
from mapweave.agent.calibration.estimator import Estimator
from mapweave.agent.calibration.online import NAMED_ONLY, OnlineCalibration, _common
from mapweave.agent.calibration.report import Cause, causes
from mapweave.agent.drive_geometry import COUNT, DriveGeometry, Parameter
from mapweave.agent.observation import Observation, Odometry, RobotDescription
from tests.agent.calibration.room_drive import (
    CAMERA,
    SIDE,
    RoomDrive,
    camera_poses,
    drive,
    first_in_view,
)
from tests.quick import first_quick

BLANK = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
SOURCE = object()


def watched(
    run: RoomDrive,
    declared: DriveGeometry,
    seed: int,
    sigma: float = 0.3,
    online: OnlineCalibration | None = None,
    ranged: float = 0.0,
) -> OnlineCalibration:
    """What the agent has found out at the end of a drive past points in the room and on its floor.

    With `ranged`, a sensor ahead reads so many times the distance to the wall.
    """
    rng = np.random.default_rng(seed)
    camera = replace(CAMERA, mount_forward=declared.forward, mount_height=declared.height)
    reach = {"ranger_bearings": (0.0,), "ranger_reach": 20.0} if ranged else {}
    online = online or OnlineCalibration(RobotDescription(camera, geometry=declared, **reach))  # type: ignore[arg-type]
    half = 0.5 * np.array(SIDE)
    points = np.column_stack([rng.uniform(-half, half, (8000, 2)), rng.uniform(0.0, 1.5, 8000)])
    points[::2, 2] = 0.0
    rotation, centre = camera_poses(run)
    way, turn = (np.interp(run.stamps, run.wheels.stamps, c) for c in (run.wheels.way, run.wheels.turn))
    for k, stamp in enumerate(run.stamps):
        wheels = Odometry(float(way[k] - way[max(k - 1, 0)]), float(turn[k] - turn[max(k - 1, 0)]))
        proximity = np.zeros(0)
        if ranged:
            x, y, heading = run.poses[k]
            ahead = np.array([math.cos(heading), math.sin(heading)])
            walls = (half - np.sign(ahead) * [x, y]) / np.maximum(np.abs(ahead), 1e-9)
            proximity = ranged * walls.min(keepdims=True) * (1.0 + 0.005 * rng.normal())
        online.correct(Observation(round(stamp * 1e9) + 1, wheels, proximity=proximity))
        ids, pixels = first_in_view(points, rotation[k], centre[k])
        online.watch(BLANK, SOURCE, ids, pixels + rng.normal(0.0, sigma, (len(ids), 2)))
        online.switched()
    return online


TRUE = DriveGeometry(forward=0.1, height=0.3)


@pytest.mark.parametrize(("shape", "seed"), first_quick([("eight", 0), ("turning", 1), ("turning", 2)], 1))
def test_a_right_geometry_is_left_alone(shape: str, seed: int):
    """Turns on the spot above all: there a camera behind the axle is like wheels that turn too little."""
    online = watched(drive(np.random.default_rng(seed), TRUE, 40.0, shape), TRUE, seed)
    assert not online.causes
    assert online.geometry == TRUE
    assert online.estimate is not None
    off = np.abs(online.estimate.vector - TRUE.vector) / online.estimate.sigmas
    assert (off[online.estimate.shown] < 3.0).all()


SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    ("parameter", "amount", "used"),
    [
        pytest.param(Parameter.FORWARD, 0.05, False, marks=SLOW),
        (Parameter.HEADING, math.radians(2.0), True),
        pytest.param(Parameter.DELAY, 0.05, True, marks=SLOW),
        pytest.param(Parameter.FORWARD, 0.1, True, marks=SLOW),
        pytest.param(Parameter.LEFT, 0.1, False, marks=SLOW),
        pytest.param(Parameter.PITCH, math.radians(3.0), True, marks=SLOW),
        (Parameter.WHEEL_SCALE, math.log(1.05), True),
        pytest.param(Parameter.TURN_SCALE, math.log(1.05), False, marks=SLOW),
    ],
)
def test_a_wrong_geometry_is_named_and_mended(parameter: Parameter, amount: float, used: bool):
    """Also by as little as matters on a robot of this size, and nothing else with it."""
    vector = TRUE.vector
    vector[parameter] += amount
    online = watched(drive(np.random.default_rng(1), TRUE, 40.0), DriveGeometry.of(vector), 1)
    assert [cause.parameter for cause in online.causes] == [parameter]
    left = abs(online.geometry.vector[parameter] - TRUE.vector[parameter])
    assert left < 0.3 * abs(amount) or not used
    kept = [p for p in NAMED_ONLY if p is not parameter]
    assert np.allclose(online.geometry.vector[kept], TRUE.vector[kept])


@pytest.mark.parametrize("wrong_m", [0.0, 0.3])
def test_how_far_the_camera_may_stand_elsewhere_holds_from_the_first_image_on(wrong_m: float):
    """When nothing is known of it, too; and it is little once that is corrected, or right."""
    declared = replace(TRUE, forward=TRUE.forward + wrong_m)
    camera = replace(CAMERA, mount_forward=declared.forward, mount_height=declared.height)
    doubts: dict[bool, list[float]] = {False: [], True: []}

    class Noted(OnlineCalibration):
        def watch(self, *arguments: object, **named: object) -> Sequence[Cause]:
            found = super().watch(*arguments, **named)  # type: ignore[arg-type]
            doubts[abs(self.geometry.forward - TRUE.forward) < 0.1].append(self.lever_error)
            return found

    watched(
        drive(np.random.default_rng(3), TRUE, 40.0),
        declared,
        3,
        online=Noted(RobotDescription(camera, geometry=declared)),
    )
    before = doubts[False]
    assert not wrong_m or before == pytest.approx([wrong_m] * len(before), abs=0.1), "before it is corrected"
    assert max(doubts[False] + doubts[True]) <= declared.height, "no camera stands further off"
    assert max(doubts[True][-20:]) < 0.05


@pytest.mark.parametrize(("declared_m", "truly"), first_quick([(0.28, "higher"), (0.32, "lower")], 1))
def test_a_height_that_is_declared_wrongly_is_said_which_way(declared_m: float, truly: str):
    """The wheels are right here: only what is said in brackets is true."""
    run = drive(np.random.default_rng(1), TRUE, 40.0)
    (cause,) = watched(run, replace(TRUE, height=declared_m), 1).causes
    assert cause.parameter is Parameter.WHEEL_SCALE
    assert f"% {truly} than declared" in str(cause)


@cache
def with_long_wheels(seed: int) -> OnlineCalibration:
    """Wheels that go 4 % less than they are declared to."""
    run = drive(np.random.default_rng(seed), TRUE, 60.0)
    return watched(run, replace(TRUE, wheel_scale=1.04), seed)


@pytest.mark.parametrize("seed", first_quick([2, 3, 4], 1))
def test_wheels_that_contradict_the_height_are_named_and_corrected(seed: int):
    """4 % may be the height's, too. But that the two do not go together is sure, and the height counts."""
    online = with_long_wheels(seed)
    assert [cause.parameter for cause in online.causes] == [Parameter.WHEEL_SCALE]
    assert abs(math.log(online.geometry.wheel_scale)) < 0.012


def floor_estimate(wheels: float, lengths: Lengths = Lengths.FLOOR) -> Estimate:
    """Of wheels that go so many times as far as they report, with the sigmas of a long drive."""
    vector = TRUE.vector
    vector[Parameter.WHEEL_SCALE] = math.log(wheels)
    sigmas = np.full(COUNT, 10.0)
    sigmas[[Parameter.WHEEL_SCALE, Parameter.HEIGHT]] = 0.0122, 0.0102
    covariance = np.diag(sigmas**2)
    pair = [Parameter.WHEEL_SCALE, Parameter.HEIGHT]
    covariance[pair, pair[::-1]] = 0.01**2
    return Estimate(vector, covariance, TRUE.vector, 100, 1000, lengths=lengths)


@pytest.mark.parametrize(
    ("wheels", "lengths", "corrected"),
    [
        (0.965, Lengths.FLOOR, True),
        (0.965, Lengths.BOTH, False),
        (0.965, Lengths.RANGERS, False),
        (0.965, Lengths.CONTRADICT, False),
        (1.035, Lengths.FLOOR, False),
        (1.050, Lengths.FLOOR, True),
    ],
)
def test_a_contradiction_of_the_height_corrects_what_only_the_floor_shows(
    wheels: float, lengths: Lengths, corrected: bool
):
    """3.5 % are five sigmas of the ratio and three of the wheels alone.

    A floor that seems too near, so that wheels seem to go further, may be the feet of walls.
    """
    online = OnlineCalibration(declaring(RobotDescription(CAMERA), TRUE))
    for taken in (100, 150):
        online._taken = taken
        online._adopt(floor_estimate(wheels, lengths), np.ones(COUNT, np.bool_))
    assert (online.pending is not None) == corrected
    online.switched()
    assert online.geometry.wheel_scale == pytest.approx(wheels if corrected else 1.0)


@pytest.mark.parametrize(
    ("later", "lengths", "used"),
    [
        (0.983, Lengths.FLOOR, 0.983),
        (0.974, Lengths.FLOOR, 0.974),
        (0.969, Lengths.FLOOR, 0.965),
        (0.956, Lengths.FLOOR, 0.956),
        (0.962, Lengths.FLOOR, 0.965),
        (0.983, Lengths.RANGERS, 0.965),
    ],
)
def test_wheels_that_were_corrected_follow_what_more_pairs_show(later: float, lengths: Lengths, used: float):
    """By a sigma of the ratio, 0.7 %, either way. By the floor."""
    online = OnlineCalibration(declaring(RobotDescription(CAMERA), TRUE))
    first, last = floor_estimate(0.965), floor_estimate(later, lengths)
    for taken, estimate in ((100, first), (150, first), (152, last)):
        online._taken = taken
        online._adopt(estimate, np.ones(COUNT, np.bool_))
        online.switched()
    assert online.geometry.wheel_scale == pytest.approx(used)


@pytest.mark.parametrize("lengths", [Lengths.RANGERS, Lengths.BOTH])
def test_wheels_that_proximity_sensors_show_are_named_by_their_own_sigma(lengths: Lengths):
    """Then it is not the height that may be wrong instead."""
    estimate = with_long_wheels(2).estimate
    assert estimate is not None
    assert causes(estimate)
    assert not causes(replace(estimate, lengths=lengths))


@pytest.mark.slow
@pytest.mark.parametrize("amount", [math.log(1.05), -math.log(1.06)])
def test_wheels_that_floor_and_rangers_contradict_are_corrected(amount: float):
    """Two lengths against one. By the floor alone it might as well be the camera's height."""
    vector = TRUE.vector
    vector[Parameter.WHEEL_SCALE] += amount
    run = drive(np.random.default_rng(4), TRUE, 90.0, "turning")
    online = watched(run, DriveGeometry.of(vector), 4, ranged=1.0)
    (cause,) = online.causes
    assert cause.parameter is Parameter.WHEEL_SCALE and "lower" not in str(cause)
    assert abs(math.log(online.geometry.wheel_scale)) < 0.3 * abs(amount)
    assert np.array_equal(online.geometry.vector[1:], TRUE.vector[1:])


@pytest.mark.slow
@pytest.mark.parametrize("ranged", [1.0, 1.08])
def test_right_wheels_are_left_alone_whatever_the_rangers_read(ranged: float):
    """Sensors that read 8 % too much are contradicted by wheels and floor."""
    online = watched(drive(np.random.default_rng(5), TRUE, 60.0, "turning"), TRUE, 5, ranged=ranged)
    assert not online.causes
    assert online.geometry == TRUE


def test_a_robot_that_stands_learns_nothing():
    online = OnlineCalibration(RobotDescription(CAMERA))
    rng = np.random.default_rng(0)
    pixels = rng.uniform(10, 200, (60, 2))
    for k in range(100):
        online.correct(Observation((k + 1) * 100_000_000, Odometry(0.0, 0.0)))
        online.watch(BLANK, SOURCE, np.arange(60), pixels + rng.normal(0.0, 0.3, pixels.shape))
    assert online.estimate is None
    assert not online.causes


def test_wheels_that_count_backward_are_survived():
    """No point has a depth by them: the image moves the other way."""
    run = drive(np.random.default_rng(1), TRUE, 20.0, "turning")
    run.wheels.way[:] *= -3.0
    assert watched(run, TRUE, 1, sigma=0.05).estimate is not None


def test_a_clock_that_goes_back_is_survived():
    true = DriveGeometry(forward=0.1, height=0.3)
    online = watched(drive(np.random.default_rng(1), true, 20.0), true, 1)
    online.correct(Observation(1, Odometry(0.1, 0.0)))
    assert online.estimate is None


def test_no_tick_does_two_of_the_costly_things(monkeypatch):
    """Reducing a pair, telling the floor, solving: together they are a late tick on a small computer."""
    done: list[tuple[float, str]] = []

    def note(name: str) -> None:
        do: Callable[..., object] = getattr(Estimator, name)

        def noted(self: Estimator, *arguments: object) -> object:
            done.append((online._counted.stamp, name))
            return do(self, *arguments)

        monkeypatch.setattr(Estimator, name, noted)

    for name in ("_reduced", "find_floor", "solve"):
        note(name)
    run = drive(np.random.default_rng(1), TRUE, 20.0)
    online = OnlineCalibration(RobotDescription(CAMERA, geometry=TRUE))
    watched(run, TRUE, 1, online=online)
    assert [name for _, name in done].count("solve") >= 3
    assert len({stamp for stamp, _ in done}) == len(done)


@pytest.mark.parametrize(
    ("pairs", "sigmas", "named"), [(100, 4.4, True), (100, 3.8, False), (96, 4.4, False)]
)
def test_a_curve_at_the_end_of_a_long_drive_names_a_delay_at_once(
    pairs: int, sigmas: float, named: bool, monkeypatch
):
    """Not while pairs are few, nor where it is not sure: what lasts is named later."""
    spread = np.full(COUNT, 10.0)
    spread[Parameter.DELAY] = 0.05 / sigmas
    vector = TRUE.vector
    vector[Parameter.DELAY] = 0.05
    estimate = Estimate(vector, np.diag(spread**2), TRUE.vector, pairs, 0)
    monkeypatch.setattr(Estimator, "solve", lambda *_: estimate)
    online = OnlineCalibration(declaring(RobotDescription(CAMERA), TRUE))
    online._last, online._taken, online._parts_left = estimate, pairs, 1
    found = online._solve()
    assert [cause.parameter for cause in found] == [Parameter.DELAY] * named
    assert online.geometry == TRUE


@pytest.mark.parametrize("forward", [0.0, 0.02], ids=["standing", "driving in the dark"])
def test_hours_without_pairs_take_no_memory(forward: float):
    online = OnlineCalibration(RobotDescription(CAMERA, geometry=TRUE))
    tracemalloc.start()
    for k in range(20_000):
        online.correct(Observation((k + 1) * 100_000_000, Odometry(forward, 0.0)))
    grown, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert grown < 200_000


@pytest.mark.parametrize(("mine", "others"), [(0, 0), (0, 9), (9, 0), (1, 1), (60, 70)])
def test_tracks_of_two_images_are_matched_as_by_numpy(mine: int, others: int):
    rng = np.random.default_rng(mine)
    for _ in range(20):
        ordered, ids = np.sort(rng.permutation(90)[:mine]), rng.permutation(90)[:others]
        _, first, second = np.intersect1d(ordered, ids, assume_unique=True, return_indices=True)
        found = _common(ordered, ids)
        assert np.array_equal(found[0], first)
        assert np.array_equal(found[1], second)


def test_a_correction_of_the_wheels_says_by_how_much_the_way_was_longer(monkeypatch):
    """The map that was made by them is scaled by it."""
    scales, switched = [1.0], OnlineCalibration.switched

    def noted(online: OnlineCalibration) -> None:
        if online.pending is not None:
            scales.append(scales[-1] * online.pending[3])
        switched(online)

    monkeypatch.setattr(OnlineCalibration, "switched", noted)
    declared = replace(TRUE, wheel_scale=1.05)
    online = watched(drive(np.random.default_rng(1), TRUE, 40.0), declared, 1)
    assert scales[-1] == pytest.approx(online.geometry.wheel_scale / 1.05)
    assert scales[-1] == pytest.approx(1.0 / 1.05, abs=0.02)

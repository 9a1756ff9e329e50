"""What a robot has learned of its geometry outlasts its process, and is given up where it is wrong."""

import math
from dataclasses import replace
from datetime import date

import numpy as np
import pytest

from mapweave.agent.calibration.correction import declaring
from mapweave.agent.calibration.learned import LearnedGeometry, LearnedParameter, joined
from mapweave.agent.calibration.online import OnlineCalibration
from mapweave.agent.drive_geometry import Parameter
from mapweave.agent.observation import RobotDescription
from mapweave.agent.recordings.learned_file import read_learned, write_learned
from mapweave.hybridmap.errors import DeviceError
from tests.agent.calibration.room_drive import CAMERA, drive
from tests.agent.calibration.test_online import TRUE, watched

P = Parameter
DECLARED = replace(TRUE, heading=math.radians(2.0))
DESCRIPTION = declaring(RobotDescription(CAMERA), DECLARED)
DAY = date(2026, 11, 29)


def known(heading: float, sigma: float = 0.003) -> LearnedGeometry:
    """By a robot of DESCRIPTION."""
    intrinsics = (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)
    return LearnedGeometry(DECLARED, intrinsics, {P.HEADING: LearnedParameter(heading, sigma)})


def test_what_is_learned_is_used_from_the_start_and_confirmed(tmp_path):
    """Two drives of one robot, each with wheels of its own."""
    first = watched(drive(np.random.default_rng(1), TRUE, 40.0), DECLARED, 1)
    learned = first.learned
    assert learned is not None and list(learned.parameters) == [P.HEADING]
    write_learned(tmp_path / "r0.learned.toml", learned, DAY)
    read = read_learned(tmp_path / "r0.learned.toml")
    assert read == (learned, DAY)
    again = OnlineCalibration(DESCRIPTION, read[0])
    assert again.pending is None and again.geometry.heading == learned.parameters[P.HEADING].value
    assert again.description.camera.cx != CAMERA.cx, "the camera behind the lens is level"
    used = again.geometry
    watched(drive(np.random.default_rng(2), TRUE, 40.0), DECLARED, 2, online=again)
    assert again.geometry == used and not again.contradicted
    both = again.learned
    assert both is not None
    was, now = learned.parameters[P.HEADING], both.parameters[P.HEADING]
    assert now.sigma < was.sigma and abs(now.value - TRUE.heading) < 3.5 * now.sigma


def test_a_camera_that_was_turned_is_learned_again():
    """It was turned between two drives: what was learned is given up, and said to be."""
    touched = OnlineCalibration(DESCRIPTION, known(math.radians(-2.0)))
    assert touched.geometry.heading == math.radians(-2.0)
    watched(drive(np.random.default_rng(3), TRUE, 40.0), DECLARED, 3, online=touched)
    assert touched.geometry.heading == pytest.approx(TRUE.heading, abs=math.radians(0.5))
    (line,) = touched.contradicted
    assert line.startswith("camera heading, deg -2.00, learned earlier, is contradicted")
    learned = touched.learned
    assert learned is not None
    assert learned.parameters[P.HEADING].value == pytest.approx(TRUE.heading, abs=math.radians(0.5))


def test_less_than_both_sigmas_explain_is_no_contradiction():
    """1.5 degrees, which this drive alone is sure of, and an earlier one was not."""
    for sigma, given_up in ((0.003, 1), (0.02, 0)):
        online = OnlineCalibration(DESCRIPTION, known(math.radians(-1.5), sigma))
        watched(drive(np.random.default_rng(4), TRUE, 40.0), DECLARED, 4, online=online)
        assert len(online.contradicted) == given_up


@pytest.mark.parametrize(
    "now",
    [
        declaring(DESCRIPTION, replace(DECLARED, heading=0.0)),
        replace(DESCRIPTION, camera=replace(DESCRIPTION.camera, fx=300.0)),
    ],
)
def test_another_camera_or_declaration_uses_nothing_of_it(now: RobotDescription):
    plain, given = OnlineCalibration(now), OnlineCalibration(now, known(0.0))
    assert given.geometry == plain.geometry and given.description == plain.description
    assert given.learned is None


def test_a_robot_that_corrects_nothing_keeps_nothing():
    assert OnlineCalibration(DESCRIPTION).learned is None


def test_two_estimates_are_joined_as_least_squares_do():
    """Weighted by their variances; but never surer than the estimator itself is."""
    value, sigma = joined(0.8, 0.1, 1.0, 0.05, P.FORWARD)
    design, weights = np.ones((2, 1)), np.array([100.0, 400.0])
    normal = (design.T * weights) @ design
    assert value == pytest.approx(((design.T * weights) @ [0.8, 1.0] / normal[0, 0]).item())
    assert sigma == pytest.approx(math.sqrt(1.0 / normal[0, 0]))
    assert joined(0.8, 0.011, 0.8, 0.011, P.FORWARD)[1] == pytest.approx(0.01)
    # Both by the floor and one declared height.
    assert joined(0.05, 0.0123, 0.05, 0.0123, P.WHEEL_SCALE)[1] == pytest.approx(math.hypot(0.005, 0.01))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("sigma = 0.003", "sigma = -1.0", "must be positive"),
        ("sigma = 0.003", "", "sigma is missing"),
        ("value = ", "value = 9", "heading_deg"),
        ("value = ", 'value = "x" #', "no number"),
        ("[learned.heading]", "[learned.headings]", "headings"),
        ("fx = ", "fx = inf #", "fx is inf"),
        ("learned_on = 2026-11-29", "", "learned_on"),
    ],
)
def test_a_damaged_file_is_refused_with_the_reason(tmp_path, old: str, new: str, words: str):
    path = tmp_path / "r0.learned.toml"
    assert read_learned(path) is None
    write_learned(path, known(0.01), DAY)
    assert read_learned(path) == (known(0.01), DAY)
    text = path.read_text()
    assert text.count(old) == 1 or old == "value = "
    path.write_text(text.replace(old, new))
    with pytest.raises(DeviceError, match=words) as error:
        read_learned(path)
    assert str(path) in str(error.value)

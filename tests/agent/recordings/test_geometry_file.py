"""The measured geometry of a robot in a file: read as it was written, what else is there stays."""

import math
import tomllib

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mapweave import Camera, RobotDescription
from mapweave.agent.calibration.correction import geometry_of
from mapweave.agent.drive_geometry import DriveGeometry
from mapweave.agent.recordings.geometry_file import KEYS, LIMITS, read_geometry, write_geometry
from mapweave.hybridmap.errors import DeviceError, MapweaveError
from mapweave.processes.agent import measured

CAMERA = """\
# measured by hand
width = 320
  forward_m=0.5 # a guess

[other]
forward_m = 7
"""


def within(field: str) -> st.SearchStrategy[float]:
    """Values that a file may give, clear of the limits by more than rounding."""
    low, high = LIMITS[field]
    return st.floats(low + 1e-4 * (high - low), high - 1e-4 * (high - low))


@given(geometry=st.builds(DriveGeometry, **{field: within(field) for field in KEYS}), fresh=st.booleans())
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_what_is_written_is_read(tmp_path, geometry: DriveGeometry, fresh: bool):
    file = tmp_path / "new" / "r0.toml"
    file.unlink(missing_ok=True)
    if not fresh:
        file.parent.mkdir(exist_ok=True)
        file.write_text(CAMERA)
    for _ in range(2):
        write_geometry(file, geometry, {"forward": "sigma 0.1", "delay": "by hand"})
        again = DriveGeometry(**read_geometry(file))
        assert np.allclose(again.vector, geometry.vector, rtol=2e-5, atol=1e-5)
        values = tomllib.loads(file.read_text())
        assert set(KEYS.values()) <= set(values)
        assert file.read_text().count("# sigma 0.1") == 1
        if not fresh:
            assert values["width"] == 320
            assert values["other"] == {"forward_m": 7}
            assert "# measured by hand" in file.read_text()


def test_angles_are_degrees(tmp_path):
    write_geometry(tmp_path / "r0.toml", DriveGeometry(heading=math.radians(-2.0)), {})
    assert tomllib.loads((tmp_path / "r0.toml").read_text())["heading_deg"] == pytest.approx(-2.0)


@pytest.mark.parametrize(("text", "word"), [
    ("forward_m = ", "Invalid value"), ("pitch_deg = 80", "pitch_deg is 80"), ("height_m = 0", "height_m"),
    ("wheel_scale = 0.01", "wheel_scale"), ("delay_s = nan", "delay_s"), ('left_m = "x"', "left_m"),
    ("forward_m = inf", "forward_m"), ("foward_m = 0.1", "no setting 'foward_m'; did you mean 'forward_m'?"),
    ("foo = 1", "known are"), ("left_m = " + "9" * 400, "left_m has too many digits"),
    ("left_m = " + "[" * 5000, "r0.toml"),
])  # fmt: skip
def test_what_cannot_be_right_is_refused_in_one_line(tmp_path, text: str, word: str):
    file = tmp_path / "r0.toml"
    file.write_text(text)
    with pytest.raises(DeviceError) as error:
        read_geometry(file)
    assert str(file) in str(error.value)
    assert word in str(error.value)
    assert "\n" not in str(error.value)


def test_a_place_without_files_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(MapweaveError) as error:
        write_geometry(tmp_path / "file" / "r0.toml", DriveGeometry(), {})
    assert "\n" not in str(error.value)


def test_a_robot_takes_what_was_measured_and_declares_the_rest(tmp_path):
    camera = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, mount_height=0.3, mount_forward=0.1)
    declared = RobotDescription(camera, geometry=DriveGeometry(left=0.05))
    assert measured(declared, None) is declared
    assert measured(declared, tmp_path / "none.toml") is declared
    file = tmp_path / "r0.toml"
    file.write_text("forward_m = 0.2\nheading_deg = 3.0\n")
    found = measured(declared, file)
    assert (found.camera.mount_forward, found.camera.mount_height) == (0.2, 0.3)
    assert geometry_of(found) == DriveGeometry(forward=0.2, left=0.05, height=0.3, heading=math.radians(3.0))

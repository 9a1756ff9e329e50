"""Robots and cameras from the tables of a scenario file: what is meant, or one line that says why not."""

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave.hybridmap.errors import InvalidValue, MapweaveError, SettingsError
from mapweave.hybridmap.pose import Pose2
from mapweave.sim.camera import CAMERAS
from mapweave.sim.robots import RobotSetup, robot_from_table, robot_setups


def test_a_camera_is_a_name_or_a_variation_of_a_named_camera():
    """The rest stays as it is in the camera that is named."""
    assert robot_from_table({"name": "a", "camera": "wide"}).camera == CAMERAS["wide"]
    assert robot_from_table({"name": "a"}).camera == CAMERAS["webcam"]
    noisy = robot_from_table({"name": "a", "camera": {"like": "fisheye", "read_noise": 1.0}}).camera
    assert (noisy.read_noise, noisy.distortion) == (1.0, CAMERAS["fisheye"].distortion)
    changed = robot_from_table(
        {"name": "a", "camera": {"like": "cheap", "read_noise": 1.0, "exposure": {"lag": 2.0}}}
    ).camera
    assert (changed.read_noise, changed.exposure.lag) == (1.0, 2.0)
    assert changed.exposure.vignetting == CAMERAS["cheap"].exposure.vignetting
    assert changed.distortion == CAMERAS["cheap"].distortion
    own = robot_from_table(
        {"name": "a", "camera": {"distortion": [0.1, 0, 0, 0, 0], "intrinsics": {"width": 640, "cx": 319.5}}}
    )
    assert own.describe().distortion == (0.1, 0, 0, 0, 0)
    assert (own.describe().camera.width, own.describe().camera.height) == (640, 240)


def test_a_robot_describes_what_was_ordered():
    """Limits, rangers, start, wheels."""
    table = {
        "name": "a", "start": [1, 2, 0.5], "rangers": 8, "ranger_reach": 2.0, "max_forward": 0.2,
        "max_turn": 0.5, "body": {"slip": 0.03, "motor_lag": 0.3, "ticks_per_turn": 512},
    }  # fmt: skip
    setup = robot_from_table(table)
    d = setup.describe()
    assert (len(d.ranger_bearings), d.ranger_reach, d.max_forward, d.max_turn) == (8, 2.0, 0.2, 0.5)
    assert setup.pose == Pose2(1.0, 2.0, 0.5)
    assert (setup.body.slip, setup.body.motor_lag, setup.body.ticks_per_turn) == (0.03, 0.3, 512)


@pytest.mark.parametrize(("table", "says"), [
    ({"name": "a", "camera": "telephoto"}, "no camera 'telephoto'; there are webcam"),
    ({"name": "a", "camera": 3}, "must be a name"),
    ({"name": "a", "camera": {"read_nois": 1.0}}, "did you mean 'read_noise'"),
    ({"name": "a", "camera": {"exposure": {"seconds": 9.0}}},
     "exposure.seconds must be a number, 0 to 0.1; it is 9"),
    ({"name": "a", "camera": {"distortion": [-2.0, 0, 0, 0, 0]}}, "folds"),
    ({"name": "a", "camera": {"intrinsics": 3}}, "expected table"),
    ({"name": "a b"}, "a b"),
    ({"camera": "wide"}, "name is missing"),
    ({"name": "a", "body": {"slip": -1.0}}, "slip"),
    ({"name": "a", "body": {"ticks_per_turn": 0}}, "ticks_per_turn"),
    ({"name": "a", "rangers": 1000}, "rangers must be a whole number, 0 to 256; it is 1000"),
    ({"name": "a", "start": [1, 2]}, "start: expected list of length 3"),
])  # fmt: skip
def test_wrong_tables_are_reported_with_a_reason(table: dict[str, object], says: str):
    with pytest.raises(MapweaveError, match=says) as caught:
        robot_from_table(table)
    assert "\n" not in str(caught.value)


@given(
    st.dictionaries(
        st.sampled_from(["name", "camera", "body", "start", "rangers", "max_turn", "x"]),
        st.recursive(
            st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
            lambda inner: (
                st.lists(inner, max_size=3)
                | st.dictionaries(st.sampled_from(["like", "slip", "distortion", "exposure", "lag"]), inner)
            ),
            max_leaves=6,
        ),
    )
)
def test_no_table_crashes(table: dict[str, object]):
    """Nonsense is a robot or one of our errors."""
    with contextlib.suppress(SettingsError, InvalidValue):
        assert isinstance(robot_from_table(table), RobotSetup)


def test_one_to_sixteen_robots():
    assert len(robot_setups([f"r{k}" for k in range(16)])) == 16
    for robots in ([], [f"r{k}" for k in range(17)]):
        with pytest.raises(InvalidValue, match="1 to 16"):
            robot_setups(robots)
    with pytest.raises(InvalidValue, match="same name"):
        robot_setups(["a", RobotSetup("a")])

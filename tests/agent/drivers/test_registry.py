"""Drivers are found: shipped ones, another package's, a class in a file; what is wrong is one line."""

import os
import sys
from pathlib import Path

import pytest

from mapweave.agent.drivers import registry
from mapweave.agent.drivers.registry import SHIPPED, drivers, find_driver, listing
from mapweave.agent.drivers.settings import CameraSettings, Geometry, RobotSettings
from mapweave.hybridmap.errors import DeviceError, SettingsError
from mapweave.settings import load_settings
from tests.programs import mapweave

ROOT = Path(__file__).parents[3]
CLASS = """
class Rover:
    '''A rover.'''
    def __init__(self, settings): self.settings = settings
    def describe(self): return None
    def sense(self): return None
    def act(self, command): return command
    def close(self): pass
"""


WHEELED = """
from mapweave.agent.drivers.wheeled import WheeledRobot
class Rover(WheeledRobot):
    def __init__(self, settings): self.settings = settings
"""


def test_shipped_drivers_are_listed_with_what_they_drive():
    listed = {robot.name: robot for robot in listing()}
    assert {"koala", "create", "waveshare", "arduino", "remote"} <= listed.keys()
    assert "Koala" in listed["koala"].line
    assert not any(robot.missing or robot.error for robot in listed.values())


def test_a_driver_of_another_package_is_found_and_what_it_lacks_is_said(tmp_path):
    (tmp_path / "rover.py").write_text(CLASS)
    (tmp_path / "legs.py").write_text("import a_library_that_is_not_there\n" + CLASS)
    (tmp_path / "broken.py").write_text("1 / 0\n")
    info = tmp_path / "rovers-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: rovers\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[mapweave.robots]\n"
        "rover = rover:Rover\nlegs = legs:Rover\nbroken = broken:Rover\nkoala = rover:Rover\n"
    )
    paths = os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{tmp_path}"}
    ran = mapweave("robots", cwd=ROOT, check=True, env=paths)
    lines = dict(line.split(maxsplit=1) for line in ran.stdout.splitlines())
    assert lines["rover"] == "A rover"
    assert lines["legs"] == "needs the library a_library_that_is_not_there"
    assert lines["broken"] == "cannot be loaded: ZeroDivisionError: division by zero"
    # A package does not take the place of a shipped driver.
    assert "K-Team" in lines["koala"]
    assert len(lines) == len(SHIPPED) + 3


def test_a_class_in_a_file(tmp_path):
    path = tmp_path / "rover.py"
    path.write_text(CLASS)
    settings = RobotSettings(options={"port": "x"})
    robot = find_driver(f"{path}:Rover")(settings)
    assert robot.settings is settings  # type: ignore[attr-defined]


def test_a_class_in_a_file_with_a_dataclass_for_its_options(tmp_path):
    """Written as the drivers of this package are. Before, it ended in an error from within `dataclasses`."""
    path = tmp_path / "rover.py"
    path.write_text(
        "from __future__ import annotations\n"
        "from dataclasses import dataclass\n"
        "from mapweave.storage.settings_file import build\n"
        "@dataclass(frozen=True)\nclass Options:\n    port: str\n"
        + CLASS.replace("self.settings = settings", "self.o = build(Options, settings.options, 'options')")
    )
    robot = find_driver(f"{path}:Rover")(RobotSettings(options={"port": "x"}))
    assert robot.o.port == "x"  # type: ignore[attr-defined]


@pytest.mark.parametrize(("text", "words"), [
    ("import a_library_that_is_not_there\n", "needs the library a_library_that_is_not_there, which is not"),
    ("1 / 0\n", "cannot be loaded: ZeroDivisionError: division by zero"),
    ("", "cannot be loaded: AttributeError: .* has no attribute 'Rover'"),
])  # fmt: skip
def test_a_driver_of_another_package_that_cannot_be_loaded(text: str, words: str, tmp_path, monkeypatch):
    """Before, an agent with it ended in a traceback."""
    (tmp_path / "a_rover.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "a_rover", raising=False)
    monkeypatch.setattr(registry, "drivers", lambda: {**SHIPPED, "rover": "a_rover:Rover"})
    with pytest.raises(DeviceError, match=f"^driver rover:? {words}"):
        find_driver("rover")


def test_a_class_that_tells_no_signature(tmp_path):
    """Classes of compiled libraries often tell none."""
    path = tmp_path / "rover.py"
    text = CLASS.replace("class Rover:", "class Rover(str):")
    path.write_text("\n".join(line for line in text.splitlines() if "__init__" not in line))
    settings = RobotSettings()
    assert find_driver(f"{path}:Rover")(settings) == str(settings)


@pytest.mark.parametrize(("text", "name", "words"), [
    (None, "Rover", "no such file"),
    (CLASS, "Rower", "no class 'Rower'; there are Rover"),
    ("def f(:\n", "Rover", "line 1: SyntaxError"),
    ("\n\nraise ValueError('no')\n", "Rover", "line 3: ValueError: no"),
    (CLASS.replace("act", "move"), "Rover", "lacks act"),
    ("Rover = 7\n", "Rover", "needs a class"),
    (CLASS.replace("self, settings", "self"), "Rover",
     r"^driver .*rover.py:Rover: __init__ must take one argument, the settings$"),
    (CLASS.replace("self.settings = settings", "self.settings = settings.options['gate']"), "Rover",
     r"^driver: .*rover.py, line \d+: KeyError: 'gate'$"),
    (WHEELED, "Rover", r"^driver .*rover.py:Rover: __init__ must call super\(\).__init__\(base, settings\)"),
])  # fmt: skip
def test_a_file_that_is_no_driver(text: str | None, name: str, words: str, tmp_path):
    path = tmp_path / "rover.py"
    if text is not None:
        path.write_text(text)
    with pytest.raises(DeviceError, match=words) as error:
        find_driver(f"{path}:{name}")(RobotSettings())
    assert "\n" not in str(error.value)


def test_the_example_says_which_option_it_lacks():
    example = Path(__file__).parents[3] / "examples" / "own_robot.py"
    with pytest.raises(
        SettingsError, match=r'^\[robot.options\] lacks the port; give port = "/dev/ttyUSB0"$'
    ):
        find_driver(f"{example}:OwnRobot")(RobotSettings())


def test_an_unknown_name():
    with pytest.raises(SettingsError, match="did you mean 'koala'"):
        find_driver("koalla")
    with pytest.raises(SettingsError, match="there are arduino, create"):
        find_driver("zzz")
    with pytest.raises(SettingsError, match=r"given by --settings robot\.toml"):
        find_driver("robot.toml")
    with pytest.raises(SettingsError, match=r"its class: still\.py:CLASS"):
        find_driver("still.py")
    assert "remote" in drivers()


CAMERA = CameraSettings(64, 48, 60.0, 60.0, 32.0, 24.0, 0.3, forward_m=0.1)
KNOWN = Geometry(radius=0.2, axle=0.25, max_forward=0.3, max_turn=0.8)


def test_settings_go_over_what_the_driver_knows():
    given = Geometry(axle=0.31, ranger_bearings_deg=(90.0,), ranger_reach=1.0)
    description = RobotSettings(camera=CAMERA, geometry=given).describe(KNOWN)
    assert (description.axle, description.radius) == (0.31, 0.2)
    assert description.ranger_bearings == pytest.approx((1.5708,), abs=1e-4)
    assert description.camera.mount_forward == 0.1


@pytest.mark.parametrize(("text", "words"), [
    (
        "[robot.geometry]\naxle = -1",
        "robot.toml: robot.geometry.axle must be a number, above 0; it is -1",
    ),
    (
        "[robot.camera]\nwidth = 640\nheight = 480\nfx = 600.0\nfy = 600.0\ncx = 320.0\ncy = 240.0\n"
        "height_m = 300\n",
        "height_m is 300; it is in metres, from 0 to 10",
    ),
    ("[robot.geometry]\naxle = 150", "robot.toml: geometry: axle is 150; it is in metres, at most 10"),
    ('[robot]\ndrivr = "koala"', "'drivr'; did you mean 'driver'"),
])  # fmt: skip
def test_wrong_values_are_one_line(text: str, words: str, tmp_path):
    (tmp_path / "robot.toml").write_text(text)
    with pytest.raises(SettingsError) as error:
        load_settings(tmp_path / "robot.toml")
    assert words in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(("settings", "known", "words"), [
    (RobotSettings(), KNOWN, r"no \[robot.camera\]: give source, width"),
    (RobotSettings(camera=CAMERA), Geometry(), "radius is missing"),
])  # fmt: skip
def test_settings_that_lack_something(settings: RobotSettings, known: Geometry, words: str):
    with pytest.raises(SettingsError, match=words):
        settings.describe(known)

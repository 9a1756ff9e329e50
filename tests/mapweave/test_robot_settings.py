"""Settings of a robot that are not finished: one line says what to add, before anything is waited for."""

import json
from pathlib import Path

import pytest

from mapweave.cli import main
from mapweave.exit_status import NO, USAGE
from tests.mapweave.command_line import CAMERA, complaint

TABLES = {
    "camera": f"[robot.camera]\n{CAMERA}",
    "options": '[robot.options]\nport = "/dev/ttyUSB0"\n',
    "geometry": "[robot.geometry]\nradius = 0.12\n",
}
WORDS = "which the driver remote, the default, does not use: name the robot's driver"


@pytest.mark.usefixtures("signals")
@pytest.mark.parametrize("table", TABLES)
def test_a_robot_without_a_driver_is_refused(table: str, tmp_path, capfd):
    """Without this line the agent waited for a base behind the network without end."""
    settings = tmp_path / "robot.toml"
    settings.write_text(TABLES[table])
    for command in (
        ["agent", "r0", "--data", tmp_path / "data"],
        ["record", "r0", "--out", tmp_path / "drive"],
    ):
        said = complaint(capfd, *command, "--settings", settings, "--connect", "tcp/127.0.0.1:9")
        assert f"the settings have [robot.{table}], {WORDS}" in said and "`mapweave robots`" in said


def test_doctor_says_it_as_well(tmp_path, capfd):
    settings = tmp_path / "robot.toml"
    settings.write_text(TABLES["options"])
    words = ["doctor", "--settings", str(settings), "--data", str(tmp_path), "--offline", "--json"]
    assert main(words) == NO
    findings = json.loads(capfd.readouterr().out)["findings"]
    (driver,) = [one for one in findings if one["subject"] == "driver"]
    assert WORDS in driver["detail"] and driver["advice"] == "name the driver of the robot in [robot]"


def test_the_settings_file_of_a_robot_is_given_as_the_robot(tmp_path, capfd):
    """`doctor --robot robot.toml` said that it is no driver."""
    settings = tmp_path / "robot.toml"
    settings.write_text('[robot]\ndriver = "koalla"\n')
    assert main(["doctor", "--robot", str(settings), "--data", str(tmp_path), "--offline", "--json"]) == NO
    findings = {one["subject"]: one for one in json.loads(capfd.readouterr().out)["findings"]}
    assert "driver koalla" in findings["settings"]["detail"]
    assert "did you mean 'koala'?" in findings["driver"]["detail"]


@pytest.mark.usefixtures("signals")
@pytest.mark.parametrize(
    "words", [["agent", "r0"], ["record", "r0", "--out", "drive"], ["calibrate", "drive", "--name", "r0"]]
)
def test_each_command_of_a_robot_takes_its_settings_file_as_the_robot(
    words: list[str], tmp_path, capfd, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    Path("robot.toml").write_text('[robot]\ndriver = "koalla"\n')
    command = [*words, "--connect", "tcp/127.0.0.1:9", "--robot", "robot.toml"]
    assert "did you mean 'koala'?" in complaint(capfd, *command)
    both = complaint(capfd, *command, "--settings", "other.toml", status=USAGE)
    assert "--robot robot.toml is a settings file, and so is --settings: give one of them" in both

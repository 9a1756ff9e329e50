"""docs/robot.md: it shows the way whole, its settings can be read, its links lead somewhere."""

import re
import tomllib
from pathlib import Path

from mapweave.agent.drivers.arduino import ArduinoBase
from mapweave.settings import Settings
from mapweave.storage.settings_file import build

PAGE = Path(__file__).parents[2] / "docs" / "robot.md"
TEXT = PAGE.read_text(encoding="utf-8")
COMMANDS = re.findall(r"^\$ mapweave (.+)$", TEXT, re.MULTILINE)


def test_the_page_shows_the_commands_of_the_way():
    names = {command.split()[0] for command in COMMANDS}
    assert {"find-port", "find-cameras", "doctor", "agent", "server", "map"} <= names


def test_its_settings_can_be_read():
    (table,) = re.findall(r"```toml\n(.*?)```", TEXT, re.DOTALL)
    robot = build(Settings, tomllib.loads(table), "robot.md").robot
    assert robot.camera is not None and robot.describe(ArduinoBase.geometry).axle == 0.15


def test_the_unit_finds_what_the_page_hands_over():
    """Settings, key and calibration lie where the unit of the robot that is enabled looks for them."""
    unit = (PAGE.parents[1] / "examples/systemd/mapweave-agent@.service").read_text(encoding="utf-8")
    (name,) = set(re.findall(r"mapweave-agent@(\w+)", TEXT))
    wanted = re.findall(
        r"/etc/mapweave/%i\S*\.toml|(?<=--calibration )\S+", unit.replace("%i.toml", "%i.toml ")
    )
    paths = {path.replace("%i", name) for path in wanted}
    calibration = f"{next(path for path in paths if not path.endswith('.toml'))}/{name}.toml"
    handed = set(re.findall(r"install -D -m \d+ \S+ (\S+)", TEXT))
    assert handed == {path for path in paths if path.endswith(".toml")} | {calibration}
    assert f"mapweave keys add {name}" in TEXT and f"agent {name} --settings" in TEXT


def test_its_links_lead_somewhere():
    links = re.findall(r"\]\(([^)#]+)\)", TEXT)
    assert links and all((PAGE.parent / link).exists() for link in links)

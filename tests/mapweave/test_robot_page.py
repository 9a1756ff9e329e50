"""docs/robot.md: it shows the way whole, its settings can be read, its links lead somewhere."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from mapweave.agent.drivers.arduino import ArduinoBase
from mapweave.settings import Settings
from mapweave.storage.settings_file import build

PAGE = Path(__file__).parents[2] / "docs" / "robot.md"
TEXT = PAGE.read_text(encoding="utf-8")
COMMANDS = re.findall(r"^\$ mapweave (.+)$", TEXT, re.MULTILINE)


def test_the_page_shows_the_commands_of_the_way() -> None:
    names = {command.split()[0] for command in COMMANDS}
    assert {"find-port", "find-cameras", "doctor", "agent", "server", "map"} <= names


def test_its_settings_can_be_read() -> None:
    (table,) = re.findall(r"```toml\n(.*?)```", TEXT, re.DOTALL)
    robot = build(Settings, tomllib.loads(table), "robot.md").robot
    assert robot.camera is not None and robot.describe(ArduinoBase.geometry).axle == 0.15


def test_its_links_lead_somewhere() -> None:
    links = re.findall(r"\]\(([^)#]+)\)", TEXT)
    assert links and all((PAGE.parent / link).exists() for link in links)

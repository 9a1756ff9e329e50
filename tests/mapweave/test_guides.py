"""Guides cannot rot: every command of every page parses, and those of the tutorials run in their order."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from mapweave.cli import parser
from mapweave.commands.examples import parsers_of

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "SECURITY.md", *sorted((ROOT / "docs").rglob("*.md"))]
COMMAND = re.compile(r"^(?:    )?(?:\$ )?(?:\S*bin/)?mapweave ([a-z].*)$")
INLINE = re.compile(r"`mapweave ([a-z][^`|]*)`")
PLACEHOLDER = {"FILE": "file", "HOST": "host", "PORT": "8080", "SERVER": "host", "...": ""}


def blocks(page: Path) -> list[str]:
    """Commands that stand in blocks of a page, lines that go on joined, comments and pipes cut off."""
    found, waiting, fenced = [], "", False
    for line in page.read_text(encoding="utf-8").splitlines():
        fenced ^= line.startswith("```")
        if waiting or ((fenced or line.startswith("    ")) and COMMAND.match(line)):
            waiting += (COMMAND.match(line) or [None, line.strip()])[1] if not waiting else line.strip()
            if waiting.endswith("\\"):
                waiting = waiting[:-1]
                continue
            found.append(re.split(r"\s(?:#|>|\||&)\s", f"{waiting} ")[0].strip())
            waiting = ""
    return found


EVERY = [
    pytest.param(page, command, id=f"{page.name}: {command}"[:90])
    for page in PAGES
    for command in dict.fromkeys(blocks(page))
]


def test_there_are_commands_to_check() -> None:
    assert len(EVERY) > 150
    assert {"first-map.md", "robot.md", "security.md", "README.md"} <= {one.values[0].name for one in EVERY}

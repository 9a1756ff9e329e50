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


def test_every_command_of_every_page_parses(capsys: pytest.CaptureFixture[str]) -> None:
    wrong, checked, of_pages = [], 0, set()
    for page in PAGES:
        for command in dict.fromkeys(blocks(page)):
            checked, _ = checked + 1, of_pages.add(page.name)
            try:
                parser().parse_args(shlex.split(command))
            except SystemExit as error:
                said = capsys.readouterr().err.splitlines()
                wrong += [f"{page.name}: mapweave {command}: {said[-1]}"] if error.code else []
    assert not wrong, "\n".join(wrong)
    assert checked > 100 and {"first-map.md", "robot.md", "security.md", "README.md"} <= of_pages


def test_every_command_that_a_sentence_names_is_there() -> None:
    """Inline, commands lack their arguments: their words are compared."""
    known, wrong = parsers_of(parser()), []
    for page in PAGES:
        for words in map(str.split, INLINE.findall(page.read_text(encoding="utf-8"))):
            has_actions = any(name.startswith(f"{words[0]} ") for name in known)
            name = " ".join(words[: 2 if has_actions and len(words) > 1 else 1])
            wrong += [] if name in known else [f"{page.name}: mapweave {' '.join(words)}"]
    assert not wrong, "\n".join(wrong)

"""Guides cannot rot: every command of every page parses, and those of two tutorials run in their order."""

import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from mapweave.cli import parser
from mapweave.commands.examples import parsers_of
from tests.simulator import needs_simulator
from tests.waiting import eventually, free_port

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "SECURITY.md", *sorted((ROOT / "docs").rglob("*.md"))]
COMMAND = re.compile(r"^(?:    )?(?:\$ )?(?:\S*bin/)?mapweave ([a-z].*)$")
PATIENCE = 180.0
"""s; the machine may be busy."""
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
            found.append(re.split(r"\s(?:#|>>?|\||&)\s", f"{waiting} ")[0].strip())
            waiting = ""
    return found


def test_every_command_of_every_page_parses(capsys):
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


def test_every_target_of_make_that_a_page_names_is_there():
    targets = set(re.findall(r"^([a-z][\w-]*):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M))
    named = set()
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        fenced = "\n".join(re.findall(r"^```\w*\n(.*?)^```", text, re.M | re.S))
        lines = [
            *re.findall(r"^make ([^#\n]*)", fenced, re.M),
            *re.findall(r"^    make ([^#\n]*)", text, re.M),
            *re.findall(r"`make ([^`]*)`", text),
        ]
        words = " ".join(lines).split()
        named |= {(page.name, word) for word in words if re.fullmatch(r"[a-z][\w-]*", word)}
    assert {("README.md", "demo"), ("README.md", "test")} <= named
    assert not {(page, word) for page, word in named if word not in targets}


def test_every_command_that_a_sentence_names_is_there():
    """Inline, commands lack their arguments: their words are compared."""
    known, wrong = parsers_of(parser()), []
    for page in PAGES:
        for words in map(str.split, INLINE.findall(page.read_text(encoding="utf-8"))):
            has_actions = any(name.startswith(f"{words[0]} ") for name in known)
            name = " ".join(words[: 2 if has_actions and len(words) > 1 else 1])
            wrong += [] if name in known else [f"{page.name}: mapweave {' '.join(words)}"]
    assert not wrong, "\n".join(wrong)


def shown(page: Path) -> list[str]:
    """Lines of output in the blocks of a page; none that are cut, and no commands."""
    inside = re.findall(r"^```(?:console|text)\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S)
    lines = [line for block in inside for line in block.splitlines()]
    return [line for line in lines if not line.startswith("$") and "..." not in line and "…" not in line]


def shape(line: str) -> str:
    """A line without its time, numbers, ids, plurals and blanks."""
    line = re.sub(r"^\d{4}-\d\d-\d\d \d\d:\d\d:\d\d ", "", line)
    line = re.sub(r"\b[0-9a-f]{12,64}\b|[-+]?\d[\d.,]*", "#", line)
    return " ".join(re.sub(r"(\w)s\b", r"\1", line).split())


class Tutorial:
    """Runs the commands of a page in a folder, with a router of its own; what goes on runs beside the rest.

    Attributes:
        going: processes that go on, by the first word of their commands and a name.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.going = folder, dict[str, subprocess.Popen[bytes]]()
        self.endpoint, self.http = f"tcp/127.0.0.1:{free_port()}", str(free_port())

    def run(self, command: str) -> None:
        """Run a command; one that fails since another has not come so far is run again."""
        words = shlex.split(command.replace("8080", self.http))
        words += ["--listen" if words[0] == "server" else "--connect", self.endpoint] * (words[0] != "map")
        if words[0] not in ("server", "sim", "agent"):
            eventually(lambda: self._start(words).wait() == 0, PATIENCE)
            return
        self.going[" ".join(words[:2])] = self._start(words)
        if words[0] != "agent":
            eventually(
                lambda: ("listens at" if words[0] == "server" else "simulating r0") in self.output(), PATIENCE
            )

    def output(self) -> str:
        """All that was printed."""
        return (self.folder / "output.txt").read_text(encoding="utf-8")

    def end(self, *commands: str) -> None:
        """Ctrl-C, for all if none is named."""
        for name in commands or tuple(reversed(self.going)):
            process = self.going.pop(name)
            process.send_signal(signal.SIGINT)
            assert process.wait(60.0) in (0, 130), name

    def _start(self, words: list[str]) -> subprocess.Popen[bytes]:
        with (self.folder / "output.txt").open("ab") as output:
            command = [sys.executable, "-m", "mapweave", *words]
            return subprocess.Popen(command, cwd=self.folder, stdout=output, stderr=output)


@pytest.mark.timeout(900)
@needs_simulator
@pytest.mark.parametrize(("name", "ready"), [
    pytest.param("first-map", "(7 nodes)", marks=pytest.mark.slow),
    pytest.param("two-robots", "r0.1 and r1.1 are one map now", marks=pytest.mark.scenario),
], ids=["first-map", "two-robots"])  # fmt: skip
def test_the_first_tutorials_run_as_they_stand(name: str, ready: str, tmp_path):
    """What a page shows has a line of the same form in what its commands print."""
    page, tutorial = ROOT / "docs" / f"{name}.md", Tutorial(tmp_path)
    try:
        for command in blocks(page):
            going = command.split()[0] in ("server", "sim", "agent")
            if not going and len(tutorial.going) > 1:
                eventually(lambda: ready in tutorial.output(), 300.0)
            if command.startswith("map show"):
                tutorial.end("agent r0")
            tutorial.run(command)
        tutorial.end()
    finally:
        for process in tutorial.going.values():
            process.kill()
            process.wait()
    printed = {shape(line) for line in tutorial.output().splitlines()}
    stale = [line for line in shown(page) if not any(shape(line) in one for one in printed)]
    assert len(shown(page)) > 4 and not stale, "\n".join(stale)

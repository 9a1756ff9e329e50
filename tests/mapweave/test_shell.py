"""What the shell sees of every command: help with examples, completion, exit statuses, logs, progress."""

from __future__ import annotations

import argparse
import io
import logging
import os
import pty
import re
import select
import shlex
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from argcomplete.finders import CompletionFinder
from rich.console import Console
from rich.table import Table

from mapweave import HybridMap, MapFile, MapId, terminal, write_map_file
from mapweave.agent.drivers.settings import RobotSettings
from mapweave.cheat_sheet import as_markdown
from mapweave.cli import main, parser
from mapweave.commands.completion import SHELLS
from mapweave.commands.examples import EXAMPLES
from mapweave.exit_status import FAILED, USAGE
from mapweave.storage.os_errors import NO_ROOM
from mapweave.terminal import EVERY, PLAIN_WIDTH, Bar, EventLog, plain_or_terminal, tracked
from synthetic.maps import looked_around, write_store
from tests.mapweave.command_line import parsers
from tests.programs import mapweave, python, ran
from tests.waiting import eventually

STAMP = r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d "


@pytest.mark.parametrize("words", parsers())
def test_every_command_says_what_it_does_with_examples_that_parse(words: str):
    command = parsers()[words]
    assert command.description and command.description.rstrip().endswith("."), "a sentence"
    assert command.epilog and "example" in command.epilog, "add one to mapweave/commands/examples.py"
    for example in EXAMPLES[words]:
        assert f"\n  {example}" in command.format_help(), "it stands there as a line of its own"
        program, *arguments = shlex.split(re.split(" >>? ", example)[0])
        parsed = parser().parse_args(arguments)
        assert program == "mapweave" and parsed.command.startswith(f"mapweave {words}")
        for option in {"-o", "--out"} & {*arguments}:
            out = Path(arguments[arguments.index(option) + 1])
            assert out.parent == Path(), "where it is pasted there is no folder of that name"
        if words in ("agent", "record") and (driver := parsed.robot):
            assert driver == RobotSettings().driver or parsed.settings, "its port stands in a settings file"


@pytest.mark.parametrize("words", parsers())
def test_every_argument_has_its_help_and_every_default_is_named(words: str):
    for action in parsers()[words]._actions:
        if isinstance(action, argparse._SubParsersAction):
            continue
        assert action.help, action.dest
        if action.option_strings and action.nargs != 0 and action.default not in (None, "", []):
            _, _, named = (action.help % vars(action)).rpartition("default: ")
            default = "here" if action.default == Path() else str(action.default).removesuffix(".0")
            assert default in named, action.option_strings


def test_no_example_is_of_a_command_that_is_gone():
    assert set(EXAMPLES) == set(parsers())


def test_the_cheat_sheet_is_that_of_these_commands():
    page = Path("docs/cheat-sheet.md")
    assert page.read_text(encoding="utf-8") == as_markdown(), f"python -m mapweave.cheat_sheet > {page}"


@pytest.fixture
def shell_folder(tmp_path: Path) -> Path:
    """A folder with the program in `bin`, and a driver of one's own."""
    program = tmp_path / "bin" / "mapweave"
    program.parent.mkdir()
    root = Path(__file__).parents[2]
    program.write_text(f'#!/bin/sh\nPYTHONPATH={root} exec {sys.executable} -m mapweave "$@"\n')
    program.chmod(0o755)
    (tmp_path / "my_rover.py").touch()
    (tmp_path / "notes.txt").touch()
    return tmp_path


COMPLETED = [
    ("mapweave map sh", "mapweave map show "),
    ("mapweave agent r0 --mission ca", "mapweave agent r0 --mission carried "),
    ("mapweave agent r0 --robot koa", "mapweave agent r0 --robot koala "),
    ("mapweave doctor --robot my", "mapweave doctor --robot my_rover.py "),
    ("mapweave sim run wareh", "mapweave sim run warehouse "),
]
"""What is typed before Tab, and what stands there after it."""
SHELL_COMMANDS = {
    "bash": (["--norc", "-i"], "PS1=; mapweave completion bash >> rc; source ./rc"),
    "zsh": (
        ["-f", "-i"],
        "PS1=; unsetopt zle_bracketed_paste; autoload -U compinit; compinit -u -D; "
        "mapweave completion zsh >> rc; source ./rc",
    ),
}
"""How a shell is started without a person's own files, and what a person has in these."""


@pytest.mark.parametrize("shell", [*SHELL_COMMANDS])
def test_a_shell_completes_what_is_typed(shell: str, shell_folder: Path):
    """At a terminal, which asks the program itself."""
    program = shutil.which(shell)
    if program is None:
        pytest.skip(f"{shell} is not installed")
    arguments, setup = SHELL_COMMANDS[shell]
    variables = {
        "PATH": f"{shell_folder / 'bin'}:{os.environ['PATH']}", "TERM": "dumb", "HOME": str(shell_folder)
    }  # fmt: skip
    with Typed([program, *arguments], shell_folder, os.environ | variables) as typed:
        typed.write(f"{setup}; echo rea''dy\n")
        typed.until("ready\r\n")
        for before, after in COMPLETED:
            typed.write(f"{before}\t")
            typed.until(after)
            typed.write("\x15")  # the line is removed
            typed.write("echo ne''xt\n")
            typed.until("next\r\n")


class Typed:
    """A program at a terminal, typed at. A context manager, which ends it."""

    def __init__(self, command: Sequence[str], folder: Path, environment: Mapping[str, str]) -> None:
        """Start it."""
        self._ours, theirs = pty.openpty()
        self._program = subprocess.Popen(
            command, stdin=theirs, stdout=theirs, stderr=theirs, cwd=folder, env=environment,
            start_new_session=True,
        )  # fmt: skip
        os.close(theirs)

    def __enter__(self) -> Typed:
        """Nothing more to do."""
        return self

    def __exit__(self, *_: object) -> None:
        """End it."""
        self._program.kill()
        self._program.wait()
        os.close(self._ours)

    def write(self, keys: str) -> None:
        """Type."""
        os.write(self._ours, keys.encode())

    def until(self, words: str) -> None:
        """Read until it shows this; without colours and moves of the cursor."""
        shown, end = "", time.monotonic() + 30.0
        while words not in shown:
            assert time.monotonic() < end, f"{words!r} is not in {shown!r}"
            if select.select([self._ours], [], [], 0.1)[0]:
                shown = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", shown + os.read(self._ours, 65536).decode())


def completed(*words: str) -> set[str]:
    """What is offered for the last word; a parser that has completed once is spent."""
    finder = CompletionFinder(parser.__wrapped__(), always_complete_options=True)
    return {word.strip() for word in finder._get_completions(["mapweave", *words[:-1]], words[-1], "", None)}


@pytest.mark.parametrize("words", ["", *parsers()])
def test_all_of_every_command_is_completed(words: str):
    """As its help names it: options, commands below it, and what may stand behind an option."""
    command = parsers()[words] if words else parser()
    shown = [action for action in command._actions if action.help != argparse.SUPPRESS]
    options = {option for action in shown for option in action.option_strings}
    assert completed(*words.split(), "-") == options >= {"-h", "--help"}
    for action in shown:
        if action.choices is not None:
            choices = {str(choice) for choice in action.choices}
            offered = completed(*words.split(), *action.option_strings[-1:], "")
            assert offered - options == choices, action.dest


@pytest.mark.parametrize("shell", SHELLS)
def test_the_code_for_completion_is_that_shells(shell: str, capfd):
    assert main(["completion", shell]) == 0
    code = capfd.readouterr().out
    assert "mapweave" in code
    if shutil.which(shell):
        checked = ran(shell, "-n", input=code)
        assert checked.returncode == 0, checked.stderr


def test_an_agents_log_in_a_file_has_one_line_an_event_with_the_time(recording: Path, tmp_path, capfd):
    long = tmp_path / ("a folder with a name that is longer than a terminal is wide " * 2).strip()
    arguments = ["replay", recording, "--offline", "--data", long, "--epoch", 1]
    assert main([str(a) for a in arguments]) == 0
    lines = capfd.readouterr().err.splitlines()
    (written,) = [line for line in lines if f" in {long / 'walk.1.mapweave'}; " in line]
    assert re.match(STAMP + "walk: ", written)
    assert all(re.match(STAMP + "walk: ", line) for line in lines), lines


def plain() -> tuple[Console, io.StringIO]:
    file = io.StringIO()
    return Console(file=file, width=PLAIN_WIDTH), file


def test_an_event_is_one_line_whatever_is_in_it():
    console, file = plain()
    EventLog(console)("give [robot.options] a port,\nfor example [bold]" + 30 * " /dev/ttyUSB0")
    line = file.getvalue()
    assert line.count("\n") == 1
    assert re.match(STAMP + r"give \[robot.options\] a port, for example \[bold\] /dev", line)


def test_progress_is_a_plain_line_now_and_then_where_there_is_no_terminal():
    console, file = plain()
    now = [0.0]
    with Bar(console, "frames", 1000, clock=lambda: now[0]) as bar:
        for _ in range(1000):
            now[0] += 1 / 32
            bar.advance(1, "[3] nodes")
    assert file.getvalue().splitlines() == [
        f"frames: {k} of 1000, [3] nodes" for k in (*(round(32 * EVERY * n) for n in (1, 2, 3)), 1000)
    ]
    console, file = plain()
    assert list(tracked([], "frames", console=console)) == [] and file.getvalue() == ""


@pytest.mark.parametrize("words", ["/cam[/b]/image_raw", "[link=file:///etc/passwd]press[/]", "[red]bad"])
def test_words_in_brackets_are_no_markup(words: str, capfd):
    """Topics of bags, names of folders and words of robots ended a command, or were links."""
    table = Table("", title=words)
    table.add_row(words)
    console = plain_or_terminal(stderr=False)
    console.print(table)
    console.print(words)
    assert capfd.readouterr().out.count(words) == 3


def test_progress_goes_on_while_one_step_takes_long(monkeypatch):
    """Of a store of 484 nodes `map diff` said nothing for a minute: joining its maps is one step."""
    monkeypatch.setattr(terminal, "EVERY", 0.05)
    (console, file), before = plain(), threading.active_count()
    with Bar(console, "reading nodes", None) as bar:
        bar.update(484, "comparing and joining", 484)
        eventually(lambda: file.getvalue().count("\n") >= 2)
    *waited, last = file.getvalue().splitlines()
    assert last == "reading nodes: 484 of 484, comparing and joining"
    assert all(re.fullmatch(re.escape(last) + r", \d+ s", line) for line in waited)
    assert threading.active_count() == before


def test_what_has_no_steps_is_not_counted(monkeypatch):
    """Of a map that a server packs nothing is known but that it takes long."""
    monkeypatch.setattr(terminal, "EVERY", 0.05)
    console, file = plain()
    with Bar(console, "fetching the map", None):
        eventually(lambda: file.getvalue().count("\n") >= 2)
    assert all(re.fullmatch(r"fetching the map, \d+ s", line) for line in file.getvalue().splitlines())


def test_a_long_detail_leaves_the_numbers_of_a_bar():
    """On 80 columns they were cut away: `d… 11 nodes, 51 of 53 features left ...`."""
    file = io.StringIO()
    with Bar(Console(file=file, force_terminal=True, width=80, color_system=None), "drive", 1475) as bar:
        bar.update(324, "11 nodes, 51 of 53 features left after 0.6 m; 36 landmarks in view are too few")
    last = file.getvalue().split("\r")[-1]
    assert "drive " in last and " 324/1475 " in last and "11 nodes, 51 of 53" in last and "…" in last


@pytest.mark.parametrize("words", ["agent r0", "router", "server", "sim serve office"])
def test_warnings_of_any_part_have_the_time(words: str, monkeypatch):
    """`a tick took 459 ms instead of 100` stood without it among lines that have it."""

    class Asked(Exception):
        pass

    def asked(handlers: list[logging.Handler]) -> None:
        raise Asked(handlers[0].format(logging.makeLogRecord({"msg": "a tick took 459 ms"})))

    monkeypatch.setattr("logging.basicConfig", asked)
    with pytest.raises(Asked, match=f"^{STAMP}.*a tick took 459 ms$"):
        main(words.split())


def test_an_option_that_is_none_names_the_help_of_its_command(capfd):
    with pytest.raises(SystemExit) as ended:
        main(["map", "show", "office.mapweave", "--colour"])
    assert ended.value.code == USAGE
    complaint = capfd.readouterr().err
    assert (
        complaint == "mapweave map show: unrecognized arguments: --colour; see `mapweave map show --help`\n"
    )


@pytest.mark.parametrize("line", ["map show -r0.mapweave", "map merge a.mapweave -o -r0.mapweave"])
def test_a_file_whose_name_begins_with_a_dash_is_named(line: str, tmp_path, monkeypatch, capfd):
    """It was said that no file is given."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "-r0.mapweave").touch()
    with pytest.raises(SystemExit) as ended:
        main(line.split())
    assert ended.value.code == USAGE
    said = capfd.readouterr().err
    assert said.endswith("; write ./-r0.mapweave: -r0.mapweave is taken for options\n"), said
    assert said.count("\n") == 1


@pytest.mark.parametrize(("arguments", "words"), [
    ("map import {graph} -o {tmp}/optimum.g2o", "optimising 1 edge"),
    ("map from-photos {tmp}/walk/images --camera {tmp}/walk/camera.toml --spacing 1 -o {tmp}/p.mapweave",
     "reading photographs"),
    ("map extract {store} -o {tmp}/maps", "reading the map"),
    ("map show {store} --no-picture", "reading nodes"),
    ("place add sink r0.1.1 --map {store} -o {tmp}/a.mapweave", "reading nodes"),
    ("plan show --map {store}", "reading nodes"),
    ("relocalize {tmp}/walk/images/0.png --map {store}", "looking for the place"),
    ("info {tmp}/walk", "reading the recording"),
    ("replay {tmp}/walk --offline --data {tmp}/replayed", "finding where the images were taken"),
])  # fmt: skip
def test_work_that_may_take_long_is_shown(arguments: str, words: str, recording: Path, tmp_path, monkeypatch):
    """With thousands of nodes, vertices or images each is silent for longer than a person waits."""
    graph = tmp_path / "in.g2o"
    graph.write_text("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n")
    store = write_store(tmp_path / "s0.sqlite", looked_around((MapId("r0", 1), MapId("r1", 1)), seed=8))
    if arguments.startswith("replay"):
        (recording / "odometry.csv").unlink()
    shown: list[str] = []
    enter = Bar.__enter__
    monkeypatch.setattr(Bar, "__enter__", lambda bar: (shown.append(bar._words), enter(bar))[1])
    main(arguments.format(graph=graph, store=store, tmp=tmp_path).split())
    assert words in shown


@pytest.mark.parametrize("module", ["mapweave.cli", "argcomplete"])
def test_ctrl_c_while_the_command_line_is_read_is_one_line(module: str):
    """While it is imported, and while its parser is made."""
    program = """
import os
import sys

os.environ["_ARGCOMPLETE"] = "1"

class Interrupted:
    def find_spec(self, name, path=None, target=None):
        if name == sys.argv[1]:
            raise KeyboardInterrupt

sys.meta_path.insert(0, Interrupted())
from mapweave.start import main
sys.exit(main())
"""
    done = python("-c", program, module)
    assert (done.stderr, done.returncode) == ("mapweave: interrupted\n", 130)


BUFFERED = {"PYTHONUNBUFFERED": "", "PYTHONIOENCODING": "utf-8"}
"""As most people run commands."""


def started(*arguments: object, **options: Any) -> subprocess.CompletedProcess[Any]:
    """`mapweave` in a process of its own, with options of `subprocess.run`."""
    environment = os.environ | BUFFERED | options.pop("env", {})
    return subprocess.run(
        [sys.executable, "-m", "mapweave", *map(str, arguments)],
        env=environment, timeout=60, check=False, **{"stderr": subprocess.PIPE} | options,
    )  # fmt: skip


@pytest.mark.parametrize("arguments", ["--version", "--help", "completion zsh", "sim list --json"])
def test_a_reader_that_ends_first_is_no_error_of_pythons_own(arguments: str):
    """As in `mapweave ... | head -1`."""
    reading, writing = os.pipe()
    os.close(reading)
    try:
        done = started(*arguments.split(), stdout=writing)
    finally:
        os.close(writing)
    assert (done.stderr, done.returncode) == (b"", FAILED)


def test_what_a_replay_says_first_comes_first_into_a_pipe_as_well(recording: Path, tmp_path):
    """As in `mapweave replay ... 2>&1 | cat`: what it takes from the recording, then what the agent says."""
    (recording / "times.txt").unlink()
    out = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    done = started("replay", recording, "--offline", "--data", tmp_path / "maps", **out)
    first, *others = done.stdout.decode().splitlines()
    assert done.returncode == 0 and "no times.txt" in first, done.stdout
    assert others and all(re.match(STAMP + "walk: ", line) for line in others), others


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux has it")
@pytest.mark.parametrize("arguments", ["--version", "completion zsh", "sim list --json"])
def test_a_full_disk_behind_stdout_is_one_line(arguments: str):
    with Path("/dev/full").open("wb") as full:
        done = started(*arguments.split(), stdout=full)
    words = f"mapweave: standard output cannot be written ({NO_ROOM})\n"
    assert (done.stderr.decode(), done.returncode) == (words, FAILED)


def test_a_command_whose_stdout_is_closed_does_its_work():
    """As the shell's `>&-` does."""
    done = started("sim", "list", preexec_fn=lambda: os.close(1))
    assert (done.stderr, done.returncode) == (b"", 0)


@pytest.mark.parametrize(("name", "encoding", "printed"), [
    (b"B\xfcro.mapweave", "utf-8", r"B\udcfcro.mapweave"),
    ("Büro.mapweave".encode(), "ascii", r"B\xfcro.mapweave"),
    ("Büro.mapweave".encode(), "utf-8", "Büro.mapweave"),
    ("Büro.mapweave".encode(), "ascii:surrogateescape", r"B\xfcro.mapweave"),  # as of the locale C
])  # fmt: skip
def test_a_name_that_the_locale_cannot_show_is_shown_by_its_codes(
    name: bytes, encoding: str, printed: str, tmp_path
):
    path = tmp_path / os.fsdecode(name)
    write_map_file(path, MapFile("merged", "nothing", ()))
    encoding, _, errors = encoding.partition(":")
    codec = {"PYTHONIOENCODING": f"{encoding}:{errors or 'strict'}", "PYTHONUTF8": "1"}
    done = started("map", "show", path, "--no-picture", env=codec, stdout=subprocess.PIPE)
    assert (done.stderr, done.returncode) == (b"", 0)
    assert printed in done.stdout.decode(encoding)


@pytest.mark.slow
def test_a_home_that_cannot_be_written_is_no_matter(tmp_path):
    """As that of a service: two lines of Matplotlib about its cache came before what was asked for."""
    path = tmp_path / "r0.1.mapweave"
    (log,) = looked_around((MapId("r0", 1),), seed=8).values()
    write_map_file(path, MapFile("agent", "r0.1", tuple(HybridMap(log).contents())))
    # Not even root can make a folder there.
    home = dict.fromkeys(("HOME", "XDG_CONFIG_HOME", "XDG_CACHE_HOME", "MPLCONFIGDIR"), "/proc/none")
    shown = mapweave("map", "show", path, "-o", tmp_path / "a.png", env=os.environ | home)
    assert (shown.returncode, shown.stderr) == (0, "")
    assert (tmp_path / "a.png").exists()

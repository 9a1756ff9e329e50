"""An installation without extras: each command works, or names in one line the extra that it needs."""

import json
import os
import re
import shlex
import sys
import tomllib
from collections.abc import Iterable
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

from mapweave import HybridMap, MapFile, MapId, write_map_file
from mapweave.cli import main
from mapweave.exit_status import FAILED, MISSING_EXTRA, NO, USAGE
from mapweave.extras import MODULES
from mapweave.hybridmap.manual_constraint import ManualConstraints
from mapweave.mapserver.map_files import map_file_of
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.offline_merge import merge_parts
from synthetic.maps import looked_around
from tests.mapweave.command_line import commands
from tests.programs import python, ran
from tests.simulator import needs_simulator

ROOT = Path(__file__).parents[2]

TRIAL = 'needs the extras "server", "sim", "eval" and "viz"'
SIM, SERVER, VIZ = 'needs the extra "sim"', 'needs the extra "server"', 'needs the extra "viz"'
WITHOUT_SERVER = "no router at"
"""What is said where a running server would have to be asked: nothing is missing to do so."""

ENDS = {
    "R0": USAGE, "endpoints look like": USAGE, "no camera gives an image": NO, "no view shows the target": NO,
    "too short": NO, "there is no closure kitchen": NO,
}  # fmt: skip
"""Exit statuses of commands that fail otherwise than by failing to reach or to read something."""

CASES: list[tuple[str, str, str]] = [
    # command, its arguments, what it says without extras
    ("demo", "--out {tmp}", TRIAL),
    ("sim list", "", "warehouse"),
    ("sim run", "office --out {tmp}", TRIAL),
    ("sim batch", "office --out {tmp}", TRIAL),
    ("sim serve", "office --connect {closed}", SIM),
    ("server", "--listen {closed} --data {tmp}", SERVER),
    ("agent", "R0 --connect {closed}", "R0"),  # a name that cannot be: else it waits for its robot
    ("status", "--connect nowhere", "endpoints look like"),
    ("go", "R0 r0.1.1 --connect {closed}", "R0"),
    ("explore", "R0 --connect {closed}", "R0"),
    ("stop", "R0 --connect {closed}", "R0"),
    ("drive", "R0 --connect {closed}", "R0"),
    ("keys init", "--keys {tmp}/keys", SERVER),
    ("keys init", "--keys {tmp}/lab --profile lab", "robots find the server at"),
    ("keys add", "r0 --keys {tmp}/lab", "copy this file"),
    ("keys token", "r0 --keys {tmp}/lab", "token"),
    ("keys list", "--keys {tmp}/lab", "robot"),
    ("keys bundle", "r0 --keys {tmp}/lab -o {tmp}/r0.key.toml", "the key of r0"),
    ("keys revoke", "r0 --keys {tmp}/lab", "admitted no more"),
    ("robots", "", "koala"),
    ("doctor", "--offline --data {tmp}", "nothing is wrong"),
    ("find-port", "--list", "tty"),
    ("find-cameras", "{tmp}/none.avi", "no camera gives an image"),
    ("router", "--listen nowhere", "endpoints look like"),
    ("record", "R0 --out {tmp}/drive --connect {closed}", "R0"),
    ("replay", "{recording} --offline --data {tmp} --name walk", "0 nodes"),
    ("replay", "{recording} --offline --data {tmp} --rerun {tmp}/walk.rrd", 'needs the extra "rerun"'),
    ("agent", "r0 --connect {closed} --data {tmp}/agents --metrics 9101", 'needs the extra "metrics"'),
    ("info", "{recording}", "3 images"),
    ("calibrate target", "--out {tmp}/board.pdf", "Print it at 100 %"),
    ("calibrate camera", "{recording}", "no view shows the target"),
    ("calibrate camera", "--source {tmp}/none.avi --http 0", SERVER),
    ("calibrate drive", "{recording}", "too short"),
    ("settings", "", "[network]"),
    ("completion", "bash", "mapweave"),
    ("missions", "R0 --connect {closed}", "R0"),
    ("relocalize", "{recording}/images/0.png --connect {closed}", WITHOUT_SERVER),
    ("eval relocalize", "{recording}", SERVER),
    ("eval replay", "{recording} --out {tmp}/replay", "frames"),
    ("eval merge", "{recording}", 'needs the extras "server" and "viz"'),
    ("open", "{own}", SERVER),
    ("place list", "--map {merged}", "no place has a name yet"),
    ("place add", "kitchen r0.1.1 --map {merged} --out {tmp}/named.mapweave", SERVER),
    ("place remove", "kitchen --connect {closed}", WITHOUT_SERVER),
    ("close", "r0.1.1 r0.1.3 --connect {closed}", WITHOUT_SERVER),
    ("reopen", "kitchen --map {merged}", "there is no closure kitchen"),
    ("prefer", "r0.1.1 r0.1.3 --connect {closed}", WITHOUT_SERVER),
    ("avoid", "r0.1.1 r0.1.3 --connect {closed}", WITHOUT_SERVER),
    ("closures", "--map {merged}", "nothing is closed"),
    ("floor", "ground r0.1.1 --connect {closed}", WITHOUT_SERVER),
    ("map backup", "{tmp}/none.sqlite --out {tmp}/copy.sqlite", "no such file"),
    ("map show", "{own}", "nodes"),
    ("map show", "{own}", VIZ),  # the picture is left out, and that is said
    ("map show", "{own} --out {tmp}/own.png", VIZ),
    ("map diff", "{own} {own}", SERVER),
    ("map fetch", "{tmp}/none/map.mapweave --connect {closed}", "there is no folder"),
    ("map explain", "--connect {closed}", WITHOUT_SERVER),
    ("map explain", "r0.1.1 r1.1.1 --connect {closed}", WITHOUT_SERVER),
    ("map explain", "--map {merged}", SERVER),
    ("map explain", "{link} --map {merged} --draw {tmp}/link.png", VIZ),
    ("map route", "r0.1.1 r0.1.3 --connect {closed}", WITHOUT_SERVER),
    ("map route", "r0.1.1 r0.1.3 --map {merged}", SERVER),
    ("map route", "r0.1.1 r0.1.3 --map {merged} --draw {tmp}/way.png", VIZ),
    ("map history", "--connect {closed}", WITHOUT_SERVER),
    ("map history", "--map {merged}", "no joins"),
    ("map unmerge", "r0.1 r1.1 --connect {closed}", WITHOUT_SERVER),
    ("map unmerge", "r0.1 r1.1 --map {merged} --out {tmp}/apart.mapweave", SERVER),
    ("map link", "{link} --connect {closed}", WITHOUT_SERVER),
    ("map link", "{link} --map {merged} --check", SERVER),
    ("map undo", "--connect {closed}", WITHOUT_SERVER),
    ("map undo", "--map {merged}", "no manual constraint"),
    ("map retire", "r0.1 --connect {closed}", WITHOUT_SERVER),
    ("map retire", "r0.1 --map {merged} --out {tmp}/less.mapweave", SERVER),
    ("map portal add", "lift r0.1.1 r1.1.1 --kind lift --connect {closed}", WITHOUT_SERVER),
    ("map portal list", "--connect {closed}", WITHOUT_SERVER),
    ("map portal list", "--map {merged}", "there is no portal yet"),
    ("map portal remove", "lift --connect {closed}", WITHOUT_SERVER),
    ("portal done", "r0 --connect {closed}", WITHOUT_SERVER),
    ("map pin", "--connect {closed}", WITHOUT_SERVER),
    ("plan add", "{tmp}/none.png --pair r0.1.1=1,2 --connect {closed}", "No such file"),
    ("plan show", "--connect {closed}", WITHOUT_SERVER),
    ("plan export", "office --format tf --connect {closed}", WITHOUT_SERVER),
    ("plan remove", "office --connect {closed}", WITHOUT_SERVER),
    ("map merge", "{own} -o {tmp}/out.mapweave", SERVER),
    ("map extract", "{tmp}/none.sqlite -o {tmp}/maps", "no such file"),
    ("map from-photos", "{recording} --spacing 0.5 -o {tmp}/photos.mapweave", SERVER),
    ("map export", "{merged} --format g2o -o {tmp}/out.g2o", SERVER),
    ("map import", "{tmp}/out.g2o -o {tmp}/optimum.g2o", SERVER),
]


@pytest.fixture(scope="module")
def merged() -> MergedMap:
    """Two robots in one room."""
    logs = looked_around((MapId("r0", 1), MapId("r1", 1)), seed=8)
    return merge_parts({name: HybridMap(log) for name, log in logs.items()}, ManualConstraints())


@pytest.fixture
def filled(merged: MergedMap, recording: Path, closed: str, tmp_path: Path) -> dict[str, object]:
    """The values of the braces in CASES."""
    own, whole = tmp_path / "own.mapweave", tmp_path / "merged.mapweave"
    write_map_file(own, MapFile("agent", "r0.1", tuple(merged.maps[MapId("r0", 1)].contents())))
    write_map_file(whole, map_file_of(merged))
    link = next(link for link in merged.links if not link.within)
    return {
        "tmp": tmp_path, "closed": closed, "recording": recording, "own": own, "merged": whole,
        "link": f"{link.a} {link.b}",
    }  # fmt: skip


Outcome = tuple[int | None, str, str]


ACTIVATED = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
"""The search path of a shell that has activated this environment."""


def outcomes(without: Iterable[str], lines: Iterable[str], path: str = ACTIVATED) -> list[Outcome]:
    """What becomes of commands in a process that lacks the libraries that some extras alone bring.

    Args:
        without: the extras.
        lines: commands with their arguments.
        path: where the process looks for programs.
    """
    without = set(without)
    there = {module for extra in MODULES.keys() - without for module in MODULES[extra]}
    missing = sorted({module for extra in without for module in MODULES[extra]} - there)
    done = python(
        "-m", "tests.mapweave.without_libraries", *missing, check=True, cwd=ROOT, timeout=120,
        input=json.dumps([line.split() for line in lines]), env=os.environ | {"PATH": path},
    )  # fmt: skip
    return [(status, out, err) for status, out, err in json.loads(done.stdout)]


def test_every_command_is_tried():
    assert {command for command, _, _ in CASES} == set(commands(runnable=True))


@pytest.mark.slow
def test_without_extras_a_command_works_or_names_what_it_needs(filled: dict[str, object]):
    lines = [f"{command} {arguments}".format(**filled) for command, arguments, _ in CASES]
    for (command, arguments, words), (status, out, err) in zip(CASES, outcomes(MODULES, lines), strict=True):
        what = f"{command} {arguments}: {status}\n{out}{err}"
        assert words in out + err, what
        assert "Traceback" not in err, what
        if status != 0:
            assert status in (ENDS.get(words, FAILED), MISSING_EXTRA), what
            assert not out and len(err.splitlines()) == 1, what
        if words.startswith("needs") and status != 0:
            extras = ",".join(extra for extra in MODULES if f'"{extra}"' in words)
            assert err == f"mapweave {command} {words}: pip install 'mapweave[{extras}]'\n", what
            assert status == MISSING_EXTRA, what


@pytest.mark.slow
def test_each_extra_is_enough_for_its_commands(filled: dict[str, object]):
    """With the server's libraries alone every command works that asks for no more."""
    lines = [f"{command} {arguments}".format(**filled) for command, arguments, words in CASES
             if words == SERVER and "map" in command
             and command not in ("map from-photos", "map link")]  # fmt: skip
    others = [extra for extra in MODULES if extra != "server"]
    for line, (status, out, err) in zip(lines, outcomes(others, lines), strict=True):
        assert status == 0 and out and not err, f"{line}: {status}\n{out}{err}"


@needs_simulator
def test_a_trial_names_only_what_is_missing(tmp_path):
    """Before it starts: figures and pictures are made at its end."""
    (outcome,) = outcomes(["eval", "viz"], [f"sim run office --out {tmp_path}"])
    words = 'mapweave sim run needs the extras "eval" and "viz": pip install \'mapweave[eval,viz]\'\n'
    assert outcome == (MISSING_EXTRA, "", words)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("path", ["", "other"])
def test_the_pip_that_is_named_is_that_of_this_environment(tmp_path, path: str):
    """Where the environment is not activated: there is no `pip`, or another one."""
    other = tmp_path / "other" / "pip"
    other.parent.mkdir()
    other.write_text("#!/bin/sh\nexit 1\n")
    other.chmod(0o755)
    (outcome,) = outcomes(["server"], ["server"], str(tmp_path / path))
    said = outcome[2].removeprefix('mapweave server needs the extra "server": ').rstrip("\n")
    program, *words = shlex.split(said)
    assert words == ["-m", "pip", "install", "mapweave[server]"]
    where = ran(program, "-c", "import pip; print(pip.__file__)", check=True)
    assert Path(sys.prefix).resolve() in Path(where.stdout.strip()).resolve().parents


def test_a_map_that_is_not_there_is_the_only_complaint(tmp_path):
    """That a picture would need an extra is no matter then."""
    missing = tmp_path / "office.mapweave"
    (outcome,) = outcomes(["viz"], [f"map show {missing}"])
    assert outcome == (1, "", f"mapweave: {missing}: no such file\n")


def test_the_extras_are_those_of_the_package():
    package = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    installed = packages_distributions()
    for extra, modules in MODULES.items():
        # `gym` has `sim` among its requirements.
        named = {re.split(r"[\[>]", requirement)[0] for requirement in package[extra]} - {"mapweave"}
        present = [module for module in modules if module in installed]
        assert {installed[module][0] for module in present} <= named, extra
        assert len(named) == len(modules), extra


HELP = """
import contextlib, io, json, sys
before = {name.split(".")[0] for name in sys.modules}
from mapweave.cli import main
for words in json.load(sys.stdin):
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        try:
            main(words)
        except SystemExit:
            pass
print(*({name.split(".")[0] for name in sys.modules} - before - sys.stdlib_module_names))
"""


def test_help_wrong_use_and_version_import_no_library():
    """All that takes time to import is left until a command runs."""
    asked = [[*command.split(), "--help"] for command in commands()]
    wrong = [[*command.split(), "--no-such-option"] for command in commands()]
    lines = json.dumps([[], ["--help"], ["--version"], ["fly"], *asked, *wrong])
    assert set(python("-c", HELP, input=lines, check=True, cwd=ROOT).stdout.split()) == {"mapweave"}


ASK = """
import sys
from tests.mapweave.without_libraries import Without
sys.meta_path[:] = [Without(finder, frozenset(sys.argv[2:])) for finder in sys.meta_path]
import numpy as np
import mapweave
camera, image = mapweave.Camera(320, 240, 277.0, 277.0, 159.5, 119.5, 0.3), np.zeros((240, 320), np.uint8)
print(len(mapweave.view_of(image, camera).pixels))
try:
    mapweave.open(sys.argv[1]).relocalize(image, camera)
except mapweave.MapweaveError as error:
    print(error)
"""


def test_python_asks_a_fleet_without_extras_and_a_file_names_the_one_that_it_needs(filled: dict[str, object]):
    """Both ended with: No module named 'faiss'."""
    done = python("-c", ASK, filled["merged"], *MODULES["server"], check=True, cwd=ROOT)
    view, file = done.stdout.splitlines()
    assert view == "0" and file.startswith('needs the extra "server": ')


def test_the_version_is_that_of_the_package(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"mapweave {project['version']}\n"

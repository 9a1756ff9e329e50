"""Every benchmark says in one line what is wrong with its arguments, before it computes anything."""

import importlib
import re
from pathlib import Path

import pytest

import benchmarks

FOLDER = Path(benchmarks.__file__).parent
NAMES = sorted(path.parent.name for path in FOLDER.glob("*/benchmark.py"))
SEEDED = [
    name
    for name in NAMES
    if re.search(r'command_line\(|add_argument\("--seed"', (FOLDER / name / "benchmark.py").read_text())
]
"""Those that people start, with a seed."""
WRONG = [
    *((name, "--seed -1", "seed") for name in SEEDED),
    ("ekf", "--runs 0", "--runs"),
    ("explore", "--robots 0", "--robots"),
    ("fit_belief", "--seeds -1", "seeds"),
    ("fit_belief", "--queries 0 0", "queries"),
    ("landmarks", "--pairs 1", "--pairs: 1: give at least 2"),
    ("landmarks", "--places -1", "--places: -1: give at least 0"),
    ("landmarks", "--pairs x", "--pairs"),
    ("fuzz", "--seconds 0", "seconds above 0"),
    ("mapping_run", "--out {file}", "name a folder that can be written"),
    ("mapping_run", "--out {file}/below", "name a folder that can be written"),
    ("mapping_run", "--steps 3", "at least 30"),
    ("navigate", "--runs 0", "--runs: 0: give at least 1"),
    ("parking", "--starts 0", "at least 1"),
    ("parking", "--out {file}/x", "parking: [Errno 20] Not a directory"),
    ("servo", "--trials 0", "--trials"),
    ("servo", "--jobs 0", "--jobs"),
    ("relocalize", "--nodes 300", "--nodes: 300: give at least 1000"),
    ("trust", "--lying 0", "--lying must be longer than 0 s"),
]


@pytest.mark.parametrize(("name", "wrong", "words"), WRONG, ids=lambda case: case if "-" in case else None)
def test_errors_are_reported_in_one_line(name: str, wrong: str, words: str, monkeypatch, capsys, tmp_path):
    file = tmp_path / "file"
    file.write_text("not a folder")
    module = importlib.import_module(f"benchmarks.{name}.benchmark")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", [name, *wrong.format(file=file).split()])
    with pytest.raises(SystemExit) as ended:
        module.main()
    output = capsys.readouterr().err + (ended.value.code if isinstance(ended.value.code, str) else "")
    assert ended.value.code not in (0, None)
    assert "Traceback" not in output
    assert words in output.splitlines()[-1]
    assert file.read_text() == "not a folder"
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [file], "nothing is left behind"


@pytest.mark.parametrize("name", NAMES)
def test_python_starts_it_by_the_name_of_its_folder(name: str):
    """`python -m benchmarks.NAME` runs the package's `__main__`."""
    started = importlib.import_module(f"benchmarks.{name}.__main__")
    assert started.main is importlib.import_module(f"benchmarks.{name}.benchmark").main


def test_the_benchmarks_are_found():
    assert {"parking", "navigate", "servo", "ekf", "relocalize", "merge"} <= set(SEEDED)

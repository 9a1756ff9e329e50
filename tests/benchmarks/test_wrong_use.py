"""Every benchmark says in one line what is wrong with its arguments, before it computes anything."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

import benchmarks

FOLDER = Path(benchmarks.__file__).parent
NAMES = sorted(path.parent.name for path in FOLDER.glob("*/benchmark.py"))
SEEDED = [name for name in NAMES if 'add_argument("--seed"' in (FOLDER / name / "benchmark.py").read_text()]
"""Those that people start, with a seed."""
WRONG = [
    *((name, ["--seed", "-1"]) for name in SEEDED),
    ("ekf", ["--runs", "0"]),
    ("explore", ["--robots", "0"]),
    ("fit_belief", ["--seeds", "-1"]),
    ("fit_belief", ["--queries", "0", "0"]),
    ("servo", ["--trials", "0"]),
    ("servo", ["--jobs", "0"]),
    ("sim", ["--robots", "0"]),
    ("sim", ["--robots", "3", "17"]),
    ("sim", ["--seconds", "0"]),
    ("sim", ["--seconds", "nan"]),
]


@pytest.mark.parametrize(("name", "wrong"), WRONG, ids=lambda case: "".join(case))
def test_errors_are_reported_in_one_line(
    name: str,
    wrong: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    module = importlib.import_module(f"benchmarks.{name}.benchmark")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", [name, *wrong])
    with pytest.raises(SystemExit) as ended:
        module.main()
    output = capsys.readouterr().err + (ended.value.code if isinstance(ended.value.code, str) else "")
    assert ended.value.code not in (0, None)
    assert "Traceback" not in output
    assert "seed" in output.splitlines()[-1] or wrong[0].strip("-") in output.splitlines()[-1]
    assert not any(tmp_path.rglob("*.*")), "nothing is left behind"


@pytest.mark.parametrize("name", NAMES)
def test_python_starts_it_by_the_name_of_its_folder(name: str) -> None:
    """`python -m benchmarks.NAME` runs the package's `__main__`."""
    started = importlib.import_module(f"benchmarks.{name}.__main__")
    assert started.main is importlib.import_module(f"benchmarks.{name}.benchmark").main


def test_the_benchmarks_are_found() -> None:
    assert {"parking", "navigate", "servo", "ekf", "relocalize", "merge", "sim"} <= set(SEEDED)

"""docs/figures.md, docs/scale.md and README.md's table are what their generator makes of stored results."""

import inspect
import json
import re
from pathlib import Path

import pytest

from benchmarks.figures.benchmark import README, written_pages
from benchmarks.figures.measurements import MEASUREMENTS
from benchmarks.figures.page import filled, with_table
from benchmarks.figures.results import FOLDER, load, run, store
from benchmarks.liar.benchmark import RULES as LIE_RULES
from benchmarks.rules.switches import (
    FRAME_RULES,
    LOOP_RULES,
    MERGE_RULES,
    PLACE_RULES,
    RECOGNITION_RULES,
    SINGLE_RULES,
    TRIAL_RULES,
)
from mapweave.hybridmap.errors import InvalidFile, InvalidValue


def test_the_pages_are_made_of_the_stored_results():
    for path, text in written_pages().items():
        assert path.read_text(encoding="utf-8") == text, "python -m benchmarks.figures"


def test_each_stored_result_is_of_the_command_that_is_named():
    assert {path.stem for path in FOLDER.glob("*.json")} == set(MEASUREMENTS)
    assert {name: load(name).command for name in MEASUREMENTS} == MEASUREMENTS


def test_a_figure_of_the_readme_that_is_no_result_is_replaced():
    """Also a row that no result is behind; what is not in the table stays."""
    head, results = "| what | figure |\n|---|---|\n", {name: load(name) for name in MEASUREMENTS}
    kept = README.read_text(encoding="utf-8")
    wrong = re.sub(r"[\d.]+ m \|", "59 m |", kept).replace(head, head + "| of no result | 1 |\n")
    assert wrong.count("59 m") == 1
    assert with_table(wrong, results) == kept
    with pytest.raises(InvalidValue, match="0 tables"):
        with_table(kept.replace(head, ""), results)


def test_figures_are_filled_in():
    figures = {"a": {"b c": 0.0123, "80": None}, "r": {"n": 7, "some": ["one", "two"], "no": []}}
    template = "{a/b c:.1m} mm, {a/b c:.1%}, {r/n} of {r/n:.2f}, {a/80:.0f}; {r/some}; {r/no}"
    assert filled(template, figures) == "12.3 mm, 1.2%, 7 of 7.00, none; one, two; none"
    with pytest.raises(InvalidValue, match="no figure a/x"):
        filled("{a/x}", figures)


def test_the_last_line_of_a_command_is_kept(tmp_path):
    script = tmp_path / "measure.py"
    script.write_text("import sys\nprint('words')\nprint('{\"argument\": \"%s\"}' % sys.argv[1])\n")
    result = run(f"python {script} DATA/x", Path("there"))
    assert result.figures == {"argument": "there/x"} and result.command == f"python {script} DATA/x"
    path = store("one", result, tmp_path)
    assert load("one", tmp_path) == result and json.loads(path.read_text())["machine"] == result.machine


def test_figures_that_are_not_good_are_kept_and_named(tmp_path, capsys):
    script = tmp_path / "measure.py"
    script.write_text("print('{\"lost\": 2}')\nraise SystemExit(1)\n")
    assert run(f"python {script}", None).figures == {"lost": 2}
    assert "exit status 1, its figures are not good" in capsys.readouterr().err


@pytest.mark.parametrize(("text", "why"), [
    ("print('no figures')", "no JSON object"),
    ("raise SystemExit(1)", "exit status 1"),
    ("print('{}'); raise SystemExit(3)", "exit status 3"),
])  # fmt: skip
def test_a_command_without_figures_is_said(tmp_path, text: str, why: str):
    script = tmp_path / "measure.py"
    script.write_text(text)
    with pytest.raises(InvalidValue, match=why):
        run(f"python {script}", None)
    with pytest.raises(InvalidValue, match="--data"):
        run(f"python {script} DATA/x", None)
    with pytest.raises(InvalidFile, match="--run missing"):
        load("missing", tmp_path)


def test_what_is_switched_off_is_there():
    """A rule that has gone or was renamed is named here too, and one that takes more than its replacement."""
    tables = TRIAL_RULES, LOOP_RULES, RECOGNITION_RULES, PLACE_RULES, FRAME_RULES, LIE_RULES
    rules = {
        **MERGE_RULES,
        **SINGLE_RULES,
        **{name: rule for table in tables for name, rule in table.items()},
    }
    for name, switches in rules.items():
        for where, function, instead in switches:
            assert hasattr(where, function), name
            if callable(instead):
                given = inspect.signature(getattr(where, function)).parameters
                inspect.signature(instead).bind(*given)

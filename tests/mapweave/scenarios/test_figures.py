"""Figures: flat, documented, and the same after a way through JSON."""

import inspect
import json
import math
import re
from dataclasses import asdict, fields, replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave.scenarios.figures import MORE_IS_BETTER, Figures, RobotFigures, as_text, kinds, measured
from mapweave.scenarios.report_page import GROUPS

COUNTS = {f.name: 3 for f in fields(Figures) if f.type is int}
BARE = Figures(**COUNTS, map_hash="ab", sim_s=60.0, wall_s=15.0)
ROBOT = RobotFigures(1, 20, 0, 1000, 2000, 0, "cd")
numbers = st.floats(allow_nan=False, allow_infinity=False)


@given(numbers, st.booleans(), numbers, st.none() | numbers)
def test_figures_are_json_in_the_order_of_the_robots(error, found, seconds, ate):
    figures = replace(
        BARE, merged_ate_m=error, found=found, found_s=seconds,
        robots={"r1": ROBOT, "r0": replace(ROBOT, trajectory_ate_m=ate)},
    )  # fmt: skip
    text = json.dumps(figures.as_dict(), allow_nan=False)
    table = json.loads(text)
    assert table == asdict(figures)
    assert list(table["robots"]) == ["r0", "r1"]


@pytest.mark.parametrize("of", [Figures, RobotFigures])
def test_every_figure_is_explained_and_has_a_unit_where_it_needs_one(of):
    explained = set(re.findall(r"^    (\w+):", inspect.getdoc(of), re.MULTILINE))
    assert explained == {f.name for f in fields(of)}
    for field in fields(of):
        if "float" in str(field.type):
            units = ("_m", "_deg", "_s", "_minute", "_per_node", "_precision", "_recall", "_factor", "_share")
            assert field.name.endswith(units), field.name


def test_the_kinds_are_those_of_the_class():
    values = kinds()
    assert values["nodes"] is int
    assert values["merged_ate_m"] is float
    assert values["found"] is bool
    assert values["map_hash"] is str
    assert set(values) == {f.name for f in fields(Figures)} - {"robots"}
    assert set(values) > MORE_IS_BETTER


def test_the_page_has_every_figure_once():
    assert sorted(name for names in GROUPS.values() for name in names) == sorted(kinds())


@given(st.floats())
def test_non_finite_numbers_are_none_in_json(value):
    assert measured(value) == (value if math.isfinite(value) else None)


@pytest.mark.parametrize(("value", "text"), [
    (None, "-"),
    (True, "yes"),
    (False, "no"),
    (3, "3"),
    (0.0123456, "0.01235"),
    (12345.6, "12346"),
    ("x", "x"),
])  # fmt: skip
def test_figures_for_people(value, text):
    assert as_text(value) == text

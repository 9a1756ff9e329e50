"""Expectations: what is accepted, and one line for each error."""

import tomllib
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave.hybridmap.errors import SettingsError
from mapweave.scenarios.expectations import check, parse_expectations
from mapweave.scenarios.figures import Figures, kinds

FIGURES = Figures(
    components=1, maps=3, nodes=100, edges=120, false_edges=0, loops=5, false_loops=0, links=20,
    false_links=1,
    collisions=0, unsaved_changes=0, troubles=0, map_hash="abc", sim_s=60.0, wall_s=20.0, link_precision=0.95,
    link_recall=0.8, merged_ate_m=0.04, found=True,
)  # fmt: skip


def verdicts(toml: str, figures: Figures = FIGURES) -> dict[str, bool]:
    return {v.name: v.good for v in check(figures, parse_expectations(tomllib.loads(toml)))}


def test_each_form_is_parsed():
    assert verdicts("components = 1\nmaps = 2") == {"components": True, "maps": False}
    assert verdicts("found = true") == {"found": True}
    assert verdicts("found = false") == {"found": False}
    assert verdicts('map_hash = "abc"') == {"map_hash": True}
    assert verdicts("merged_ate_m = 0.05\nsim_s = 59") == {"merged_ate_m": True, "sim_s": False}
    assert verdicts("nodes = {min = 100}\nedges = {max = 119}") == {"nodes": True, "edges": False}
    assert verdicts("loops = {min = 6, max = 9}\nlinks = {min = 20, max = 20}") == {
        "loops": False,
        "links": True,
    }


def test_where_more_is_better_a_plain_number_is_the_least():
    assert verdicts("link_recall = 0.8\nlink_precision = 1.0") == {
        "link_recall": True,
        "link_precision": False,
    }


def test_unmeasured_figures_do_not_pass():
    toml = "goal_error_m = 0.05\nreached = false\nfound_s = {min = 0}"
    (first, *others) = check(FIGURES, parse_expectations(tomllib.loads(toml)))
    assert not any(v.good for v in (first, *others))
    assert str(first) == "goal_error_m is not measured, wanted at most 0.05"


@given(st.sampled_from([n for n, k in kinds().items() if k in (int, float)]), *[st.floats(-1e6, 1e6)] * 3)
def test_bounds_are_included(name, value, low, high):
    low, high = sorted((low, high))
    figures = replace(FIGURES, **{name: value})
    (verdict,) = check(figures, parse_expectations({name: {"min": low, "max": high}}))
    assert verdict.good == (low <= value <= high)
    assert verdict.measured == value
    (edge,) = check(replace(FIGURES, **{name: high}), parse_expectations({name: {"min": low, "max": high}}))
    assert edge.good


@pytest.mark.parametrize(("toml", "words"), [
    ("merged_ate = 0.1", "did you mean 'merged_ate_m'?"),
    ("zzz = 1", "known are components"),
    ("robots = 1", "no figure 'robots'"),
    ("components = 1.0", "1.0 is no whole number"),
    ("components = true", "True is no whole number"),
    ("found = 1", "1 is no true or false"),
    ("map_hash = 3", "3 is no text"),
    ("merged_ate_m = 'small'", "'small' is no number"),
    ("merged_ate_m = true", "True is no number"),
    ("merged_ate_m = nan", "finite"),
    ("merged_ate_m = [0.1]", "no number"),
    ("nodes = {most = 3}", "no bound 'most'"),
    ("nodes = {}", "give min, max or both"),
    ("nodes = {min = 3, max = 2}", "min 3 is above max 2"),
    ("nodes = {min = inf}", "nodes: min: must be a finite number"),
    ("found = {min = 1}", "is a true or false, it has no min and max"),
])  # fmt: skip
def test_contradicting_options_are_refused_in_one_line(toml, words):
    with pytest.raises(SettingsError) as refusal:
        parse_expectations(tomllib.loads(toml), "a.toml: expect")
    assert words in str(refusal.value)
    assert str(refusal.value).startswith("a.toml: expect")
    assert "\n" not in str(refusal.value)


anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary(),
    lambda inner: st.lists(inner) | st.dictionaries(st.sampled_from(["min", "max", "x"]), inner),
    max_leaves=4,
)


@given(st.dictionaries(st.sampled_from([*kinds(), "other"]), anything, max_size=3))
def test_no_table_is_a_surprise(table):
    try:
        expectations = parse_expectations(table)
    except SettingsError:
        return
    assert [e.name for e in expectations] == list(table)
    assert len(check(FIGURES, expectations)) == len(table)
    assert all(str(e) for e in expectations)

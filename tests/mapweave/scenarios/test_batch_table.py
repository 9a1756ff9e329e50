"""A batch's table: medians and worsts against numpy, failures by seed."""

import io
import json
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from mapweave.scenarios.batch_table import Attempt, batch_json, batch_table, summarise
from mapweave.scenarios.expectations import check, parse_expectations
from mapweave.scenarios.figures import Figures

FIGURES = Figures(
    components=1, maps=3, nodes=100, edges=120, false_edges=0, loops=5, false_loops=0, links=20,
    false_links=0,
    collisions=0, unsaved_changes=0, troubles=0, map_hash="abc", sim_s=60.0, wall_s=20.0,
)  # fmt: skip
WANTED = parse_expectations({"merged_ate_m": 0.05, "found": True})


@pytest.fixture
def attempts() -> list[Attempt]:
    rng = np.random.default_rng(1)
    attempts = []
    for seed in range(5, 12):
        ate, recall, result = float(rng.uniform(0, 0.1)), float(rng.uniform(0, 1)), seed != 7
        figures = replace(
            FIGURES, merged_ate_m=ate, link_recall=recall, found=result, nodes=int(rng.integers(99))
        )
        attempts.append(Attempt(seed, figures, check(figures, WANTED)))
    attempts.append(Attempt(12, failure="agent r0 [it] died with status 3"))
    return attempts


def test_median_and_worst_are_of_the_right_side(attempts):
    by_name = {s.name: s for s in summarise(attempts)}
    figures = {a.seed: a.figures for a in attempts if a.figures}
    ates = {seed: f.merged_ate_m for seed, f in figures.items()}
    recalls = {seed: f.link_recall for seed, f in figures.items()}
    ate, recall, result = by_name["merged_ate_m"], by_name["link_recall"], by_name["found"]
    assert ate.median == pytest.approx(np.median(list(ates.values())))
    assert (ate.worst, ate.worst_seed) == (max(ates.values()), max(ates, key=ates.get))
    assert (recall.worst, recall.worst_seed) == (min(recalls.values()), min(recalls, key=recalls.get))
    assert (result.worst, result.worst_seed, result.median) == (0.0, 7, 1.0)
    assert by_name["nodes"].worst is None, "neither more nor less of them is better"
    assert (by_name["nodes"].least, by_name["nodes"].most) == (
        min(f.nodes for f in figures.values()), max(f.nodes for f in figures.values()),
    )  # fmt: skip
    assert ate.measured == 7
    assert "goal_error_m" not in by_name
    assert "map_hash" not in by_name


def test_the_first_seed_of_equals_is_named_in_any_order():
    same = [Attempt(seed, replace(FIGURES, merged_ate_m=0.1, link_recall=0.5)) for seed in (9, 4, 6)]
    for order in (same, same[::-1]):
        assert {s.worst_seed for s in summarise(order) if s.worst is not None} == {4}


def test_failures_are_named_with_their_reason(attempts):
    content = json.loads(json.dumps(batch_json(attempts), allow_nan=False))
    bad = {a.seed for a in attempts if a.figures and (a.figures.merged_ate_m > 0.05 or not a.figures.found)}
    assert set(content["failed"]) == {str(seed) for seed in bad | {12}}
    assert content["failed"]["12"] == ["agent r0 [it] died with status 3"]
    assert "found is no, wanted yes" in content["failed"]["7"]
    assert (content["trials"], content["passed"]) == (8, 7 - len(bad))
    assert content["seeds"]["5"]["figures"] == attempts[0].figures.as_dict()
    assert content["seeds"]["12"]["figures"] is None


def test_the_table_shows_the_same_numbers(attempts):
    out = io.StringIO()
    Console(file=out, width=120).print(batch_table(attempts, "office [kidnapped]"))
    text = out.getvalue()
    assert "office [kidnapped]" in text
    assert "seed 12 failed: agent r0 [it] died with status 3" in text
    assert "seed 7 failed" in text
    assert f"{batch_json(attempts)['passed']} of 8 passed" in text
    row = next(line for line in text.splitlines() if "merged_ate_m" in line and "│" in line)
    assert "7 of 8" in row


def test_an_empty_batch_is_a_table_too():
    assert summarise([]) == []
    Console(file=io.StringIO()).print(batch_table([]))
    assert batch_json([Attempt(1)])["failed"] == {"1": ["it was not run to its end"]}

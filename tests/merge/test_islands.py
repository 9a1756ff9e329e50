"""Merging from standing decisions against fresh merges, over random lives of fleets."""

import math
from dataclasses import replace

import numpy as np
import pytest

from mapweave.hybridmap.change import NodePut
from mapweave.hybridmap.constraint_subject import RetiredMap
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.merge import islands as islands_module
from mapweave.merge.islands import Islands
from mapweave.merge.pose_graph import component_solver
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.settings import MergeSettings
from tests.merge.lives import DENSE, Life
from tests.quick import first_quick


def contents(merged: MergedMap) -> tuple[object, ...]:
    """Everything but numbers."""
    return (
        [link.pair for link in merged.links],
        sorted((r.pair, r.reason, str(r.edge)) for r in merged.refused),
        set(merged.components),
        merged.constraints.in_force,
        set(merged.maps),
    )


@pytest.mark.parametrize(
    ("seed", "false_share"), first_quick([(1, 0.3), (3, 0.5), (0, 0.0), (2, 0.3), (4, 0.0), (5, 0.6)], 1)
)
def test_islands_and_memory_change_nothing(seed: int, false_share: float):
    """For any changes in any order: the outcome is that of a fresh merge, to the last bit."""
    pauses: list[None] = []
    life, islands = Life(seed, false_share), Islands(pause=lambda: pauses.append(None))
    for _ in range(45):
        life.step()
        if life.rng.random() < 0.4:
            pauses.clear()
            merged = islands.merge(life.maps, life.verdicts, life.touched, life.constraints)
            assert len(pauses) >= bool(life.touched), "a pause behind each island that is decided"
            life.touched = set()
            fresh = life.rebuilt()
            assert contents(merged) == contents(fresh)
            assert [graph.anchor for graph in merged.graphs] == [graph.anchor for graph in fresh.graphs]
            assert list(merged.poses) == list(fresh.poses)
            for node, place in merged.poses.items():
                other = fresh.poses[node]
                assert place.component == other.component
                assert place.merged_from_robot.mean == other.merged_from_robot.mean
                assert np.array_equal(place.merged_from_robot.covariance, other.merged_from_robot.covariance)
    assert len(islands.merge(life.maps, life.verdicts, set(), life.constraints).poses) > 20


@pytest.mark.parametrize(("seed", "false_share"), first_quick([(41, 0.3), (40, 0.0), (42, 0.5)], 1))
def test_joint_decisions_agree_with_a_fresh_merge(seed: int, false_share: float, monkeypatch):
    """However it began: once too much has changed, nothing of what stood has a say."""
    monkeypatch.setattr(islands_module, "CHANGED", -1.0)
    life, islands = Life(seed, false_share), Islands(exact=0)
    for _ in range(50):
        life.step()
        if life.rng.random() < 0.3:
            merged = islands.merge(life.maps, life.verdicts, life.touched, life.constraints)
            life.touched = set()
            assert contents(merged) == contents(life.rebuilt())


@pytest.mark.slow
@pytest.mark.parametrize("seed", [43, 44, 45])
def test_standing_decisions_agree_with_a_fresh_merge(seed: int, monkeypatch):
    """Nothing is ever decided again here, and few nodes are moved at a time."""
    monkeypatch.setattr(islands_module, "CHANGED", math.inf)
    monkeypatch.setattr(component_solver, "WHOLE", 0)
    monkeypatch.setattr(component_solver, "LEAST", 12)
    life, islands = Life(seed, 0.0, DENSE), Islands(exact=0)
    for _ in range(60):
        life.step(quiet=True)
        merged = islands.merge(life.maps, life.verdicts, life.touched, life.constraints)
        life.touched = set()
    fresh = life.rebuilt()
    assert set(merged.components) == set(fresh.components)
    one, two = ({link.pair for link in links} for links in (merged.links, fresh.links))
    assert len(two) > 150 and len(one ^ two) <= 0.03 * len(two)
    if one == two:
        assert max(merged.pose(node).distance(fresh.pose(node)) for node in fresh.poses) < 0.02


@pytest.mark.parametrize(("seed", "false_share"), first_quick([(47, 0.3), (46, 0.0), (48, 0.3)], 1))
def test_standing_decisions_agree_with_a_fresh_merge_after_any_changes(seed: int, false_share: float):
    """Nodes, links, manual constraints and retired maps come and go."""
    life, islands = Life(seed, false_share), Islands(exact=0)
    apart = links = 0
    for _ in range(60):
        life.step()
        if life.maps and life.rng.random() < 0.05:
            which = sorted(life.maps)[int(life.rng.integers(len(life.maps)))]
            life.number += 1
            constraint = ManualConstraint(
                RetiredMap(which), bool(life.rng.random() < 0.6), "anna", life.number
            )
            life.constraints = life.constraints + ManualConstraints([constraint])
        if life.rng.random() < 0.4:
            merged = islands.merge(life.maps, life.verdicts, life.touched, life.constraints)
            life.touched, fresh = set(), life.rebuilt()
            one, two = ({link.pair for link in some.links} for some in (merged, fresh))
            apart, links = apart + len(one ^ two), links + len(two)
            assert set(merged.poses) == set(fresh.poses)
            assert {r.pair for r in merged.refused} | one == {r.pair for r in fresh.refused} | two
    assert links > 15 and apart <= 0.1 * links


@pytest.mark.slow
@pytest.mark.parametrize("exact", [0, 600])
def test_links_by_hand_and_retired_nodes_hold_in_whatever_order_all_comes(exact: int):
    """Small islands against a merge from nothing; large ones in what no order may change."""
    life, islands = Life(51, 0.3), Islands(exact=exact)
    by_hand = retired = contradicted = 0
    for _ in range(60):
        life.step()
        if life.rng.random() < 0.4:
            life.correct(areas=exact > 0)
        if life.rng.random() < 0.4:
            merged = islands.merge(life.maps, life.verdicts, life.touched, life.constraints)
            life.touched, fresh = set(), life.rebuilt()
            if exact:
                assert contents(merged) == contents(fresh)
            links = merged.constraints.links.keys()
            there = {pair for pair in links if all(node in merged.poses for node in pair)}
            assert there <= {link.pair for link in merged.links} and merged.contradicted.keys() <= there
            assert set(merged.poses) == set(fresh.poses)
            assert merged.constraints.nodes == fresh.constraints.nodes
            by_hand, retired = by_hand + len(there), retired + len(merged.constraints.nodes)
            contradicted += len(merged.contradicted)
    assert by_hand > 10 and retired > 10 and contradicted > 1


@pytest.mark.slow
def test_all_is_decided_together_now_and_then_only(monkeypatch):
    times: list[bool] = []
    real = islands_module.decide
    monkeypatch.setattr(
        islands_module, "decide", lambda *a: (times.append(len(a) == 5 or a[5] is None), real(*a))[1]
    )
    life, islands = Life(4, 0.0, DENSE), Islands(exact=0)
    for _ in range(60):
        life.step(quiet=True)
        islands.merge(life.maps, life.verdicts, life.touched, life.constraints)
        life.touched = set()
    assert 3 < sum(times) < 30 and not all(times[-8:])
    times.clear()
    islands.merge(life.maps, life.verdicts, set(life.maps), life.constraints)
    assert times == [False]


@pytest.mark.slow
def test_large_islands_repeat_themselves_to_the_last_bit(monkeypatch):
    monkeypatch.setattr(component_solver, "WHOLE", 0)
    monkeypatch.setattr(component_solver, "LEAST", 12)
    collected = []
    for _ in range(2):
        life, islands = Life(49, 0.3, DENSE), Islands(exact=0)
        for _ in range(40):
            life.step()
            merged = islands.merge(life.maps, life.verdicts, life.touched, life.constraints)
            life.touched = set()
        collected.append((contents(merged), [merged.pose(node).vector.tobytes() for node in merged.poses]))
    assert collected[0] == collected[1]


def test_untouched_components_are_kept():
    life, islands = Life(7, 0.0), Islands(MergeSettings())
    for _ in range(60):
        life.step()
    first = islands.merge(life.maps, life.verdicts, life.touched, life.constraints)
    alone = MapId("z", 1)
    node = next(iter(life.maps[min(life.maps)].nodes.values()))
    life.maps[alone] = HybridMap([NodePut(replace(node, id=NodeId("z", 1, 1)))])
    second = islands.merge(life.maps, life.verdicts, {alone}, life.constraints)
    assert {id(g) for g in first.graphs} <= {id(g) for g in second.graphs}
    assert len(second.graphs) > len(first.graphs)

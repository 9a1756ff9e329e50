"""What a map has superseded among others' nodes is undone when it goes, parts, or becomes unsure."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from mapweave.hybridmap.change import Change, ChangeBody
from mapweave.hybridmap.constraint_subject import Apart, RetiredMap, Subject
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.pruned_node import PrunedNode, PrunedNodes
from mapweave.mapserver.merging.merger import Merger
from mapweave.merge.map_maintenance import superseding_log
from mapweave.merge.map_maintenance.node_superseding import NodeSuperseder
from mapweave.merge.pose_graph.merged_map import MergedMap
from synthetic.maps import changes_of
from synthetic.world import room, take_map

HOUR_NS = 3_600_000_000_000
HONEST = [MapId(f"r{k}", 1) for k in range(4)]
ANOTHER = MapId("x", 1)


@cache
def drives(seed: int) -> Mapping[MapId, Sequence[ChangeBody]]:
    """Five robots in one room, hour by hour."""
    rng = np.random.default_rng(seed)
    world = room(0, 0, 6, 4, 700, rng)
    out: dict[MapId, list[ChangeBody]] = {}
    for k, map_id in enumerate((*HONEST, ANOTHER)):
        around = rng.normal(0.0, [0.6, 0.4, 0.2], (6, 3))
        tour = [Pose2(2.8 + x, 2.0 + y, 0.7 * n + turn) for n, (x, y, turn) in enumerate(around)]
        nodes, edges = take_map(world, map_id, tour, rng)
        nodes = [replace(node, stamp_ns=node.stamp_ns + k * HOUR_NS) for node in nodes]
        out[map_id] = changes_of(nodes, edges)
    return out


def feed(merger: Merger, seed: int, which: MapId, at_once: int = 1000) -> MergedMap:
    """Take a map in, with a merge after so many changes."""
    for k, body in enumerate(drives(seed)[which], 1):
        merger.on_change(Change(which, k, 0, body))
        if k % at_once == 0:
            merger.merged()
    return merger.merged()


def constrained(*about: Subject) -> ManualConstraints:
    return ManualConstraints(
        [ManualConstraint(one, True, "anna", k, "why") for k, one in enumerate(about, 1)]
    )


@cache
def merger_without(seed: int) -> Merger:
    merger = Merger()
    for which in HONEST:
        feed(merger, seed, which)
    return merger


def with_another(seed: int) -> tuple[MergedMap, Merger]:
    """The merge of the honest maps, and one that another map has come to since then."""
    merger = Merger()
    for which in HONEST:
        before = feed(merger, seed, which)
    joined = feed(merger, seed, ANOTHER, 4)
    assert joined.joined(ANOTHER, HONEST[0]), "it was joined"
    assert joined.superseded != before.superseded, "and has superseded some"
    return before, merger


SEEDS = (31, 32, 33, 34)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_retired_map_leaves_what_was_superseded_as_it_was(seed: int) -> None:
    before, merger = with_another(seed)
    merger.constrain(constrained(RetiredMap(ANOTHER)))
    assert merger.merged().superseded == before.superseded
    # What is taken in again can be taken out again.
    merger.constrain(ManualConstraints())
    assert merger.merged().joined(ANOTHER, HONEST[0])
    merger.constrain(constrained(RetiredMap(ANOTHER)))
    assert merger.merged().superseded == before.superseded


@pytest.mark.parametrize("seed", SEEDS)
def test_a_map_that_is_no_longer_joined_does_too(seed: int) -> None:
    before, merger = with_another(seed)
    merger.constrain(constrained(*(Apart((which, ANOTHER)) for which in HONEST)))
    after = merger.merged()
    assert not after.joined(ANOTHER, HONEST[0])
    honest = {node: one for node, one in after.superseded.items() if node.map != ANOTHER}
    assert honest == before.superseded


def followed(superseder: NodeSuperseder, merged: MergedMap, unsure: Collection[MapId] = ()) -> MergedMap:
    return superseder.renewed(replace(merged, superseded={}), frozenset(unsure))


@pytest.mark.parametrize("seed", SEEDS[:2])
def test_a_map_that_becomes_unsure_does_too(seed: int) -> None:
    """The rest is superseded as if it had been unsure from the first."""
    before, merger = with_another(seed)
    once, late = NodeSuperseder(), NodeSuperseder()
    both = merger.merged()
    for superseder in (once, late):
        superseder.renewed(replace(before, superseded={}))
    at_once = followed(once, both, [ANOTHER])
    followed(late, both)
    assert followed(late, both, [ANOTHER]).superseded == at_once.superseded


def test_a_map_that_comes_behind_it_is_judged_again() -> None:
    """Others' nodes that came in the meantime are superseded, and by none of the map that is gone."""
    seed = SEEDS[0]
    merger = Merger()
    for which in (*HONEST[:2], ANOTHER, *HONEST[2:]):
        feed(merger, seed, which)
    merger.constrain(constrained(RetiredMap(ANOTHER)))
    merged = merger.merged()
    assert all(one.by.map != ANOTHER for one in merged.superseded.values())
    assert merged.superseded.keys().isdisjoint(one.by for one in merged.superseded.values())
    # As many are needed as without it, within what the order of changes makes of it.
    assert abs(len(merged.superseded) - len(merger_without(seed).merged().superseded)) <= 2


def test_pruned_maps_and_what_is_forgotten_are_not_undone(monkeypatch: pytest.MonkeyPatch) -> None:
    before, merger = with_another(SEEDS[0])
    both = merger.merged()
    node = min(merger.maps[ANOTHER].nodes)
    pruned = PrunedNodes({node: PrunedNode(min(merger.maps[HONEST[0]].nodes), Pose2(), 1)})
    log = superseding_log.SupersedingLog()
    for merged in (before, both):
        assert log.follow(merged, frozenset()) is None
        log.note({}, merged.superseded, [], [])
    assert log.follow(replace(before, pruned=pruned), frozenset()) is None
    # The same without pruning goes back to before it came.
    log = superseding_log.SupersedingLog()
    for merged in (before, both):
        log.follow(merged, frozenset())
        log.note({}, merged.superseded, [], [])
    assert log.follow(before, frozenset()) == 1
    monkeypatch.setattr(superseding_log, "MOST", 1)
    log = superseding_log.SupersedingLog()
    for merged in (before, both, both):
        log.follow(merged, frozenset())
        log.note({}, merged.superseded, [], [])
    assert log.follow(before, frozenset()) is None

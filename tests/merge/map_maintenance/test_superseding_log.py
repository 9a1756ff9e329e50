"""What a map has superseded among others' nodes is undone when it goes, parts, or becomes unsure."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave.hybridmap.change import Change, ChangeBody
from mapweave.hybridmap.constraint_subject import Apart, RetiredMap, Subject
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.pruned_node import PrunedNode, PrunedNodes
from mapweave.hybridmap.superseded import Superseded
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.merging.pruning import PrunePlan
from mapweave.merge.map_maintenance import superseding_log
from mapweave.merge.map_maintenance.node_superseding import NodeSuperseder
from mapweave.merge.map_maintenance.superseding_log import Changes, SupersedingLog, Undone
from mapweave.merge.pose_graph.merged_map import MergedMap
from synthetic.maps import changes_of
from synthetic.world import room, take_map
from tests.examined import examined_once
from tests.quick import first_quick

HOUR_NS = 3_600_000_000_000
HONEST = [MapId(f"r{k}", 1) for k in range(4)]
ANOTHER = MapId("x", 1)
SEEDS = (31, 32, 33, 34)
SMALL = SEEDS[0]
"""The seed of each run of the quick tests: four nodes a drive, else six."""


@pytest.fixture(scope="module", autouse=True)
def examined() -> Iterator[None]:
    with examined_once():
        yield


@cache
def drives(seed: int) -> Mapping[MapId, Sequence[ChangeBody]]:
    """Five robots in one room, hour by hour."""
    rng = np.random.default_rng(seed)
    world = room(0, 0, 6, 4, 700, rng)
    out: dict[MapId, list[ChangeBody]] = {}
    for k, map_id in enumerate((*HONEST, ANOTHER)):
        around = rng.normal(0.0, [0.6, 0.4, 0.2], (4 if seed == SMALL else 6, 3))
        tour = [Pose2(2.8 + x, 2.0 + y, 0.7 * n + turn) for n, (x, y, turn) in enumerate(around)]
        nodes, edges = take_map(world, map_id, tour, rng)
        nodes = [replace(node, stamp_ns=node.stamp_ns + k * HOUR_NS) for node in nodes]
        out[map_id] = changes_of(nodes, edges)
    return out


def feed(merger: Merger, seed: int, which: MapId, bounds: Collection[int] = ()) -> MergedMap:
    """Take a map in, with a merge after some numbers of changes, and one in the end."""
    bodies = drives(seed)[which]
    for a, b in pairwise(sorted({0, len(bodies), *(b for b in bounds if b < len(bodies))})):
        for k, body in enumerate(bodies[a:b], a + 1):
            merger.on_change(Change(which, k, 0, body))
        merger.merged()
    return merger.merged()


def constrained(*about: Subject) -> ManualConstraints:
    return ManualConstraints(
        [ManualConstraint(one, True, "anna", k, "why") for k, one in enumerate(about, 1)]
    )


def with_another(seed: int) -> tuple[MergedMap, Merger]:
    """The merge of the honest maps, and one that another map has come to since then."""
    merger = Merger()
    for which in HONEST:
        before = feed(merger, seed, which)
    joined = feed(merger, seed, ANOTHER, range(3, 100, 3))
    assert joined.joined(ANOTHER, HONEST[0]), "it was joined"
    assert joined.superseded != before.superseded, "and has superseded some"
    return before, merger


@cache
def unchanged(seed: int) -> tuple[MergedMap, Merger]:
    """The same, for tests that change nothing of it."""
    return with_another(seed)


def restarted(merger: Merger, seed: int, maps: Sequence[MapId]) -> Merger:
    """Another process that goes on from the record of this one."""
    again = Merger()
    again.recollect(merger.findings(), merger.record())
    again.read([(which, body) for which in maps for body in drives(seed)[which]])
    again.constrain(merger.constraints)
    assert again.merged().superseded == merger.merged().superseded
    return again


@pytest.mark.parametrize("seed", first_quick(SEEDS, 1))
def test_a_retired_map_leaves_what_was_superseded_as_it_was(seed: int):
    before, merger = with_another(seed)
    merger.constrain(constrained(RetiredMap(ANOTHER)))
    assert merger.merged().superseded == before.superseded
    # What is taken in again can be taken out again.
    merger.constrain(ManualConstraints())
    assert merger.merged().joined(ANOTHER, HONEST[0])
    merger.constrain(constrained(RetiredMap(ANOTHER)))
    assert merger.merged().superseded == before.superseded


@pytest.mark.parametrize("seed", first_quick(SEEDS, 1))
def test_a_map_that_is_pruned_as_a_whole_has_not_gone(seed: int):
    """Newer nodes have taken its place: nothing is undone, and nothing is remembered of it."""
    _, merger = with_another(seed)
    both, log = merger.merged(), merger.record().log
    gone = set(merger.maps[HONEST[0]].nodes)
    left = PrunedNode(min(merger.maps[ANOTHER].nodes), Pose2(), 1)
    merger.prune(PrunePlan(dict.fromkeys(gone, left), (), (), frozenset()))
    merged, kept = merger.merged(), merger.record().log
    assert HONEST[0] not in merged.maps and any(len(step.without(gone)) < len(step) for step in log.steps)
    expected = [step for step in (step.without(gone) for step in log.steps) if len(step)]
    assert list(kept.steps[: len(expected)]) == expected
    stays = {n: s for n, s in both.superseded.items() if n not in gone and s.by not in gone}
    assert stays and stays.items() <= merged.superseded.items()


def test_a_node_that_a_pruned_one_superseded_before_is_judged_again():
    a, b, c = (NodeId("r0", 1, k) for k in range(3))
    by_b = Superseded(b, 20, 0.1, 0.1)
    step = Changes(
        {a: by_b, b: None, c: None}, frozenset({b}), frozenset({(a, b), (a, c)}), frozenset({(b, c)})
    )
    assert step.without({b}) == Changes({a: None, c: None}, frozenset({a}), frozenset({(a, c)}))
    assert step.without(frozenset()) == step


@pytest.mark.parametrize("seed", first_quick(SEEDS, 0, 2))
@settings(max_examples=6, deadline=None)
@given(
    order=st.permutations(HONEST),
    bounds=st.sets(st.integers(1, 10)),
    restarts=st.lists(st.booleans(), min_size=7, max_size=7),
)
def test_so_it_does_whatever_came_when_and_across_restarts(
    seed: int, order: Sequence[MapId], bounds: set[int], restarts: list[bool]
):
    """Also if the person retires it while no server runs, takes it in again, and retires it again."""
    merger, maps, points = Merger(), [*order], iter(restarts)

    def go_on() -> None:
        nonlocal merger
        if next(points):
            merger = restarted(merger, seed, maps)

    for which in order:
        before = feed(merger, seed, which, bounds)
    go_on()
    feed(merger, seed, ANOTHER, bounds)
    maps.append(ANOTHER)
    go_on()
    for constraints in (constrained(RetiredMap(ANOTHER)), ManualConstraints()) * 2:
        merger.constrain(constraints)
        go_on()
        merged = merger.merged()
        assert merged.superseded == before.superseded or not constraints.retired
    go_on()
    assert not list(points)


@pytest.mark.parametrize("seed", first_quick(SEEDS, 1))
def test_a_map_that_is_no_longer_joined_does_too(seed: int):
    before, merger = with_another(seed)
    merger.constrain(constrained(*(Apart((which, ANOTHER)) for which in HONEST)))
    after = merger.merged()
    assert not after.joined(ANOTHER, HONEST[0])
    honest = {node: one for node, one in after.superseded.items() if node.map != ANOTHER}
    assert honest == before.superseded


@pytest.mark.parametrize("seed", first_quick(SEEDS, 1))
@pytest.mark.parametrize("at_once", [True, False])
def test_maps_that_part_because_of_it_are_joined_as_before(seed: int, at_once: bool):
    """Robots that would have been in one place at one time part, and do not once it is retired.

    So it is with a process that goes on from the record, too.
    """
    merger = Merger()
    for which in HONEST:
        before = feed(merger, seed, which)
    if not at_once:
        feed(merger, seed, ANOTHER)
    merger.constrain(constrained(*(Apart((HONEST[0], which)) for which in (*HONEST[1:], ANOTHER))))
    parted = feed(merger, seed, ANOTHER) if at_once else merger.merged()
    assert not parted.joined(HONEST[0], HONEST[1]) and parted.joined(HONEST[1], ANOTHER)
    assert parted.superseded != before.superseded
    for one in (restarted(merger, seed, (*HONEST, ANOTHER)), merger):
        one.constrain(constrained(RetiredMap(ANOTHER)))
        assert one.merged().superseded == before.superseded


def followed(superseder: NodeSuperseder, merged: MergedMap, unsure: Collection[MapId] = ()) -> MergedMap:
    return superseder.renewed(replace(merged, superseded={}), frozenset(unsure))


@pytest.mark.parametrize("seed", first_quick(SEEDS[:2], 1))
def test_a_map_that_becomes_unsure_does_too(seed: int):
    """The rest is superseded as if it had been unsure from the first."""
    before, merger = unchanged(seed)
    first, late = NodeSuperseder(), NodeSuperseder()
    both = merger.merged()
    for superseder in (first, late):
        followed(superseder, before)
    at_once = followed(first, both, [ANOTHER])
    followed(late, both)
    assert followed(late, both, [ANOTHER]).superseded == at_once.superseded


def test_maps_that_came_behind_it_are_judged_again():
    """They are superseded by none of the map that is gone, and by nodes that are active."""
    seed = SEEDS[0]
    merger = Merger()
    for which in (*HONEST[:2], ANOTHER, *HONEST[2:]):
        feed(merger, seed, which)
    merger.constrain(constrained(RetiredMap(ANOTHER)))
    merged = merger.merged()
    assert all(one.by.map != ANOTHER for one in merged.superseded.values())
    assert merged.superseded.keys().isdisjoint(one.by for one in merged.superseded.values())
    # What came before it is gone on from, and so it is the next time.
    merger.constrain(ManualConstraints())
    merger.merged()
    merger.constrain(constrained(RetiredMap(ANOTHER)))
    assert merger.merged().superseded == merged.superseded


def test_what_superseded_a_node_before_may_be_superseded_itself():
    """By a node that is not undone: the first one is judged again."""
    before, _ = unchanged(SEEDS[0])
    a, b, c = (NodeId("r0", 1, k) for k in range(3))
    by = {n: Superseded(n, 20, 0.1, 0.1) for n in (b, c)}
    log = SupersedingLog((), ({HONEST[0]: 0, ANOTHER: 0},)).noted(
        {b: by[c]}, Undone({a: by[b]}), frozenset(), frozenset(), frozenset()
    )
    superseded = {b: by[c]}
    _, undone = log.followed(before, frozenset(), superseded, {a})
    assert superseded == {b: by[c]} and undone.judged == {a}


def test_pruned_maps_and_what_is_forgotten_are_not_undone(monkeypatch):
    before, merger = unchanged(SEEDS[0])
    both = merger.merged()
    nodes = both.poses.keys()
    node = min(merger.maps[ANOTHER].nodes)
    pruned = PrunedNodes({node: PrunedNode(min(merger.maps[HONEST[0]].nodes), Pose2(), 1)})

    def log_of(*maps: MergedMap) -> tuple[SupersedingLog, dict[NodeId, Superseded]]:
        log, table = SupersedingLog(), dict[NodeId, Superseded]()
        for merged in maps:
            log, undone = log.followed(merged, frozenset(), table, nodes)
            assert undone == Undone(undone.before) and undone.before == table
            table = dict(merged.superseded)
            log = log.noted(table, undone, frozenset(), frozenset(), frozenset())
        return log, table

    log, table = log_of(before, both)
    _, undone = log.followed(replace(before, pruned=pruned), frozenset(), table, nodes)
    assert undone == Undone(both.superseded) and table == both.superseded
    # The same without pruning goes back to before it came.
    log.followed(before, frozenset(), table, nodes)
    assert table == before.superseded
    monkeypatch.setattr(superseding_log, "MOST", 1)
    log, table = log_of(before, both, both)
    assert log.steps == ()
    log.followed(before, frozenset(), table, nodes)
    assert table == both.superseded

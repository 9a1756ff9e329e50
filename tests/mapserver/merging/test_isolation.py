"""A map with which the merge fails is set apart, and all others are merged as if it were not there."""

import logging
from collections.abc import Collection, Iterable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave.hybridmap.change import Change, ChangeBody, EdgePut, NodePut
from mapweave.hybridmap.constraint_subject import RetiredMap
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.mapserver.merging.isolation import leave_out
from mapweave.mapserver.merging.merger import Merger
from mapweave.merge import merging
from mapweave.merge.outlier_rejection import decision_cache
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.offline_merge import merge_parts
from synthetic.maps import changes_of
from synthetic.world import room, take_map

Log = list[tuple[MapId, ChangeBody]]
Logs = dict[MapId, Log]
R0, R1, BAD, WORSE = (MapId(agent, 1) for agent in ("r0", "r1", "bad", "worse"))

pairs = st.lists(st.lists(st.integers(0, 9), min_size=1, max_size=3, unique=True), max_size=4)


@given(pairs, st.permutations(range(10)))
def test_the_good_rows_are_kept_and_usable(bad: list[list[int]], order: list[int]):
    """Against all sets that fail: no number that was left out could be added."""

    def attempt(some: Collection[int]) -> set[int]:
        if any(set(some) >= set(group) for group in bad):
            raise ZeroDivisionError
        return set(some)

    kept, left_out = leave_out(order, attempt)
    assert kept | left_out.keys() == set(range(10)) and not kept & left_out.keys()
    for node_id in left_out:
        with pytest.raises(ZeroDivisionError):
            attempt(kept | {node_id})


def test_one_bad_map_of_many_is_found_in_few_attempts():
    attempts = 0

    def attempt(some: Collection[int]) -> None:
        nonlocal attempts
        attempts += 1
        if 700 in some:
            raise ValueError("700")

    assert list(leave_out(range(1000), attempt)[1]) == [700]
    assert attempts <= 2 * 10 + 1


def test_a_failure_without_any_map_sets_no_map_apart():
    def attempt(some: Collection[int]) -> None:
        raise KeyError("always")

    with pytest.raises(KeyError):
        leave_out([1, 2], attempt)


@pytest.fixture(scope="module")
def logs() -> Logs:
    """Two sound robots in one room, and two more of which the second has mapped another one."""
    rng = np.random.default_rng(1)
    here, elsewhere = room(0, 0, 5, 4, 600, rng), room(0, 0, 5, 4, 600, rng)
    tour = [Pose2(2.2 + 0.1 * k, 1.8, 0.9 * k) for k in range(4)]
    worlds = {R0: here, R1: here, BAD: elsewhere, WORSE: here}
    return {
        map_id: [(map_id, change) for change in changes_of(*take_map(world, map_id, tour, rng))]
        for map_id, world in worlds.items()
    }


def merger_of(result: Logs, *maps: MapId) -> Merger:
    merger = Merger()
    merger.read(item for map_id in maps for item in result[map_id])
    return merger


def alone_fails(monkeypatch: pytest.MonkeyPatch, *bad: MapId) -> None:
    """Let the merge fail where any of these maps is cut into pieces."""
    real = decision_cache.fragments_of

    def fails(maps: dict[MapId, HybridMap], *more: Any) -> Any:
        if set(bad) & maps.keys():
            raise np.linalg.LinAlgError("Singular\nmatrix")
        return real(maps, *more)

    monkeypatch.setattr(decision_cache, "fragments_of", fails)


def together_fail(monkeypatch: pytest.MonkeyPatch, *bad: MapId) -> None:
    """Let the merge fail where all of these are merged in one island."""
    real = merging.weigh

    def fails(links: Any, by_node: Iterable[NodeId], *more: Any) -> Any:
        if set(bad) <= {node.map for node in by_node}:
            raise ZeroDivisionError("together")
        return real(links, by_node, *more)

    monkeypatch.setattr(merging, "weigh", fails)


def said(merged: MergedMap, *maps: MapId) -> tuple[object, ...]:
    """All that a merge says of some maps."""
    nodes = sorted(node for node in merged.poses if node.map in maps)
    return (
        [(link.pair, link.weight) for link in merged.links if {n.map for n in link.pair} <= set(maps)],
        [(r.pair, r.reason) for r in merged.refused if {n.map for n in r.pair} <= set(maps)],
        [(node, merged.pose(node)) for node in nodes],
        {node: fate for node, fate in merged.superseded.items() if node.map in maps},
    )


def test_a_map_with_which_it_fails_is_set_apart_and_the_others_are_as_without_it(logs: Logs, monkeypatch):
    alone = merger_of(logs, R0, R1).merged()
    assert len(alone.links) > 2
    alone_fails(monkeypatch, BAD)
    for order in ((R0, R1, BAD), (BAD, R0, R1)):
        merged = merger_of(logs, *order).merged()
        assert said(merged, R0, R1) == said(alone, R0, R1)
        assert merged.maps.keys() == {R0, R1}
        assert merged.set_apart == {BAD: "the merge fails with it (LinAlgError: Singular matrix)"}
        assert merged.summary().endswith("1 set apart")
        with pytest.raises(InvalidValue, match=r"bad\.1 is set apart: the merge fails with it"):
            merged.check(BAD)


def test_a_server_that_runs_goes_on_when_a_map_comes_with_which_it_fails(logs: Logs, monkeypatch, caplog):
    alone_fails(monkeypatch, BAD)
    merger = merger_of(logs, R0)
    merger.merged()
    merger.read(logs[BAD])
    assert merger.merged().set_apart.keys() == {BAD}
    caplog.clear()
    merger.read(logs[R1])
    merged = merger.merged()
    assert said(merged, R0, R1) == said(merger_of(logs, R0, R1).merged(), R0, R1)
    assert merged.set_apart.keys() == {BAD} and not caplog.records


def test_two_maps_that_fail_only_together_cost_the_smaller_one_alone(logs: Logs, monkeypatch):
    together_fail(monkeypatch, R1, WORSE)
    small = {**logs, WORSE: logs[WORSE][:3]}
    alone = merger_of(logs, R0, R1).merged()
    for order in ((R0, R1, WORSE), (WORSE, R1, R0)):
        merged = merger_of(small, *order).merged()
        assert merged.set_apart.keys() == {WORSE}
        assert said(merged, R0, R1) == said(alone, R0, R1)
    # A map that another process set apart is set apart again.
    merger = merger_of(small, R0, R1, WORSE)
    merger.suspect([R1])
    assert merger.merged().set_apart.keys() == {R1}


def test_a_map_set_apart_is_tried_again_after_a_change(logs: Logs, monkeypatch, caplog):
    merger = merger_of(logs, R0, R1, WORSE)
    node = logs[WORSE][0][1]
    assert isinstance(node, NodePut)
    tried: list[int] = []
    with monkeypatch.context() as patch:
        alone_fails(patch, WORSE)
        for k in range(12):
            caplog.clear()
            merger.on_change(Change(WORSE, 100 + k, 0, NodePut(replace(node.node, radius=0.01 * k))))
            assert merger.merged().set_apart.keys() == {WORSE}
            if caplog.records:
                tried.append(k)
    assert tried == [0, 1, 3, 7]
    for k in range(12):
        merger.on_change(Change(WORSE, 200 + k, 0, NodePut(node.node)))
        merger.merged()
    merged = merger.merged()
    assert not merged.set_apart
    assert said(merged, R0, R1, WORSE) == said(merger_of(logs, R0, R1, WORSE).merged(), R0, R1, WORSE)


def test_a_merged_map_that_breaks_its_users_is_set_apart(logs: Logs):
    merger = merger_of(logs, R0, R1, BAD)

    def use(merged: MergedMap) -> None:
        assert BAD not in merged.maps

    assert merger.merged(use).set_apart.keys() == {BAD}
    assert merger.merged(use).maps.keys() == {R0, R1}


def test_a_retired_map_breaks_nothing_and_is_not_set_apart(logs: Logs, monkeypatch):
    alone_fails(monkeypatch, BAD)
    merger = merger_of(logs, R0, R1, BAD)
    assert merger.merged().set_apart
    merger.constrain(ManualConstraints([ManualConstraint(RetiredMap(BAD), True, "anna", 1)]))
    merged = merger.merged()
    assert not merged.set_apart and BAD in merged.maps
    assert said(merged, R0, R1) == said(merger_of(logs, R0, R1).merged(), R0, R1)
    back = ManualConstraint(RetiredMap(BAD), False, "anna", 2)
    merger.constrain(ManualConstraints([*merged.constraints.made, back]))
    assert merger.merged().set_apart.keys() == {BAD}


def test_a_bad_map_is_left_out_before_comparing(logs: Logs, monkeypatch):
    alone_fails(monkeypatch, BAD)
    merger = merger_of(logs, BAD, R0, R1)
    apart = merger.apart()
    assert apart.maps.keys() == {R0, R1} and len(apart.components) == 2


def test_nodes_that_cannot_be_compared_are_not_linked(logs: Logs, monkeypatch, caplog):
    import mapweave.mapserver.merging.node_comparisons as module

    real = module.verify

    def fails(a: Any, b: Any, *more: Any) -> Any:
        if WORSE in (a.id.map, b.id.map):
            raise IndexError("beyond the image")
        return real(a, b, *more)

    monkeypatch.setattr(module, "verify", fails)
    merged = merger_of(logs, R0, R1, WORSE).merged()
    assert said(merged, R0, R1)[0] == said(merger_of(logs, R0, R1).merged(), R0, R1)[0]
    assert not merged.set_apart and len(merged.components) == 2
    assert "cannot be compared (IndexError)" in {r.reason for r in merged.refused}
    assert "cannot be compared" in caplog.text and caplog.records[0].levelno == logging.ERROR


def test_a_node_whose_search_fails_holds_up_no_other(logs: Logs, monkeypatch):
    merger = merger_of(logs, BAD, R0, R1)
    real = merger.places.overlaps

    def fails(node: Any, *more: Any) -> Any:
        if node.id.map == BAD:
            raise IndexError("no such cell")
        return real(node, *more)

    monkeypatch.setattr(merger.places, "overlaps", fails)
    merged = merger.merged()
    assert merger.uncompared == 0
    assert said(merged, R0, R1) == said(merger_of(logs, R0, R1).merged(), R0, R1)


def test_a_map_of_which_nodes_lie_beyond_all_messages_is_set_apart(logs: Logs):
    """Each edge is within its bounds, and all together they are not."""
    far = PoseGaussian.from_sigmas(Pose2(9.9e4), 0.1, 0.01)
    node, edge = (
        next(body for _, body in logs[BAD] if isinstance(body, kind)) for kind in (NodePut, EdgePut)
    )
    ids = [NodeId(*BAD, 100 + k) for k in range(12)]
    log: Log = [(BAD, NodePut(replace(node.node, id=node_id))) for node_id in ids]
    log += [
        (BAD, EdgePut(replace(edge.edge, id=NodeId(*BAD, 200 + k), a=a, b=b, a_from_b=far)))
        for k, (a, b) in enumerate(pairwise(ids))
    ]
    merged = merger_of({**logs, BAD: log}, R0, R1, BAD).merged()
    assert "lie beyond 1e+06 m" in merged.set_apart[BAD]
    assert said(merged, R0, R1) == said(merger_of(logs, R0, R1).merged(), R0, R1)


def test_files_are_merged_with_all_maps_or_not_at_all(logs: Logs, monkeypatch):
    """Else the map would be missing in what is written."""
    alone_fails(monkeypatch, BAD)
    maps = {item: HybridMap(body for _, body in logs[item]) for item in (R0, BAD)}
    with pytest.raises(InvalidValue, match=r"map bad\.1 cannot be merged: the merge fails with it .*retire"):
        merge_parts(maps, ManualConstraints())
    retired = merge_parts(maps, ManualConstraints([ManualConstraint(RetiredMap(BAD), True, "anna", 1)]))
    assert retired.maps.keys() == {R0, BAD}

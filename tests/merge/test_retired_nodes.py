"""Retired nodes take no part in anything; the robot's way past them still ties the rest."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from mapweave.hybridmap.area import Area
from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.constraint_subject import (
    Apart,
    RetiredArea,
    RetiredMap,
    RetiredNodes,
    RetiredWindow,
    Subject,
)
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.hybridmap.node import Edge, EdgeKind
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.mapserver.active_nodes import ActiveNodes
from mapweave.mapserver.map_files import map_file_of, merged_of
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.routes import Router
from mapweave.merge.constraint_checks import check_manual_constraint
from mapweave.merge.outlier_rejection.segmentation import fragments_of
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.retired_nodes import without_nodes
from mapweave.storage.map_file import pack_map_file, unpack_map_file
from synthetic.fleet import FleetSettings, draw_fleet
from synthetic.maps import changes_of, map_tours, merger_of, numbered
from synthetic.world import room, take_map, take_view

A, B = MapId("a", 1), MapId("b", 1)


def ids(map_id: MapId, *numbers: int) -> tuple[NodeId, ...]:
    return tuple(NodeId(*map_id, number) for number in numbers)


def constrained(*subjects: Subject) -> ManualConstraints:
    return ManualConstraints(ManualConstraint(about, True, "anna", k) for k, about in enumerate(subjects))


@pytest.mark.parametrize("seed", range(4))
def test_bridges_keep_the_rest_where_all_measurements_put_it(seed: int):
    """Poses and covariances against the whole drive with the retired nodes as unknowns.

    Of a chain the two are the same to first order: a bridge is what marginalising the nodes leaves.
    """
    rng = np.random.default_rng(seed)
    fleet = draw_fleet(0.0, rng, FleetSettings(robots=1, nodes=14, true_links=4))
    ((map_id, whole),) = fleet.maps.items()
    nodes = sorted(whole.nodes)
    gone = {nodes[3], nodes[4], nodes[8]}
    left = without_nodes(whole, gone)
    assert left.nodes.keys() == whole.nodes.keys() - gone and gone <= whole.nodes.keys()
    (one,), (rest,) = fragments_of({map_id: whole}), fragments_of({map_id: left})
    for node in rest.graph.nodes:
        a, b = one.graph.pose_gaussian(node), rest.graph.pose_gaussian(node)
        assert a.mean.distance(b.mean) < 1e-6 and abs(a.mean.heading - b.mean.heading) < 1e-6
        # Not the same to the last digit: every measurement's covariance is raised to a floor.
        assert np.allclose(a.covariance, b.covariance, rtol=0.05, atol=1e-6)


def test_where_several_ways_meet_bridges_lead_from_one_node_to_all_others():
    whole = HybridMap()
    rng = np.random.default_rng(1)
    fleet = draw_fleet(0.0, rng, FleetSettings(robots=1, nodes=6, true_links=0))
    (one,) = fleet.maps.values()
    nodes = sorted(one.nodes)
    for node in nodes:
        whole.apply(NodePut(one.nodes[node]))
    for k, node in enumerate(nodes[1:]):
        step = PoseGaussian.from_sigmas(fleet.truth[nodes[0]].inverse() @ fleet.truth[node], 0.03, 0.01)
        whole.apply(EdgePut(Edge(NodeId("r0", 1, 900 + k), nodes[0], node, step, EdgeKind.MAPPED)))
    left = without_nodes(whole, {nodes[0]})
    assert len(left.components()) == 1 and len(left.edges) == len(nodes) - 2
    for edge in left.edges.values():
        true = fleet.truth[edge.a].inverse() @ fleet.truth[edge.b]
        assert edge.a == nodes[1] and edge.a_from_b.mean.distance(true) < 1e-9


@pytest.fixture
def merger() -> Merger:
    """Two robots go round one hall, both with the same twelve stops."""
    rng = np.random.default_rng(3)
    tours = dict.fromkeys((A, B), stops(12))
    return merger_of(map_tours(room(0, 0, 7, 5, 900, rng), tours, rng, 0.01, 0.01))


def stops(count: int) -> list[Pose2]:
    return [Pose2(1.5 + 0.35 * k, 2.5, 0.5 * k) for k in range(count)]


def same(one: MergedMap, other: MergedMap) -> bool:
    files = (map_file_of(replace(merged, constraints=ManualConstraints())) for merged in (one, other))
    return len({pack_map_file(content) for content in files}) == 1


def active(merger: Merger, merged: MergedMap) -> ActiveNodes:
    return ActiveNodes(merger.places, merger.node, merged)


def check_out_of_use(merger: Merger, merged: MergedMap, gone: Sequence[NodeId]) -> None:
    assert not merged.poses.keys() & set(gone) and merged.constraints.nodes.keys() == set(gone)
    assert not any(node in gone for link in merged.links for node in link.pair)
    answering, world = active(merger, merged), room(0, 0, 7, 5, 900, np.random.default_rng(3))
    for stop in stops(12)[3:8]:
        view, _ = take_view(world, stop, np.random.default_rng(5))
        found = answering.query(view, 30)
        assert found and not any(node in gone for node, _ in found)
    assert all(answering.node(node) is None for node in gone)
    assert " retired by anna on " in Router(merged).route(min(merged.poses), gone[0]).reason


def test_nodes_are_retired_and_come_back_to_the_bit(merger: Merger):
    before = merger.merged()
    assert len(before.components) == 1 and len(before.poses) == 24
    gone = ids(A, 7, 9, 11)
    merger.constrain(constrained(RetiredNodes(gone)))
    merged = merger.merged()
    check_out_of_use(merger, merged, gone)
    assert len(merged.components) == 1, "the way past them ties the map"
    union = merged.union()
    route = Router(merged).route(*ids(A, 5, 13))
    assert not any(leg.node.id in gone for leg in route.legs) and not any(
        edge.id.agent == "bridge" for edge in union.edges.values()
    )
    again = merged_of(unpack_map_file(pack_map_file(map_file_of(merged))))
    assert again.poses.keys() == merged.poses.keys() and again.constraints.nodes == merged.constraints.nodes
    merger.constrain(ManualConstraints())
    assert same(merger.merged(), before)


@pytest.mark.slow
def test_an_area_holds_for_all_maps_and_for_nodes_that_come_later(merger: Merger):
    before = merger.merged()
    (anchor,) = ids(B, 1)
    # Around the true stops 5 and 6, in the frame of a node that has turned by nothing.
    area = Area(anchor, ((1.6, -0.5), (2.25, -0.5), (2.25, 0.5), (1.6, 0.5)))
    effects = check_manual_constraint(
        before, ManualConstraints(), constrained(RetiredArea(area)).made[0]
    ).effects
    assert effects.startswith("4 nodes of a.1, b.1; map a.1 stays in one frame, and no way of its own leads")
    merger.constrain(constrained(RetiredArea(area)))
    merged = merger.merged()
    check_out_of_use(merger, merged, [*ids(A, 11, 13), *ids(B, 11, 13)])
    again = merged_of(unpack_map_file(pack_map_file(map_file_of(merged))))
    assert again.poses.keys() == merged.poses.keys() and again.constraints.nodes == merged.constraints.nodes
    # Another robot maps there afterwards.
    rng = np.random.default_rng(9)
    world = room(0, 0, 7, 5, 900, np.random.default_rng(3))
    third = MapId("c", 1)
    for change in numbered(third, map_tours(world, {third: stops(12)}, rng, 0.01, 0.01)[third]):
        merger.on_change(change)
    later = merger.merged()
    assert {node for node in later.constraints.nodes if node.map == third} == set(ids(third, 11, 13))
    assert later.joined(third, A)


def test_a_time_window_holds_for_nodes_that_come_later(merger: Merger):
    seconds = 10**9
    window = RetiredWindow(A, 15 * seconds, 30 * seconds)
    merger.constrain(constrained(window))
    merged = merger.merged()
    check_out_of_use(merger, merged, ids(A, 15, 17, 19, 21, 23))
    world, rng = room(0, 0, 7, 5, 900, np.random.default_rng(3)), np.random.default_rng(4)
    nodes, edges = take_map(world, A, stops(17), rng, None, 0.01, 0.01)
    # Announced and not merged yet: it is found, and not answered from.
    merger.places.announce(nodes[12])
    late = ActiveNodes(merger.places, {node.id: node for node in nodes}.get, merged)
    assert late.node(nodes[12].id) is None and late.node(nodes[16].id) is not None
    for change in changes_of(nodes[12:], edges[11:]):
        merger.apply(A, change)
    assert merger.merged().constraints.nodes.keys() == set(ids(A, *range(15, 31, 2)))


def test_a_map_that_only_loops_hold_together_falls_apart_and_that_is_said_before():
    fleet = draw_fleet(0.0, np.random.default_rng(2), FleetSettings(robots=1, nodes=8, true_links=0))
    ((map_id, whole),) = fleet.maps.items()
    nodes = sorted(whole.nodes)
    # The robot was carried from the fourth node to the fifth, and recognised the second one there.
    (cut,) = (e for e in whole.edges.values() if {e.a, e.b} == {nodes[3], nodes[4]})
    true = fleet.truth[nodes[1]].inverse() @ fleet.truth[nodes[4]]
    loop = Edge(cut.id, nodes[1], nodes[4], PoseGaussian.from_sigmas(true, 0.02, 0.01), EdgeKind.LOOP)
    whole.apply(EdgePut(loop))
    merger = merger_of({map_id: whole.contents()})
    asked = constrained(RetiredNodes((nodes[1],))).made[0]
    said = check_manual_constraint(merger.merged(), ManualConstraints(), asked).effects
    assert f"map {map_id} falls into 2 pieces of 4, 3 nodes" in said
    merger.constrain(ManualConstraints([asked]))
    assert sorted(map(len, merger.merged().components)) == [3, 4]
    for about, words in (
        (RetiredNodes((nodes[1],)), "is retired already"),
        (RetiredNodes((NodeId("r0", 1, 999),)), "has no node 999"),
        (RetiredWindow(map_id, 1, 2), f"no node lies in it; the nodes of {map_id} are until .* UTC"),
        (RetiredArea(Area(nodes[1], ((0, 0), (1, 0), (0, 1)))), "is out of use"),
        (RetiredArea(Area(nodes[0], ((500, 0), (501, 0), (500, 1)))), "no node lies in it"),
    ):
        wanted = ManualConstraint(about, True, "bob", 9)
        with pytest.raises(InvalidValue, match=words):
            check_manual_constraint(merger.merged(), ManualConstraints([asked]), wanted)


def test_a_retirement_that_is_taken_back_says_what_others_still_retire(merger: Merger):
    seconds = 10**9
    (corner,) = ids(B, 1)
    outline = Area(corner, ((1.6, -0.5), (2.25, -0.5), (2.25, 0.5), (1.6, 0.5)))
    subjects = [
        *(RetiredNodes(some) for some in (ids(A, 7, 15), ids(A, 7), ids(B, 11))),
        RetiredWindow(A, 15 * seconds, 30 * seconds), RetiredMap(B), RetiredArea(outline),
    ]  # fmt: skip
    first, second, third, window, whole, area = (
        ManualConstraint(about, True, "anna", k, f"reason {k}") for k, about in enumerate(subjects)
    )

    def said(taken_back: ManualConstraint, *made: ManualConstraint) -> str:
        merger.constrain(ManualConstraints(made))
        by_bob = replace(taken_back, holds=False, who="bob", stamp_ns=99)
        return check_manual_constraint(merger.merged(), ManualConstraints(made), by_bob).words

    by = 'retired by anna on 1970-01-01 00:00 UTC: "reason'
    how = "taken back by bob on 1970-01-01 00:00 UTC"
    assert said(first, first) == (
        'nodes a.1.7 and a.1.15 are in use again, by bob on 1970-01-01 00:00 UTC: "reason 0"'
    )
    assert said(first, first, second, window).removeprefix("nodes a.1.7 and a.1.15: ") == (
        f'{how}: "reason 0", but node a.1.7 stays out of use: node a.1.7 is {by} 1"; '
        f'node a.1.15 stays out of use: map a.1 {window.about.__str__().removeprefix("map a.1 ")} is {by} 3"'
    )
    assert "; but" not in said(window, window, second), "these are other nodes"
    assert f"node b.1.11 stays out of use: map b.1 is {by} 4" in said(third, third, whole)
    assert f"but node b.1.11 stays out of use: node b.1.11 is {by} 2" in said(whole, third, whole)
    assert f"but node b.1.11 stays out of use: the area of 4 corners at b.1.1 is {by} 5" in said(
        third, third, area
    )
    assert f"but node b.1.11 stays out of use: node b.1.11 is {by} 2" in said(area, third, area)


def test_two_nodes_that_may_be_linked_again_stay_apart_while_their_maps_do(merger: Merger):
    pair = ManualConstraint(Apart(ids(A, 7) + ids(B, 7)), True, "anna", 1)
    maps = ManualConstraint(Apart((A, B)), True, "anna", 2, "two halls")
    asked = check_manual_constraint(
        merger.merged(), ManualConstraints([pair, maps]), replace(pair, holds=False)
    )
    assert "but they stay apart: undone with all links between a.1 and b.1 by anna on" in asked.words
    alone = check_manual_constraint(merger.merged(), ManualConstraints([pair]), replace(pair, holds=False))
    assert "may be linked again" in alone.words

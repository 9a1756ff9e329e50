"""Excluded links are not merged, after any change, until the constraint is withdrawn."""

import numpy as np
import pytest

from mapweave.hybridmap.change import Change, EdgePut, NodePut
from mapweave.hybridmap.constraint_subject import Apart
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.hybridmap.node import Edge, EdgeKind
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver.merging.merger import Merger
from mapweave.merge.explanation.map_explanation import explain_maps
from mapweave.merge.pose_graph.merged_map import MergedMap
from synthetic.maps import changes_of, looked_around, merger_of
from synthetic.world import room, take_map

A, B = MapId("a", 1), MapId("b", 1)
NOON = 1_772_366_400_000_000_000
"""2026-03-01 12:00 UTC."""


@pytest.fixture
def merger() -> Merger:
    """Two robots have looked around in one room."""
    return merger_of(looked_around((A, B), seed=3, stops=6))


def between(merged: MergedMap) -> set[tuple[NodeId, NodeId]]:
    return {link.pair for link in merged.links if not link.within}


def test_one_link_is_undone_and_comes_back(merger: Merger):
    before = merger.merged()
    pair = before.links[0].pair
    apart = ManualConstraint(Apart(pair), True, "anna", NOON, "two kitchens")
    merger.constrain(ManualConstraints([apart]))
    after = merger.merged()
    assert pair not in {link.pair for link in after.links}
    (refusal,) = [r for r in after.refused if r.pair == pair]
    assert refusal.reason == 'undone by anna on 2026-03-01 12:00 UTC: "two kitchens"'
    assert refusal.link is not None
    assert after.constraints.in_force == (apart,)
    merger.constrain(ManualConstraints([apart, ManualConstraint(Apart(pair), False, "bob", NOON + 1)]))
    again = merger.merged()
    assert [link.pair for link in again.links] == [link.pair for link in before.links]
    for node, place in before.poses.items():
        assert np.array_equal(
            place.merged_from_robot.mean.vector, again.poses[node].merged_from_robot.mean.vector
        )


def test_two_maps_are_kept_apart_and_new_links_do_not_join_them(merger: Merger):
    assert merger.merged().joined(A, B)
    merger.constrain(ManualConstraints([ManualConstraint(Apart((A, B)), True, "anna", NOON)]))
    apart = merger.merged()
    assert not between(apart) and not apart.joined(A, B)
    assert all("all links between a.1 and b.1" in r.reason for r in apart.refused if r.link is not None)
    node = merger.node(min(apart.components[0]))
    assert node is not None
    merger.on_change(Change(node.id.map, 99, 0, NodePut(node)))  # refined: its links are searched again
    assert not merger.merged().joined(A, B)


def test_unmerging_two_maps_joined_by_a_third_explains_how(merger: Merger):
    world = room(0, 0, 5, 4, 700, np.random.default_rng(3))
    third, rng = MapId("c", 1), np.random.default_rng(4)
    stops = [Pose2(2.45 + 0.05 * k, 2.05, 0.7 * k) for k in range(6)]
    for change in changes_of(*take_map(world, third, stops, rng)):
        merger.apply(third, change)
    joined = explain_maps(merger.merged(), A, B)
    assert "links join them" in joined.reason and joined.over == ()
    merger.constrain(ManualConstraints([ManualConstraint(Apart((A, B)), True, "anna", NOON)]))
    apart = explain_maps(merger.merged(), A, B)
    assert "by way of c.1; no link joins the two directly, by a manual constraint" in apart.reason
    assert "undo the links" in apart.reason
    assert apart.joined and apart.over == (third,)
    made = [ManualConstraint(Apart((A, other)), True, "anna", NOON) for other in (B, third)]
    merger.constrain(ManualConstraints(made))
    apart = explain_maps(merger.merged(), A, B)
    assert apart.reason.startswith("a.1 and b.1 are not one map") and apart.over == ()


def test_a_robot_s_own_loop_can_be_undone_and_its_way_cannot(merger: Merger):
    hybrid_map = merger.maps[A]
    nodes = sorted(hybrid_map.nodes)
    way = next(e for e in hybrid_map.edges.values() if {e.a, e.b} == set(nodes[:2]))
    true = hybrid_map.nodes[nodes[0]].map_from_robot.inverse() @ hybrid_map.nodes[nodes[4]].map_from_robot
    loop = Edge(NodeId("a", 1, 50), nodes[0], nodes[4], true, EdgeKind.LOOP)
    merger.apply(A, EdgePut(loop))
    assert loop.id in merger.merged().union().edges
    made = [ManualConstraint(Apart((nodes[0], nodes[k])), True, "anna", NOON) for k in (1, 4)]
    merger.constrain(ManualConstraints(made))
    merged = merger.merged()
    assert [r.pair for r in merged.refused if r.edge == loop.id] == [(nodes[0], nodes[4])]
    assert loop.id not in merged.union().edges and way.id in merged.union().edges
    assert loop.id in merged.maps[A].edges, "the maps themselves are kept whole"

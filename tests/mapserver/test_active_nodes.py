"""What questions are answered from: not from retired maps, not from landmarks that have gone."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from mapweave.hybridmap.change import Change, NodePut
from mapweave.hybridmap.constraint_subject import RetiredMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import Certainty, View
from mapweave.hybridmap.superseded import Superseded
from mapweave.mapserver import active_nodes
from mapweave.mapserver.active_nodes import ActiveNodes, without_faded
from mapweave.mapserver.answers import Answers
from mapweave.mapserver.merging.merger import Merger
from synthetic.maps import changes_of, numbered
from synthetic.world import World, room, take_map, take_view

HERE, THERE = MapId("a", 1), MapId("b", 1)
RETIRED = ManualConstraint(RetiredMap(THERE), True, "anna", 1, "rebuilt")


class Two:
    """Two robots in two rooms that share nothing."""

    def __init__(self) -> None:
        rng = np.random.default_rng(6)
        self.merger, self.worlds, self.truth = Merger(), dict[MapId, World](), dict[NodeId, Pose2]()
        for map_id in (HERE, THERE):
            self.worlds[map_id] = room(0, 0, 5, 4, 700, rng)
            tour = [Pose2(1.5 + 0.7 * k, 2.0, 0.2 * k) for k in range(3)]
            nodes, edges = take_map(self.worlds[map_id], map_id, tour, rng)
            self.truth |= {node.id: pose for node, pose in zip(nodes, tour, strict=True)}
            for change in numbered(map_id, changes_of(nodes, edges)):
                self.merger.on_change(change)

    def answers(self) -> Answers:
        return Answers.of(self.merger, self.merger.merged(), self.merger.node)

    def view(self, map_id: MapId) -> View:
        return take_view(self.worlds[map_id], Pose2(2.1, 1.95, 0.15), np.random.default_rng(1))[0]


@pytest.fixture(scope="module")
def two() -> Two:
    return Two()


def test_nothing_is_answered_from_a_retired_map_until_it_is_taken_back(two: Two):
    for constraints, known in (
        ([], True),
        ([RETIRED], False),
        ([RETIRED, replace(RETIRED, holds=False)], True),
    ):
        two.merger.constrain(ManualConstraints(constraints))
        answers = two.answers()
        assert answers.relocalizer.answer(two.view(HERE)).certainty is Certainty.FOUND
        there = answers.relocalizer.answer(two.view(THERE))
        assert (there.certainty is Certainty.FOUND) == known
        start, goal = (node for node in sorted(two.truth) if node.map == THERE and node.number in (1, 5))
        route = answers.router.route(start, goal)
        assert bool(route.legs) == known
        if not known:
            assert "retired by anna" in route.reason and '"rebuilt"' in route.reason
            assert "1 retired" in answers.merged.summary()


def certainties(merger: Merger, views: Sequence[View]) -> list[Certainty]:
    """Answers once it is known what all nodes look like, as on a server that has nothing else to do."""
    relocalizer = Answers.of(merger, merger.merged(), merger.node).relocalizer
    while relocalizer.prepare(50):
        pass
    return [relocalizer.answer(view).certainty for view in views]


@pytest.mark.slow
def test_after_a_map_is_retired_answers_are_as_before_it_came():
    rng = np.random.default_rng(4)
    world, maps = room(0, 0, 5, 4, 700, rng), [MapId(agent, 1) for agent in "abc"]
    logs: dict[MapId, list[Change]] = {}
    for map_id in maps:
        tour = [Pose2(*rng.uniform([1.2, 1.0], [3.8, 3.0]), 1.26 * k) for k in range(10)]
        logs[map_id] = numbered(map_id, changes_of(*take_map(world, map_id, tour, rng)))
    views = [take_view(world, Pose2(2.5, 2.0, 0.5 * k), rng)[0] for k in range(12)]
    merger, retired = Merger(), ManualConstraint(RetiredMap(maps[2]), True, "anna", 1, "moved")
    for map_id in maps[:2]:
        for change in logs[map_id]:
            merger.on_change(change)
    before = certainties(merger, views)
    for change in logs[maps[2]]:
        merger.on_change(change)
    with_it = certainties(merger, views)
    assert merger.merged().joined(maps[0], maps[2])
    merger.constrain(ManualConstraints([retired]))
    assert certainties(merger, views) == before and before.count(Certainty.FOUND) >= 8
    # A node that comes meanwhile looks like some of the retired map's, and that is known once it is taken
    # back.
    late = take_map(world, MapId("d", 1), [Pose2(2.3, 2.0, 0.6)], rng)[0]
    merger.on_change(Change(MapId("d", 1), 1, 0, NodePut(late[0])))
    certainties(merger, views)
    merger.constrain(ManualConstraints([retired, replace(retired, holds=False)]))
    assert certainties(merger, views) == with_it
    alike = merger.alike.of(late[0], merger.places, merger.node, lambda a, b: None)
    assert any(item.other.id.map == maps[2] for item in alike)


def test_a_retired_map_whose_robot_maps_on_stays_out(two: Two):
    two.merger.constrain(ManualConstraints([RETIRED]))
    merged = two.merger.merged()
    rng = np.random.default_rng(3)
    nodes, _ = take_map(two.worlds[THERE], THERE, [Pose2(2.0, 2.0, 0.1)], rng)
    late = replace(nodes[0], id=NodeId("b", 1, 99))
    two.merger.on_change(Change(THERE, 99, 0, NodePut(late)))
    places = ActiveNodes(two.merger.places, two.merger.node, merged)
    assert all(node.map == HERE for node, _ in places.query(two.view(THERE), 5))
    two.merger.constrain(ManualConstraints())
    assert any(node == late.id for node, _ in two.merger.places.query(two.view(THERE), 5))


def test_what_an_inactive_node_has_replaced_is_active(two: Two):
    two.merger.constrain(ManualConstraints())
    old, new = NodeId("a", 1, 1), NodeId("b", 1, 1)
    merged = replace(two.merger.merged(), superseded={old: Superseded(new, 30, 0.1, 0.1)})
    for set_apart, active in ((), False), ((new,), True):
        places = ActiveNodes(two.merger.places, two.merger.node, merged, set_apart)
        assert (old in dict(places.query(two.view(HERE), 5))) is active


def test_faded_landmarks_are_left_out_of_answers_and_routes(two: Two):
    two.merger.constrain(ManualConstraints())
    merged = two.merger.merged()
    node_id = NodeId("a", 1, 3)
    node = merged.maps[HERE].nodes[node_id]
    gone = np.zeros(len(node.landmarks), np.bool_)
    gone[::3] = True
    faded = replace(merged, faded={node_id: gone})
    shown = without_faded(node, faded)
    assert np.array_equal(shown.landmarks.pixels, node.landmarks.pixels[~gone])
    answers = Answers.of(two.merger, faded, two.merger.node)
    legs = answers.router.route(NodeId("a", 1, 1), NodeId("a", 1, 5)).legs
    assert [len(leg.node.landmarks) for leg in legs if leg.node.id == node_id] == [len(shown.landmarks)]
    assert ActiveNodes(two.merger.places, two.merger.node, merged).node(node_id) is node
    fresh = replace(node, landmarks=node.landmarks.take(np.arange(len(gone) - 1)))
    assert without_faded(fresh, faded) is fresh, "it is known better than what was found out"


def test_small_pieces_of_implausible_maps_answer_nothing(monkeypatch):
    """A robot of which all edges are refused leaves as many pieces as nodes, each a place of its own."""
    two = Two()
    merged = two.merger.merged()
    theirs = {node for node in two.truth if node.map == THERE}
    odd = replace(merged, implausible={THERE: "its clock utc runs backwards"})
    for which, least, hidden in ((merged, 4, set()), (odd, 4, theirs), (odd, len(theirs), set())):
        monkeypatch.setattr(active_nodes, "LEAST_NODES", least)
        active = ActiveNodes(two.merger.places, two.merger.node, which)
        assert {node for node in two.truth if active.node(node) is None} == hidden

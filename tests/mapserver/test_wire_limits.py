"""Values that messages have no room for cost one candidate, never the answer."""

from dataclasses import replace

import numpy as np
import pytest

from mapweave.hybridmap.change import Change, EdgePut, NodePut
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import Certainty, RelocalizeAnswer, RouteAnswer, RouteLeg, Whereabouts
from mapweave.mapserver.answers import Answers
from mapweave.mapserver.wire_limits import Pairs, drivable, within_range
from mapweave.wire.messages import decode, encode
from synthetic.maps import changes_of, merger_of
from synthetic.world import take_map
from tests.mapserver.test_active_nodes import HERE, Two

FAR = PoseGaussian.from_sigmas(Pose2(2e6, 0.0, 0.0), 0.01, 0.01)
NEAR = PoseGaussian.from_sigmas(Pose2(1.0, 2.0, 0.0), 0.01, 0.01)
C = MapId("c", 1)


def place(number: int, node_from_robot: PoseGaussian, merged_from_robot: PoseGaussian) -> Whereabouts:
    return Whereabouts(NodeId("a", 1, number), node_from_robot, merged_from_robot, 0, 20, 0.4)


@pytest.mark.parametrize(
    ("certainty", "places", "left"),
    [
        (Certainty.AMBIGUOUS, [(NEAR, NEAR), (FAR, NEAR)], (Certainty.AMBIGUOUS, [1])),
        (Certainty.AMBIGUOUS, [(FAR, NEAR), (NEAR, NEAR)], (Certainty.AMBIGUOUS, [2])),
        (Certainty.FOUND, [(NEAR, NEAR), (FAR, NEAR)], (Certainty.FOUND, [1])),
        (Certainty.FOUND, [(NEAR, FAR)], (Certainty.FOUND, [1])),
        (Certainty.FOUND, [(FAR, FAR), (NEAR, NEAR)], (Certainty.UNKNOWN, [])),
        (Certainty.UNKNOWN, [], (Certainty.UNKNOWN, [])),
    ],
)
def test_values_out_of_range_are_left_out(
    certainty: Certainty, places: list[tuple[PoseGaussian, PoseGaussian]], left: tuple[Certainty, list[int]]
):
    candidates = tuple(place(k, *poses) for k, poses in enumerate(places, start=1))
    answer = within_range(RelocalizeAnswer(certainty, candidates, "words"))
    back = decode(encode(answer), RelocalizeAnswer)
    assert (back.certainty, [candidate.node.number for candidate in back.candidates]) == left
    assert all(
        (candidate.merged_from_robot is None) == (candidate.component < 0) for candidate in back.candidates
    )


def test_a_node_where_no_robot_can_be_is_no_second_place():
    two, rng = Two(), np.random.default_rng(2)
    (node,), _ = take_map(two.worlds[HERE], C, [Pose2(2.1, 1.95, 0.15)], rng)
    (other,), _ = take_map(two.worlds[HERE], C, [Pose2(2.8, 2.0, 0.2)], rng)
    other = replace(
        other, id=NodeId("c", 1, 3), map_from_robot=PoseGaussian(Pose2(9.9e5, 0.0, 0.0), np.eye(3))
    )
    way = PoseGaussian.from_sigmas(Pose2(9.9e5, 0.0, 0.0), 0.1, 0.1)
    edge = Edge(NodeId("c", 1, 2), node.id, other.id, way, EdgeKind.MAPPED)
    for number, body in enumerate([NodePut(node), NodePut(other), EdgePut(edge)], start=1):
        two.merger.on_change(Change(C, number, 0, body))
    answer = two.answers().relocalizer.answer(two.view(HERE))
    assert answer.certainty is Certainty.FOUND and answer.candidates[0].node.map == HERE
    encode(within_range(answer))


def test_a_view_without_a_heading_is_not_published():
    two, rng = Two(), np.random.default_rng(2)
    tour = [Pose2(1.5 + 0.7 * k, 2.0, 0.2 * k) for k in range(4)]
    nodes, edges = take_map(two.worlds[HERE], C, tour, rng)
    merger = merger_of({HERE: two.merger.maps[HERE].contents(), C: changes_of(nodes, edges)})
    result = Answers.of(merger, merger.merged(), merger.node).known.answer(HERE, (0.0, 0.0), 50.0)
    assert len(result.views) == 4
    outside = replace(nodes[3], camera=replace(nodes[3].camera, cx=-40.0))
    merger.on_change(Change(C, 90, 0, NodePut(outside)))
    merged = merger.merged()
    assert merged.joined(HERE, C)
    result = Answers.of(merger, merged, merger.node).known.answer(HERE, (0.0, 0.0), 50.0)
    encode(result)
    assert len(result.views) == 3


def test_a_route_goes_around_legs_that_no_robot_drives():
    two = Two()
    start, middle, goal = sorted(two.truth)[:3]
    nodes = {name: two.merger.node(name) for name in (start, middle, goal)}
    asked: list[Pairs] = []

    def route(blocked: Pairs) -> RouteAnswer:
        asked.append(blocked)
        names = [start, goal] if (middle, goal) in blocked else [start, middle, goal]
        legs = []
        for k, name in enumerate(names):
            node = nodes[name]
            assert node is not None
            pose = FAR if names[k - 1 : k + 1] == [middle, goal] else NEAR
            legs.append(RouteLeg(node, pose, EdgeKind.MAPPED if k else None))
        return RouteAnswer(tuple(legs), "words")

    answer = drivable(route, [(goal, start)])
    assert [leg.node.id for leg in answer.legs] == [start, goal] and encode(answer)
    assert asked == [((goal, start),), ((goal, start), (middle, goal))]
    never = drivable(lambda blocked: route(()), ())
    assert not never.legs and "no robot drives" in never.reason and encode(never)

"""Which robots are around one: by what each says of itself, through the merged map."""

import math
from dataclasses import replace

import numpy as np
import pytest

from mapweave.hybridmap.change import Change, EdgePut, NodePut
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import EdgeId, MapId, NodeId
from mapweave.hybridmap.nearby import MAX_NEARBY, NearbyAnswer, NearbyRequest
from mapweave.hybridmap.node import Edge, EdgeKind
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.nearby import CELL, KEPT, MAP_SIGMA, Nearby
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.wire.messages import decode, encode
from tests.agent.scripted_fleet import bare

EXACT = np.diag([1e-4, 1e-4, 1e-4])
A, OTHER = MapId("a", 1), MapId("c", 1)
NODES = NodeId(*A, 1), NodeId(*A, 2), NodeId(*OTHER, 1)
PLACES = Pose2(0.0, 0.0, 0.3), Pose2(3.0, 1.0, -2.0), Pose2()
"""The first two nodes are joined by an edge, the third is on another map."""


@pytest.fixture(scope="module")
def merged() -> MergedMap:
    merger = Merger()
    for node, place in zip(NODES, PLACES, strict=True):
        put = NodePut(replace(bare(node), map_from_robot=PoseGaussian(place, EXACT)))
        merger.on_change(Change(node.map, node.number, 0, put))
    relative = PoseGaussian(PLACES[0].inverse() @ PLACES[1], EXACT)
    edge = Edge(EdgeId(*A, 3), NODES[0], NODES[1], relative, EdgeKind.MAPPED)
    merger.on_change(Change(A, 3, 0, EdgePut(edge)))
    return merger.merged()


def request(robot: str, number: int, pose: Pose2, *newer: NodeId) -> NearbyRequest:
    starts = (*((node, Pose2(9.0)) for node in newer), (NODES[number], pose))
    return NearbyRequest(robot, starts, 0.03, 0.02, 0.16, 0.3, 0.25)


def test_the_pose_is_the_others_as_the_asking_robot_sees_it(merged: MergedMap):
    nearby = Nearby()
    here, there = Pose2(0.5, 0.2, 1.0), Pose2(-0.4, 0.1, 0.7)
    assert nearby.ask(request("r0", 0, here), merged, 10.0).robots == ()
    unmerged = NodeId(*A, 99)
    (seen,) = nearby.ask(request("r1", 1, there, unmerged), merged, 10.4).robots
    expected = (PLACES[1] @ there).inverse() @ (PLACES[0] @ here)
    pose = seen.robot_from_other
    assert (pose.x, pose.y) == pytest.approx((expected.x, expected.y), abs=1e-6)
    assert math.cos(pose.heading - expected.heading) == pytest.approx(1.0)
    assert (seen.robot, seen.radius, seen.height, seen.speed) == ("r0", 0.16, 0.3, 0.25)
    assert seen.age == pytest.approx(0.4)
    aside = 0.02 * math.hypot(expected.x, expected.y)
    assert seen.sigma == pytest.approx(math.hypot(0.03, 0.03, aside, MAP_SIGMA))


def test_maps_that_are_not_joined_and_what_is_old_give_nothing(merged: MergedMap):
    nearby = Nearby()
    for robot, number in (("r0", 0), ("r1", 1), ("r2", 2)):
        nearby.ask(request(robot, number, Pose2()), merged, 0.0)
    assert [one.robot for one in nearby.ask(request("r0", 0, Pose2()), merged, 1.0).robots] == ["r1"]
    assert nearby.ask(request("r2", 2, Pose2()), merged, 1.0).robots == ()
    nearby.ask(request("r3", 0, Pose2(1.0)), merged, 1.0)
    assert [one.robot for one in nearby.ask(request("r0", 0, Pose2()), merged, 2.0).robots] == ["r3", "r1"]
    assert [one.robot for one in nearby.ask(request("r0", 0, Pose2()), merged, KEPT + 0.5).robots] == ["r3"]
    lost = NearbyRequest("r4", ((NodeId("z", 1, 1), Pose2()),), 0.0, 0.0, 0.1, 0.1, 0.1)
    assert "merged map yet" in nearby.ask(lost, merged, 2.0).reason


def test_near_robots_are_those_that_a_search_of_all_finds(merged: MergedMap):
    """Over the cells' borders, after moves, and with more robots than are remembered."""
    random, nearby, at = np.random.default_rng(0), Nearby(), dict[str, Pose2]()
    for tick in range(400):
        robot, pose = f"r{random.integers(60)}", Pose2(*random.uniform(-40, 40, 2).tolist(), 0.0)
        answer = nearby.ask(request(robot, 0, pose), merged, 0.01 * tick)
        at.pop(robot, None)
        near = sorted(at, key=lambda name: (pose.distance(at[name]), name))
        expected = [name for name in near if pose.distance(at[name]) < CELL][:MAX_NEARBY]
        assert [one.robot for one in answer.robots][: len(expected)] == expected
        at[robot] = pose


def test_robots_without_end_are_not_remembered(merged: MergedMap, monkeypatch):
    monkeypatch.setattr("mapweave.mapserver.nearby.MOST_ROBOTS", 5)
    nearby = Nearby()
    for k in range(40):
        answer = nearby.ask(request(f"r{k}", 0, Pose2(0.1 * k)), merged, 0.1 * k)
        assert [one.robot for one in answer.robots] == [f"r{n}" for n in range(k - 1, max(k - 6, -1), -1)]


def test_the_order_of_those_that_ask_at_once_changes_no_answer(merged: MergedMap):
    def play(*order: str) -> dict[tuple[str, float], NearbyAnswer]:
        nearby, out = Nearby(), {}
        for now in (0.0, 0.5, 1.0):
            for robot in order:
                pose = Pose2(now, 0.0, 0.1)
                out[robot, now] = nearby.ask(request(robot, int(robot[1]) % 2, pose), merged, now)
        return out

    assert play("r0", "r1", "r3") == play("r3", "r1", "r0")


def test_only_a_robot_seen_twice_at_one_place_stands_at_a_node(merged: MergedMap):
    """Robots of 0.16 m around the second node, (3, 1), seen from both nodes of the map."""
    nearby = Nearby()
    from_first = PLACES[0].inverse() @ PLACES[1]
    for now in (10.0, 15.0):
        nearby.ask(request("stands", 1, Pose2(0.2, 0.2)), merged, now)
        nearby.ask(request("too far", 1, Pose2(0.25, 0.25)), merged, now)
        nearby.ask(request("drives", 1, Pose2(0.012 * now, 0.0)), merged, now)
        nearby.ask(request("elsewhere", 2, PLACES[1]), merged, now)
        nearby.ask(request("of the first", 0, from_first), merged, now)
    nearby.ask(request("once", 1, Pose2()), merged, 15.0)

    def standing(number: int, radius: float, now: float) -> list[str]:
        place = np.array([[PLACES[number].x, PLACES[number].y]])
        return [one.robot for one in nearby.standing(place, 0, radius, merged, now)]

    assert merged.component_of(NODES[0]) == merged.component_of(NODES[1]) == 0
    assert standing(1, 0.16, 16.0) == ["of the first", "stands"]
    assert standing(1, 0.0, 16.0) == ["of the first"], "a smaller one has room"
    assert standing(0, 0.16, 16.0) == []
    assert standing(1, 0.16, 15.1 + KEPT) == [], "who is silent is gone"


def test_a_robot_has_left_once_it_is_known_elsewhere(merged: MergedMap):
    nearby, frame = Nearby(), merged.graphs[0].anchor
    there = PLACES[1].x, PLACES[1].y

    def left(now: float, reach: float = 0.4) -> bool:
        return nearby.left("r1", there, reach, frame, now)

    assert not left(1.0), "nothing is known of it"
    nearby.ask(request("r1", 1, Pose2(0.3)), merged, 1.0)
    assert not left(1.5) and left(1.5, 0.2)
    nearby.ask(request("r1", 1, Pose2(0.5)), merged, 2.0)
    assert left(2.5) and not left(2.1 + KEPT), "what is old says nothing"
    nearby.ask(request("r1", 2, Pose2()), merged, 3.0)
    assert left(3.5), "it is on another map"


@pytest.mark.parametrize("field", ["radius", "height"])
def test_no_robot_is_as_large_as_a_room(field: str):
    """It would stand in the way of all others, and in all of their images."""
    honest = NearbyRequest("r0", ((NodeId("r0", 1, 1), Pose2()),), 9.0, 0.02, 0.16, 0.3, 0.25)
    assert decode(encode(honest), NearbyRequest) == honest
    with pytest.raises(InvalidValue, match=field):
        encode(replace(honest, **{field: 6.0}))

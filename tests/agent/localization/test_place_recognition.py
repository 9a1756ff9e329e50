"""Recognising places of the own map among others that are alike, in a world with known truth."""

import math
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from mapweave import HybridMap, Landmarks, MapId, NodeId, Pose2, View
from mapweave.agent.localization import place_recognition
from mapweave.agent.localization.place_recognition import aliased_places, recognise_places
from mapweave.hybridmap.change import NodePut
from synthetic.world import CAMERA, World, room, take_map, take_view

HEADINGS = np.arange(0, 2 * math.pi, math.pi / 4)


@pytest.fixture(scope="module")
def world() -> World:
    """Two rooms."""
    rng = np.random.default_rng(0)
    return room(0, 0, 5, 4, 900, rng) + room(20, 0, 4, 5, 900, rng)


@pytest.fixture(scope="module")
def tour() -> list[Pose2]:
    """A look around in the first room, then in the second."""
    first = [Pose2(2.5, 2.0, h) for h in HEADINGS]
    return first + [Pose2(22.0, 2.5, h) for h in HEADINGS]


@pytest.fixture(scope="module")
def own_map(world: World, tour: list[Pose2]) -> HybridMap:
    """The map of that tour."""
    nodes, _ = take_map(world, MapId("r0", 1), tour, np.random.default_rng(1))
    return HybridMap([NodePut(node) for node in nodes])


@pytest.mark.parametrize("seed", range(6))
def test_a_view_is_recognised_where_it_was_taken(world, tour, own_map, seed):
    rng = np.random.default_rng(seed)
    near = tour[int(rng.integers(len(tour)))]
    true = near @ Pose2(*rng.uniform([-0.3, -0.3, -0.2], [0.3, 0.3, 0.2]))
    view, _ = take_view(world, true, rng)
    node, recognition = recognise_places(own_map, view, rng)[0]
    place = tour[(node.id.number - 1) // 2]
    answered = place @ recognition.node_from_robot.mean
    assert answered.distance(true) < 0.10
    assert abs((answered.inverse() @ true).heading) < math.radians(2)
    assert recognition.node_from_robot.mahalanobis2(place.inverse() @ true) < 25
    assert recognition.inliers >= place_recognition.LEAST_INLIERS


def test_the_node_with_the_most_inliers_is_named(world, tour, own_map, monkeypatch):
    monkeypatch.setattr(place_recognition, "TRIES", 16)
    monkeypatch.setattr(place_recognition, "VOTES", 1)
    rng = np.random.default_rng(3)
    view, _ = take_view(world, tour[3], rng)
    assert recognise_places(own_map, view, rng)[0][0].id.number == 2 * 3 + 1


def test_a_room_that_was_never_mapped_is_not_recognised(own_map):
    for seed in range(8):
        rng = np.random.default_rng(100 + seed)
        elsewhere = room(0, 0, 5, 4, 900, rng)
        view, _ = take_view(elsewhere, Pose2(2.5, 2.0, float(rng.uniform(-3, 3))), rng)
        assert len(view) > 50
        assert not recognise_places(own_map, view, rng)


def test_nothing_to_recognise(world, own_map):
    rng = np.random.default_rng(0)
    view, _ = take_view(world, Pose2(2.5, 2.0), rng)
    empty = View(np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8), CAMERA)
    assert not recognise_places(HybridMap(), view, rng)
    assert not recognise_places(own_map, empty, rng)
    (first, *_) = own_map.nodes.values()
    bare = HybridMap([NodePut(replace(first, landmarks=Landmarks.empty()))])
    assert not recognise_places(bare, view, rng)
    also_bare = HybridMap(
        [*own_map.contents(), NodePut(replace(first, id=NodeId("r0", 1, 999), landmarks=Landmarks.empty()))]
    )
    assert recognise_places(also_bare, view, rng)


@pytest.mark.parametrize(("limit", "value"), [("VOTES", 10_000), ("TRIES", 0), ("LEAST_INLIERS", 10_000)])
def test_the_limits_are_heeded(world, own_map, monkeypatch, limit, value):
    rng = np.random.default_rng(0)
    view, _ = take_view(world, Pose2(2.5, 2.0, 0.05), rng)
    assert recognise_places(own_map, view, rng)
    monkeypatch.setattr(place_recognition, limit, value)
    assert not recognise_places(own_map, view, rng)


def test_the_same_chance_gives_the_same_answer(world, own_map):
    view, _ = take_view(world, Pose2(22.1, 2.4, 1.0), np.random.default_rng(0))
    a, b = (recognise_places(own_map, view, np.random.default_rng(5))[0] for _ in range(2))
    assert a[0].id == b[0].id
    assert np.array_equal(a[1].pairs, b[1].pairs)
    assert a[1].node_from_robot.mean == b[1].node_from_robot.mean


@pytest.mark.parametrize("at_once", [1, 5, 1000])
def test_it_does_not_matter_how_many_nodes_are_compared_at_once(world, own_map, monkeypatch, at_once):
    view, _ = take_view(world, Pose2(22.1, 2.4, 1.0), np.random.default_rng(0))
    a = recognise_places(own_map, view, np.random.default_rng(5))
    monkeypatch.setattr(place_recognition, "NODES_AT_ONCE", at_once)
    b = recognise_places(own_map, view, np.random.default_rng(5))
    assert [(node.id, recognition.inliers) for node, recognition in a] == [
        (node.id, recognition.inliers) for node, recognition in b
    ]


def test_a_large_map_takes_no_more_memory_than_a_small_one(world, own_map):
    """Before, the descriptors of all nodes were decoded at once: 330 MB of 2000 nodes."""
    view, _ = take_view(world, Pose2(22.1, 2.4, 1.0), np.random.default_rng(0))

    def peak(copies: int) -> int:
        nodes = [
            replace(node, id=NodeId("r0", 1, 1000 * k + node.id.number))
            for k in range(copies)
            for node in own_map.nodes.values()
        ]
        large = HybridMap([NodePut(node) for node in nodes])
        recognise_places(large, view, np.random.default_rng(5))
        tracemalloc.start()
        recognise_places(large, view, np.random.default_rng(5))
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return most

    assert peak(24) < 1.2 * peak(4)


def test_two_similar_places_are_reported_and_neighbours_are_not(world, own_map):
    """One node knows two landmarks of three, the other, a little aside or in another room, the third."""
    view, _ = take_view(world, Pose2(2.5, 2.0), np.random.default_rng(0))
    whole = next(iter(own_map.nodes.values()))
    third = np.arange(len(whole.landmarks)) % 3 == 0
    node, rest = replace(whole, landmarks=whole.landmarks.take(~third)), whole.landmarks.take(third)

    def recalled(aside: float):
        pose = replace(node.map_from_robot, mean=node.map_from_robot.mean @ Pose2(0.0, aside))
        b = replace(node, id=node.id._replace(number=99), map_from_robot=pose, landmarks=rest)
        places = recognise_places(HybridMap([NodePut(node), NodePut(b)]), view, np.random.default_rng(0))
        assert [a.id.number for a, _ in places] == [node.id.number, 99]
        return places

    far, near = recalled(3.0), recalled(0.2)
    share = far[1][1].inliers / far[0][1].inliers
    assert 0.3 < share < 0.7
    result = aliased_places(far, 0.9 * share, 0.5)
    assert result is not None
    assert [a.id.number for a in result] == [node.id.number, 99]
    assert aliased_places(far, 1.1 * share, 0.5) is None, "it is not seen about as well"
    assert aliased_places(near, 0.9 * share, 0.5) is None, "it is not elsewhere"
    assert aliased_places(far[:1], 0.1, 0.5) is None
    assert aliased_places([], 0.1, 0.5) is None

"""Which pairs are worth a look."""

import numpy as np

from mapweave.hybridmap.descriptor import decode
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.merge.pose_graph.candidates import overlap
from synthetic.world import room, take_map, take_node
from tests.merge.pose_graph.all_pairs import choose_pairs, overlaps

HERE = PoseGaussian.from_sigmas(Pose2(), 0.01, 0.01)


def test_overlap_against_a_double_loop() -> None:
    rng = np.random.default_rng(1)
    world = room(0, 0, 5, 4, 600, rng)
    a = take_node(world, NodeId("a", 1, 1), Pose2(2, 2, 0), HERE, rng)
    b = take_node(world, NodeId("b", 1, 1), Pose2(2.3, 2, 0.1), HERE, rng)
    first, second = decode(a.landmarks.codes), decode(b.landmarks.codes)
    best_a, best_b = np.zeros(len(first)), np.zeros(len(second))
    for i in range(len(first)):
        for j in range(len(second)):
            weight = 1 - float(((first[i] - second[j]) ** 2).sum()) / 0.25
            best_a[i], best_b[j] = max(best_a[i], weight), max(best_b[j], weight)
    table = overlaps([b, a])
    expected = min(best_a.sum(), best_b.sum())
    assert expected > 10
    assert np.isclose(table[a.id, b.id], expected, rtol=1e-4)
    assert overlap(np.zeros(0, int), np.zeros(0, int), np.zeros(0), 0.5) == 0.0


def test_true_overlaps_rank_above_chance_and_neighbours_are_left_out() -> None:
    rng = np.random.default_rng(2)
    world = room(0, 0, 5, 4, 600, rng)
    tour = [Pose2(1.5 + 0.1 * k, 2, 0.1 * k) for k in range(6)]
    nodes, edges = take_map(world, MapId("a", 1), tour, rng)
    elsewhere, more = take_map(room(0, 0, 5, 4, 600, rng), MapId("b", 1), tour, rng)
    table = overlaps([*nodes, *elsewhere])
    assert table and all(a.map == b.map for a, b in table)
    chosen = choose_pairs(table, [*edges, *more], least_hops=3)
    assert chosen
    assert all((b.number - a.number) // 2 >= 3 for a, b in chosen)


def test_only_the_best_of_each_map_are_chosen() -> None:
    ids = [NodeId("a", 1, 1), *(NodeId("b", 1, k) for k in range(1, 8)), NodeId("c", 1, 1)]
    table = {(ids[0], other): 10.0 + other.number for other in ids[1:]}
    chosen = choose_pairs(table, (), most_per_map=2)
    # Each b has only this one pair, so it is among the best of b: the limit is on both ends together.
    assert len(chosen) == 8
    table |= {(NodeId("a", 1, 2), other): 50.0 for other in ids[1:8]}
    table |= {(NodeId("a", 1, 3), other): 60.0 for other in ids[1:8]}
    chosen = choose_pairs(table, (), most_per_map=2)
    assert [b.number for a, b in chosen if a == ids[0] and b.agent == "b"] == [6, 7]

"""The choice of pairs: which are worth a look, and change by change against a fresh choice."""

import numpy as np
import pytest

from mapweave.hybridmap.ids import EdgeId, MapId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.merge.pose_graph.candidates import Pair
from mapweave.merge.pose_graph.pairs import PairTable
from synthetic.world import room, take_map
from tests.merge.pose_graph.all_pairs import choose_pairs, overlaps

STEP = PoseGaussian.from_sigmas(Pose2(), 0.1, 0.1)


@pytest.mark.parametrize("seed", range(6))
def test_it_agrees_with_a_fresh_choice(seed: int):
    """Nodes and edges come and go, nodes are refined; every change is returned once."""
    rng = np.random.default_rng(seed)
    limits = 2, int(rng.integers(1, 4))
    nodes = [NodeId("abc"[k % 3], 1, k) for k in range(24)]
    table, overlaps, edges = PairTable(*limits), dict[Pair, float](), dict[EdgeId, Edge]()
    known: set[Pair] = set()
    there: set[NodeId] = set()
    for number in range(150):
        what = rng.random()
        node = nodes[int(rng.integers(len(nodes)))]
        if what < 0.5:
            result = {n: float(rng.uniform(2, 9)) for n in there - {node} if rng.random() < 0.4}
            table.forget(node)
            table.put(node, result)
            there.add(node)
            overlaps = {pair: value for pair, value in overlaps.items() if node not in pair}
            overlaps |= {(min(node, n), max(node, n)): value for n, value in result.items()}
        elif what < 0.6:
            table.forget(node)
            there.discard(node)
            overlaps = {pair: value for pair, value in overlaps.items() if node not in pair}
        elif what < 0.85 or not edges:
            other = nodes[int(rng.integers(len(nodes)))]
            edge = Edge(EdgeId("e", 1, number), node, other, STEP, EdgeKind.MAPPED)
            edges[edge.id] = edge
            table.connect(edge.a, edge.b)
        else:
            gone = edges.pop(list(edges)[int(rng.integers(len(edges)))])
            table.disconnect(gone.a, gone.b)
        if what < 0.6 and rng.random() < 0.5:
            near = [p for p in choose_pairs(overlaps, edges.values(), *limits) if node in p]
            assert table.of(node) == near
        if rng.random() < 0.4:
            wanted = set(choose_pairs(overlaps, edges.values(), *limits))
            changed = set(table.changed())
            assert changed >= wanted ^ known
            assert all((pair in table) == (pair in wanted) for pair in changed | wanted | known)
            known = wanted


def test_a_refined_node_is_compared_again():
    a, b = NodeId("a", 1, 1), NodeId("b", 1, 1)
    table = PairTable()
    table.put(a, {})
    table.put(b, {a: 5.0})
    assert table.changed() == [(a, b)] and table.changed() == []
    table.forget(b)
    table.put(b, {a: 6.0})
    assert table.changed() == [(a, b)] and (a, b) in table


HERE = PoseGaussian.from_sigmas(Pose2(), 0.01, 0.01)


def test_true_overlaps_rank_above_chance_and_neighbours_are_left_out():
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


def test_only_the_best_of_each_map_are_chosen():
    ids = [NodeId("a", 1, 1), *(NodeId("b", 1, k) for k in range(1, 8)), NodeId("c", 1, 1)]
    table = {(ids[0], other): 10.0 + other.number for other in ids[1:]}
    chosen = choose_pairs(table, (), most_per_map=2)
    # Each b has only this one pair, so it is among the best of b: the limit is on both ends together.
    assert len(chosen) == 8
    table |= {(NodeId("a", 1, 2), other): 50.0 for other in ids[1:8]}
    table |= {(NodeId("a", 1, 3), other): 60.0 for other in ids[1:8]}
    chosen = choose_pairs(table, (), most_per_map=2)
    assert [b.number for a, b in chosen if a == ids[0] and b.agent == "b"] == [6, 7]

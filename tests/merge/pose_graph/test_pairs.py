"""The choice of pairs, change by change, against a fresh choice."""

import numpy as np
import pytest

from mapweave.hybridmap.ids import EdgeId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.merge.pose_graph.candidates import Pair
from mapweave.merge.pose_graph.pairs import PairTable
from tests.merge.pose_graph.all_pairs import choose_pairs

STEP = PoseGaussian.from_sigmas(Pose2(), 0.1, 0.1)


@pytest.mark.parametrize("seed", range(6))
def test_it_agrees_with_a_fresh_choice(seed: int) -> None:
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


def test_a_refined_node_is_compared_again() -> None:
    a, b = NodeId("a", 1, 1), NodeId("b", 1, 1)
    table = PairTable()
    table.put(a, {})
    table.put(b, {a: 5.0})
    assert table.changed() == [(a, b)] and table.changed() == []
    table.forget(b)
    table.put(b, {a: 6.0})
    assert table.changed() == [(a, b)] and (a, b) in table

"""The map as the replay of its log."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave.hybridmap.change import ChangeBody, EdgePut, EdgeRetired, NodePut, NodeRetired
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Edge, EdgeKind, Landmarks, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from synthetic.world import CAMERA


def node(number: int) -> Node:
    pose = PoseGaussian.from_sigmas(Pose2(number, 0, 0), 0.01, 0.01)
    return Node(NodeId("r0", 1, number), 0, pose, CAMERA, Landmarks.empty())


def edge(number: int, a: int, b: int, sigma: float = 0.1) -> Edge:
    relative = PoseGaussian.from_sigmas(Pose2(b - a, 0.1, 0.2), sigma, sigma)
    return Edge(NodeId("r0", 1, number), NodeId("r0", 1, a), NodeId("r0", 1, b), relative, EdgeKind.MAPPED)


numbers = st.integers(0, 5)
bodies = st.one_of(
    st.builds(lambda k: NodePut(node(k)), numbers),
    st.builds(lambda k: NodeRetired(NodeId("r0", 1, k)), numbers),
    st.builds(lambda k, a, b: EdgePut(edge(100 + k, a, b)), numbers, numbers, numbers),
    st.builds(lambda k: EdgeRetired(NodeId("r0", 1, 100 + k)), numbers),
)


@settings(max_examples=60, deadline=None)
@given(st.lists(bodies, max_size=25))
def test_contents_are_a_log_of_the_same_map(log: list[ChangeBody]) -> None:
    first = HybridMap(log)
    again = HybridMap(first.contents())
    assert set(first.nodes) == set(again.nodes)
    assert first.edges == again.edges
    # Graph and edges agree at every moment.
    keys = {key for _, _, key in first.graph.edges(keys=True)}
    assert keys == set(first.edges)
    for key, one in first.edges.items():
        assert first.graph.has_edge(one.a, one.b, key=key)


@settings(max_examples=60, deadline=None)
@given(st.lists(bodies, max_size=20), bodies)
def test_applying_a_change_twice_changes_nothing_more(log: list[ChangeBody], body: ChangeBody) -> None:
    once, twice = HybridMap([*log, body]), HybridMap([*log, body, body])
    assert set(once.nodes) == set(twice.nodes)
    assert once.edges == twice.edges
    assert once.graph.number_of_edges() == twice.graph.number_of_edges()


def test_retiring_a_node_takes_its_edges_along() -> None:
    hybrid_map = HybridMap(
        [NodePut(node(1)), NodePut(node(2)), EdgePut(edge(9, 1, 2)), NodeRetired(node(2).id)]
    )
    assert not hybrid_map.edges
    assert hybrid_map.components() == [{node(1).id}]


def test_edge_between_takes_the_most_certain_and_the_direction_asked() -> None:
    hybrid_map = HybridMap(
        [NodePut(node(1)), NodePut(node(2)), EdgePut(edge(8, 1, 2, 0.5)), EdgePut(edge(9, 2, 1, 0.1))]
    )
    there = hybrid_map.edge_between(node(1).id, node(2).id)
    assert there is not None
    expected = edge(9, 2, 1, 0.1).a_from_b.inverse()
    assert np.allclose(there.mean.vector, expected.mean.vector)
    assert hybrid_map.edge_between(node(1).id, NodeId("r0", 1, 5)) is None


def test_components_are_largest_first() -> None:
    hybrid_map = HybridMap([*(NodePut(node(k)) for k in range(4)), EdgePut(edge(9, 2, 3))])
    assert [len(part) for part in hybrid_map.components()] == [2, 1, 1]

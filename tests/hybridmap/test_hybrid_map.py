"""The map as the replay of its log."""

import sys

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave.hybridmap.change import ChangeBody, EdgePut, EdgeRetired, NodePut, NodeRetired
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Edge, EdgeKind, Landmarks, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.route import RouteTable
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
def test_contents_are_a_log_of_the_same_map(log: list[ChangeBody]):
    first = HybridMap(log)
    again = HybridMap(first.contents())
    assert set(first.nodes) == set(again.nodes)
    assert first.edges == again.edges
    # Graph and edges agree at every moment.
    graph = first.graph()
    assert {key for _, _, key in graph.edges(keys=True)} == set(first.edges)
    for key, one in first.edges.items():
        assert graph.has_edge(one.a, one.b, key=key)


@settings(max_examples=60, deadline=None)
@given(st.lists(bodies, max_size=20), bodies)
def test_applying_a_change_twice_changes_nothing_more(log: list[ChangeBody], body: ChangeBody):
    once, twice = HybridMap([*log, body]), HybridMap([*log, body, body])
    assert set(once.nodes) == set(twice.nodes)
    assert once.edges == twice.edges
    assert once.graph().number_of_edges() == twice.graph().number_of_edges()


def replayed(log: list[ChangeBody]) -> nx.MultiGraph:
    """The reachability graph by networkx alone."""
    graph: nx.MultiGraph = nx.MultiGraph()
    for body in log:
        keys = {key: (a, b) for a, b, key in graph.edges(keys=True)}
        match body:
            case NodePut(one):
                graph.add_node(one.id)
            case NodeRetired(node_id) if node_id in graph:
                graph.remove_node(node_id)
            case EdgePut(one):
                if one.id in keys:
                    graph.remove_edge(*keys[one.id], key=one.id)
                graph.add_edge(one.a, one.b, key=one.id)
            case EdgeRetired(edge_id) if edge_id in keys:
                graph.remove_edge(*keys[edge_id], key=edge_id)
    return graph


@settings(max_examples=200, deadline=None)
@given(st.lists(bodies, max_size=40))
def test_the_graph_is_that_of_networkx(log: list[ChangeBody]):
    hybrid_map = HybridMap()
    for body in log:
        dropped = list(hybrid_map.dropped_by(body))
        before = set(hybrid_map.edges.values())
        hybrid_map.apply(body)
        assert before - set(hybrid_map.edges.values()) <= set(dropped) <= before
    expected, graph = replayed(log), hybrid_map.graph()
    assert nx.utils.graphs_equal(graph, expected)
    assert list(graph.nodes) == list(expected.nodes)
    # In the same order: what is found first of several that are alike is found by both.
    for node_id in expected:
        assert list(hybrid_map.neighbours(node_id)) == list(expected[node_id])
        at = [key for _, _, key in expected.edges(node_id, keys=True)]
        assert [one.id for one in hybrid_map.edges_at(node_id)] == at
        for other in expected:
            between = expected.get_edge_data(node_id, other) or ()
            assert [one.id for one in hybrid_map.edges_between(node_id, other)] == [*between]
    present = expected.subgraph(hybrid_map.nodes)
    components = hybrid_map.components()
    assert {frozenset(part) for part in components} == {*map(frozenset, nx.connected_components(present))}
    assert sorted(map(len, components), reverse=True) == [*map(len, components)]


def test_what_robots_ask_of_their_map_loads_no_networkx(monkeypatch):
    monkeypatch.setitem(sys.modules, "networkx", None)
    hybrid_map = HybridMap(
        [*(NodePut(node(k)) for k in range(4)), EdgePut(edge(8, 0, 1)), EdgePut(edge(9, 1, 2))]
    )
    first, third, lonely = (node(k).id for k in (0, 2, 3))
    assert len(RouteTable(hybrid_map).find(first, third).edges) == 2
    assert "nothing joins" in RouteTable(hybrid_map).find(first, lonely).reason
    assert "blocked" in RouteTable(hybrid_map, blocked=[(node(1).id, third)]).find(first, third).reason
    assert len(hybrid_map.components()) == 2
    hybrid_map.apply(NodeRetired(node(1).id))
    assert not hybrid_map.edges
    with pytest.raises(ImportError):
        hybrid_map.graph()


def test_retiring_a_node_takes_its_edges_along():
    hybrid_map = HybridMap(
        [NodePut(node(1)), NodePut(node(2)), EdgePut(edge(9, 1, 2)), NodeRetired(node(2).id)]
    )
    assert not hybrid_map.edges
    assert hybrid_map.components() == [{node(1).id}]


def test_edge_between_takes_the_most_certain_and_the_direction_asked():
    hybrid_map = HybridMap(
        [NodePut(node(1)), NodePut(node(2)), EdgePut(edge(8, 1, 2, 0.5)), EdgePut(edge(9, 2, 1, 0.1))]
    )
    there = hybrid_map.edge_between(node(1).id, node(2).id)
    assert there is not None
    expected = edge(9, 2, 1, 0.1).a_from_b.inverse()
    assert np.allclose(there.mean.vector, expected.mean.vector)
    assert hybrid_map.edge_between(node(1).id, NodeId("r0", 1, 5)) is None


def test_components_are_largest_first():
    hybrid_map = HybridMap([*(NodePut(node(k)) for k in range(4)), EdgePut(edge(9, 2, 3))])
    assert [len(part) for part in hybrid_map.components()] == [2, 1, 1]

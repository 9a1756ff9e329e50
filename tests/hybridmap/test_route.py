"""Routes against Dijkstra on random maps."""

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import EdgeId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind, Landmarks, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.route import RouteSettings, RouteTable, edge_cost
from synthetic.maps import changes_of
from synthetic.world import CAMERA


def node(number: int, pose: Pose2, agent: str = "r0") -> Node:
    pose_vector = PoseGaussian.from_sigmas(pose, 0.01, 0.01)
    return Node(NodeId(agent, 1, number), 0, pose_vector, CAMERA, Landmarks.empty())


def edge(number: int, a: Node, b: Node, kind: EdgeKind = EdgeKind.MAPPED) -> Edge:
    relative = a.map_from_robot.mean.inverse() @ b.map_from_robot.mean
    return Edge(NodeId("e", 1, number), a.id, b.id, PoseGaussian.from_sigmas(relative, 0.01, 0.01), kind)


def random_map(seed: int, n: int = 14, m: int = 22) -> HybridMap:
    rng = np.random.default_rng(seed)
    nodes = [node(k, Pose2(*rng.uniform([0, 0, -3], [9, 9, 3]))) for k in range(n)]
    edges = []
    for k in range(m):
        a, b = rng.choice(n, 2, replace=False)
        edges.append(edge(k, nodes[a], nodes[b], EdgeKind.TURNED if k % 5 == 0 else EdgeKind.MAPPED))
    return HybridMap(changes_of(nodes, edges))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.booleans())
def test_costs_no_more_than_dijkstra(seed: int, optimised: bool):
    hybrid_map = random_map(seed)
    rng = np.random.default_rng(seed)
    poses = {i: n.map_from_robot.mean for i, n in hybrid_map.nodes.items()}
    if optimised:
        poses = {i: p @ Pose2(*rng.normal(0, 1.0, 3)) for i, p in poses.items()}
    penalties = {edge_id: float(rng.uniform(0, 3)) for edge_id in hybrid_map.edges}
    graph: nx.MultiGraph = nx.MultiGraph()
    for e in hybrid_map.edges.values():
        cost = edge_cost(e, poses, True, RouteSettings()) + penalties[e.id]
        assert cost >= poses[e.a].distance(poses[e.b])
        graph.add_edge(e.a, e.b, weight=cost)
    start, goal = NodeId("r0", 1, 0), NodeId("r0", 1, 13)
    result = RouteTable(hybrid_map, poses=poses if optimised else None, penalties=penalties).find(start, goal)
    if start in graph and goal in graph and nx.has_path(graph, start, goal):
        assert result.cost == pytest.approx(nx.dijkstra_path_length(graph, start, goal))
        assert result.nodes[0] == start and result.nodes[-1] == goal
        for a, edge_id, b in zip(result.nodes[:-1], result.edges, result.nodes[1:], strict=True):
            assert {hybrid_map.edges[edge_id].a, hybrid_map.edges[edge_id].b} == {a, b}
    else:
        assert result.nodes == () and result.reason


def chain(*poses: Pose2) -> tuple[list[Node], HybridMap]:
    nodes = [node(k, pose) for k, pose in enumerate(poses)]
    edges = [edge(100 + k, nodes[k], nodes[k + 1]) for k in range(len(nodes) - 1)]
    return nodes, HybridMap(changes_of(nodes, edges))


def test_blocked_pairs_are_gone_around_in_either_order():
    nodes, one = chain(Pose2(0, 0), Pose2(1, 0), Pose2(2, 0), Pose2(2, 3))
    one.apply(EdgePut(edge(200, nodes[0], nodes[3])))
    one.apply(EdgePut(edge(201, nodes[3], nodes[2])))
    assert len(RouteTable(one).find(nodes[0].id, nodes[2].id).edges) == 2
    around = RouteTable(one, blocked=[(nodes[2].id, nodes[1].id)]).find(nodes[0].id, nodes[2].id)
    assert around.nodes == (nodes[0].id, nodes[3].id, nodes[2].id)
    barred = [(nodes[1].id, nodes[2].id), (nodes[3].id, nodes[2].id)]
    nowhere = RouteTable(one, blocked=barred).find(nodes[0].id, nodes[2].id)
    assert nowhere.nodes == () and nowhere.reason.endswith(" is blocked (2 pairs)")


def test_turning_costs():
    nodes, one = chain(Pose2(0, 0, 0), Pose2(0, 0, 3.0))
    s = RouteSettings(per_edge=0.1, per_turn=0.4)
    assert RouteTable(one, settings=s).find(nodes[0].id, nodes[1].id).cost == pytest.approx(0.1 + 0.4 * 3.0)


def test_of_two_edges_the_cheaper_is_driven():
    nodes, one = chain(Pose2(0, 0), Pose2(1, 0))
    one.apply(EdgePut(edge(5, nodes[0], nodes[1])))
    route = RouteTable(one, penalties={NodeId("e", 1, 5): 1.0}).find(nodes[0].id, nodes[1].id)
    assert route.edges == (NodeId("e", 1, 100),)


def test_a_driven_link_costs_its_length():
    """Two metres across a room, and a detour of four: the link is taken once it was driven, not before."""
    places = [Pose2(0, 0), Pose2(2, 0), Pose2(1, 1.7)]
    nodes = [node(k, place) for k, place in enumerate(places)]
    edges = [
        edge(1, nodes[0], nodes[1], EdgeKind.LOOP),
        edge(2, nodes[0], nodes[2]),
        edge(3, nodes[2], nodes[1]),
    ]
    hybrid_map = HybridMap(changes_of(nodes, edges))
    around = RouteTable(hybrid_map).find(nodes[0].id, nodes[1].id)
    assert around.edges == (edges[1].id, edges[2].id)
    hybrid_map.apply(EdgePut(edge(4, nodes[0], nodes[1], EdgeKind.DRIVEN)))
    straight = RouteTable(hybrid_map).find(nodes[0].id, nodes[1].id)
    assert straight.edges == (NodeId("e", 1, 4),) and straight.cost == pytest.approx(2.02)


def test_links_between_maps_without_common_frame_are_driven():
    """The two maps' frames have nothing in common: only the measured link says that the nodes are near."""
    a, b = node(1, Pose2(0, 0)), node(1, Pose2(100, 100), "r1")
    relative = PoseGaussian.from_sigmas(Pose2(1, 0, 0), 0.1, 0.1)
    link = Edge(NodeId("e", 1, 1), a.id, b.id, relative, EdgeKind.MERGED)
    hybrid_map = HybridMap([NodePut(a), NodePut(b), EdgePut(link)])
    s = RouteSettings(per_edge=0.1, per_turn=0.0, per_undriven=0.5)
    assert RouteTable(hybrid_map, settings=s).find(a.id, b.id).cost == pytest.approx(1.5 + 0.1)


def test_reasons():
    nodes, one = chain(Pose2(0, 0), Pose2(1, 0))
    lonely = node(9, Pose2(5, 5))
    one.apply(NodePut(lonely))
    assert RouteTable(one).find(nodes[0].id, nodes[0].id).nodes == (nodes[0].id,)
    assert "nothing joins" in RouteTable(one).find(nodes[0].id, lonely.id).reason
    assert "not in the map" in RouteTable(one).find(nodes[0].id, NodeId("r9", 1, 1)).reason
    assert "no pose" in RouteTable(one, poses={nodes[0].id: Pose2()}).find(nodes[0].id, nodes[1].id).reason
    alone = RouteTable(one, blocked=[(nodes[0].id, nodes[1].id)])
    assert alone.find(nodes[0].id, nodes[1].id).reason.endswith(" is blocked (1 pair)")


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 10**6))
def test_there_is_a_way_or_a_reason_as_networkx_finds_it(seed: int):
    """With portals between maps of different frames, closed edges, blocked pairs and a toll for these."""
    rng = np.random.default_rng(seed)
    hybrid_map = random_map(seed, m=16)
    ids = [*hybrid_map.nodes]
    portals = {EdgeId("p", 1, k): (ids[k], ids[int(rng.integers(5, 14))]) for k in range(rng.integers(0, 3))}
    blocked = [(ids[a], ids[b]) for a, b in rng.integers(0, 14, (4, 2))]
    closed = {edge_id for edge_id in hybrid_map.edges if rng.random() < 0.3}
    toll = 5.0 if rng.random() < 0.3 else None
    factors = {frozenset((e.a, e.b)): float(rng.uniform(0.3, 2.0)) for e in hybrid_map.edges.values()}
    poses = {i: n.map_from_robot.mean for i, n in hybrid_map.nodes.items()}
    s, barred = RouteSettings(), {frozenset(pair) for pair in blocked}
    whole: nx.MultiGraph = nx.MultiGraph()
    whole.add_nodes_from(ids)
    for e in hybrid_map.edges.values():
        cost = edge_cost(e, poses, True, s) * factors[frozenset((e.a, e.b))]
        whole.add_edge(e.a, e.b, key=e.id, weight=cost)
    for key, (a, b) in portals.items():
        whole.add_edge(a, b, key=key, weight=s.per_portal * factors.get(frozenset((a, b)), 1.0))
    ties = [(a, b, key) for a, b, key in whole.edges(keys=True) if key in closed]
    drivable, free = nx.restricted_view(whole, [], ties), nx.MultiGraph()
    free.add_nodes_from(ids)
    for a, b in whole.edges():
        costs = {key: data["weight"] for key, data in whole[a][b].items()}
        open_ones = [] if frozenset((a, b)) in barred else [costs[key] for key in costs.keys() - closed]
        if open_ones or toll is not None:
            free.add_edge(a, b, weight=min(open_ones) if open_ones else min(costs.values()) + (toll or 0.0))
    ways = RouteTable(
        hybrid_map, poses=poses, blocked=blocked, closed=closed, toll=toll, factors=factors, portals=portals
    )
    for goal in ids[1:]:
        route = ways.find(ids[0], goal)
        if nx.has_path(free, ids[0], goal):
            assert route.cost == pytest.approx(nx.dijkstra_path_length(free, ids[0], goal))
        elif not nx.has_path(whole, ids[0], goal):
            assert "nothing joins" in route.reason
        elif not nx.has_path(drivable, ids[0], goal):
            assert "only ties poses" in route.reason
        else:
            assert "blocked" in route.reason


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6))
def test_closed_edges_are_as_if_they_were_not_there(seed: int):
    hybrid_map, rng = random_map(seed), np.random.default_rng(seed)
    closed = {edge_id for edge_id in hybrid_map.edges if rng.random() < 0.3}
    left = HybridMap(
        change
        for change in hybrid_map.contents()
        if not (isinstance(change, EdgePut) and change.edge.id in closed)
    )
    start, goal = NodeId("r0", 1, 0), NodeId("r0", 1, 13)
    result, expected = (
        RouteTable(hybrid_map, closed=closed).find(start, goal),
        RouteTable(left).find(start, goal),
    )
    assert (result.nodes, result.edges) == (expected.nodes, expected.edges)
    assert result.cost == pytest.approx(expected.cost)
    if not result.nodes and RouteTable(hybrid_map).find(start, goal).nodes:
        assert "only ties poses" in result.reason

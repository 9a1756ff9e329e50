"""Why a route leads so, and what is missing where there is none, against every way there could be."""

from dataclasses import replace
from itertools import pairwise

import networkx as nx
import numpy as np
import pytest

from mapweave.explanation_text import route_words
from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.constraint_subject import RetiredMap
from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.explanation import RouteExplanation
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import ExplainRequest
from mapweave.hybridmap.reachability import RECOGNISED, reachability_of
from mapweave.mapserver.http.json_values import json_values
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.route_explaining import explain_route
from mapweave.mapserver.routes import NEAR, WARY_COST, Router
from mapweave.wire.messages import decode, encode
from mapweave.wire.packing import pack
from synthetic.maps import changes_of, numbered
from synthetic.world import Sensing, room, take_map
from tests.mapserver.test_routes import OutOfSight

ME, OTHER, FAR = MapId("a", 1), MapId("b", 1), MapId("c", 1)
SHARP = Sensing(most=150, clutter=5, unknown_depth=0.0, reach=9.0)


def fleet() -> Merger:
    """Two robots see one wall from three metres apart, and a third one another room."""
    rng = np.random.default_rng(1)
    world, elsewhere = room(0, 0, 9, 4, 1400, rng), room(0, 0, 5, 4, 700, np.random.default_rng(9))
    merger = Merger()
    for map_id, there, x in ((ME, world, 1.6), (OTHER, world, 5.0), (FAR, elsewhere, 2.0)):
        made = take_map(there, map_id, [Pose2(x + 0.3 * k, 2.0) for k in range(3)], rng, SHARP)
        for change in numbered(map_id, changes_of(*made)):
            merger.on_change(change)
    return merger


@pytest.fixture(scope="module")
def router() -> Router:
    return Router(fleet().merged())


@pytest.fixture(scope="module")
def apart() -> Router:
    """The same, with something between the two robots."""
    return Router(fleet().merged(), reaches=OutOfSight())


def nodes_of(map_id: MapId) -> list[NodeId]:
    return [NodeId(*map_id, k) for k in (1, 3, 5)]


@pytest.fixture(params=["as it is", "over the wire"])
def sent(request: pytest.FixtureRequest) -> bool:
    return bool(request.param == "over the wire")


def least_gaps(router: Router, start: NodeId, goal: NodeId) -> int:
    """Fewest pairs on any way between which no robot could drive, by trying all ways of up to five steps."""
    merged = router.merged
    whole = merged.union()
    graph: nx.Graph = nx.Graph()
    for edge in whole.edges.values():
        a, b = whole.nodes[edge.a], whole.nodes[edge.b]
        open_ = edge.kind not in RECOGNISED or reachability_of(edge, a, b).drivable
        known = graph.get_edge_data(edge.a, edge.b, {"gap": 1})
        graph.add_edge(edge.a, edge.b, gap=min(known["gap"], int(not open_)))
    for a in merged.poses:
        for b in merged.poses:
            one = a < b and merged.component_of(a) == merged.component_of(b)
            if one and merged.pose(a).distance(merged.pose(b)) <= NEAR:
                graph.add_edge(a, b, gap=0)
    return min(
        sum(graph.edges[hop]["gap"] for hop in pairwise(way))
        for way in nx.all_simple_paths(graph, start, goal, cutoff=5)
    )


def test_a_way_that_no_robot_has_driven_is_explained_as_it_is_given(router: Router):
    start, goal = nodes_of(ME)[0], nodes_of(OTHER)[2]
    explanation, answer = explain_route(router, start, goal), router.route(start, goal)
    assert explanation.found
    ends = [start, *(hop.b for hop in explanation.hops)]
    assert ends == [leg.node.id for leg in answer.legs]
    (words,) = [hop.words for hop in explanation.hops if hop.a.map != hop.b.map]
    assert words.startswith("ties poses, not driven: ")


def test_edges_that_only_constrain_poses_are_named_with_what_they_lack(apart: Router):
    router, start, goal = apart, nodes_of(ME)[0], nodes_of(OTHER)[2]
    explanation = explain_route(router, start, goal)
    assert not explanation.found and not explanation.hops and explanation.apart is None
    assert (
        explanation.reason.startswith(router.route(start, goal).reason) and "ties poses" in explanation.reason
    )
    assert len(explanation.gaps) == least_gaps(router, start, goal) == 1
    (gap,) = explanation.gaps
    assert (gap.a.map, gap.b.map) == (ME, OTHER) and gap.kind == "merged"
    assert gap.words.startswith("ties poses, not driven: ")
    assert gap.distance == pytest.approx(router.merged.pose(gap.a).distance(router.merged.pose(gap.b)))
    words = route_words(explanation)
    assert "there is no way" in words[0] and "what is missing" in words[1] and gap.words in words[2]


def test_the_explained_route_is_the_one_that_robots_get(router: Router):
    start, goal = nodes_of(ME)[0], nodes_of(ME)[2]
    explanation = explain_route(router, start, goal)
    legs = router.route(start, goal).legs
    assert explanation.found and [hop.b for hop in explanation.hops] == [leg.node.id for leg in legs[1:]]
    for hop, leg in zip(explanation.hops, legs[1:], strict=True):
        assert hop.distance == pytest.approx(leg.previous_from_node.mean.distance(Pose2()))
        assert hop.turn == pytest.approx(leg.previous_from_node.mean.heading, abs=1e-9)
    assert not explanation.gaps and "no cheaper one is known" in explanation.reason
    assert f"cost {sum(hop.cost for hop in explanation.hops):.2f} m" in explanation.reason


def test_blocked_edges_are_explained_with_and_without_another_way(router: Router):
    one, two, three = nodes_of(ME)
    explanation = explain_route(router, one, three, blocked=[(two, one)])
    legs = router.route(one, three, blocked=[(two, one)]).legs
    assert explanation.found is bool(legs)
    assert all("reported as blocked" in gap.words for gap in explanation.gaps)
    whole = [(one, other) for other in router.merged.poses if other != one]
    explanation = explain_route(router, one, three, blocked=whole)
    assert not explanation.found and not router.route(one, three, blocked=whole).legs
    assert "is blocked" in explanation.reason and "reported as blocked" in explanation.gaps[0].words


def test_recently_blocked_edges_are_reported(router: Router):
    one, two, _ = nodes_of(ME)
    free, wary = explain_route(router, one, two), explain_route(router, one, two, wary=[(one, two)])
    if [hop.b for hop in wary.hops] == [two]:
        assert wary.hops[0].cost == pytest.approx(free.hops[0].cost + WARY_COST)
        assert "recently could not get through" in wary.hops[0].words
    else:
        assert "recently could not get through" in wary.gaps[0].words
    assert wary.gaps, "the way that would be cheaper is reported"


def test_unconnected_maps_are_explained_instead_of_a_route(router: Router, sent: bool):
    explanation = explain_route(router, nodes_of(ME)[0], nodes_of(FAR)[0])
    if sent:
        explanation = decode(encode(explanation), RouteExplanation)
    assert not explanation.found and "in parts of the map that nothing joins yet" in explanation.reason
    assert explanation.apart is not None and not explanation.apart.joined
    assert explanation.apart.second == FAR and "are not one map" in explanation.apart.reason
    assert any("are not one map" in line for line in route_words(explanation))
    assert json_values(explanation)["apart"]["second"] == "c.1"


def test_pieces_of_one_map_are_not_joined_as_maps():
    """A robot that was carried from room to room: nothing in its own map says where the second one is."""
    rng, merger = np.random.default_rng(3), Merger()
    for number, first in ((0, 1), (1, 101)):
        world = room(0, 0, 5, 4, 700, rng)
        made = take_map(world, ME, [Pose2(2.0 + 0.3 * k, 2.0) for k in range(3)], rng, SHARP)
        for change in changes_of(*made):
            merger.apply(ME, renumbered(change, 100 * number))
        assert merger.maps[ME].nodes[NodeId(*ME, first)]
    router = Router(merger.merged())
    assert len(router.merged.components) == 2
    explanation = explain_route(router, NodeId(*ME, 1), NodeId(*ME, 101))
    assert not explanation.found and explanation.apart is None
    assert explanation.reason.endswith("in parts of the map that nothing joins yet; a.1 is in pieces")


def renumbered(change: NodePut | EdgePut, more: int) -> NodePut | EdgePut:
    """The same with other numbers."""

    def later(node_id: NodeId) -> NodeId:
        return node_id._replace(number=node_id.number + more)

    if isinstance(change, NodePut):
        return NodePut(replace(change.node, id=later(change.node.id)))
    edge = change.edge
    return EdgePut(replace(edge, id=later(edge.id), a=later(edge.a), b=later(edge.b)))


def test_a_retired_map_is_explained_with_the_persons_name():
    merger = fleet()
    merger.constrain(
        ManualConstraints([ManualConstraint(RetiredMap(OTHER), True, "anna", 10**18, "burnt down")])
    )
    explanation = explain_route(Router(merger.merged()), nodes_of(ME)[0], nodes_of(OTHER)[0])
    assert not explanation.found and "anna" in explanation.reason and "burnt down" in explanation.reason


def test_unknown_ids_are_refused_with_the_known_range(router: Router):
    with pytest.raises(InvalidValue, match=r"map a\.1 has no node 9; of its 3 nodes the nearest are 1, 3, 5"):
        explain_route(router, nodes_of(ME)[0], NodeId(*ME, 9))
    with pytest.raises(InvalidValue, match=r"there is no map z\.1"):
        explain_route(router, NodeId("z", 1, 1), nodes_of(ME)[0])
    with pytest.raises(InvalidValue, match=r"map b\.1 has no node 2"):
        explain_route(router, *nodes_of(ME)[:2], blocked=[(nodes_of(ME)[0], NodeId(*OTHER, 2))])
    assert explain_route(router, *nodes_of(ME)[:1] * 2).found


def test_questions_and_answers_come_through_the_wire(router: Router):
    one, two, three = nodes_of(ME)
    request = ExplainRequest((one, three), True, ((one, two), (two, three)))
    assert decode(encode(request), ExplainRequest) == request
    explanation = explain_route(router, one, three, blocked=[(one, two)])
    again = decode(encode(explanation), RouteExplanation)
    assert isinstance(again, RouteExplanation) and again == explanation
    with pytest.raises(InvalidValue, match="from node to node"):
        ExplainRequest((ME, OTHER), True)
    with pytest.raises(InvalidMessage, match="from node to node"):
        decode(pack({"ends": [list(ME), list(OTHER)], "route": True}), ExplainRequest)
    fields = {"start": list(one), "goal": list(two), "found": True, "reason": ""}
    with pytest.raises(InvalidMessage, match="hops"):
        decode(pack({**fields, "hops": [[1]]}), RouteExplanation)
    assert decode(pack({**fields, "hops": []}), RouteExplanation).found

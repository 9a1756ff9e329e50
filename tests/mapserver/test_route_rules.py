"""Closures and preferences on a grid of corridors, against another search on another graph."""

from dataclasses import replace
from itertools import pairwise

import networkx as nx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave.hybridmap.annotation import Annotation, Annotations, Closure, Preference
from mapweave.hybridmap.area import Area
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.portal import Portal, PortalMeans
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.route import edge_cost
from mapweave.mapserver.annotator import check_edge
from mapweave.mapserver.goals import node_of_goal
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.places import PlaceResolver
from mapweave.mapserver.route_explaining import explain_route
from mapweave.mapserver.routes import Router
from tests.mapserver.driven_maps import driven_map, place_node, take_in

MAP = MapId("a", 1)
SIZE = 5
HOUR = 3600 * 10**9


@pytest.fixture(scope="module")
def grid() -> Router:
    """Nodes 1 m apart in a square; each row and column is a corridor."""
    merger = Merger()
    nodes = [place_node(at(x, y), (float(x), float(y))) for y in range(SIZE) for x in range(SIZE)]
    joints = [(n, n + 1) for n in range(SIZE * SIZE) if n % SIZE < SIZE - 1]
    joints += [(n, n + SIZE) for n in range(SIZE * (SIZE - 1))]
    take_in(merger, MAP, driven_map(MAP, nodes, joints))
    return Router(merger.merged())


def at(x: int, y: int) -> NodeId:
    return NodeId(*MAP, 1 + x + SIZE * y)


def xy(node: NodeId) -> tuple[int, int]:
    return (node.number - 1) % SIZE, (node.number - 1) // SIZE


def rectangle(x0: float, y0: float, x1: float, y1: float) -> Area:
    """In the frame of the first node, which is that of the map."""
    return Area(at(0, 0), ((x0, y0), (x1, y0), (x1, y1), (x0, y1)))


def said(name: str, body: Closure | Preference) -> Annotation:
    return Annotation(name, body, False, "anna", 1, "wet floor")


def law(*entries: Annotation) -> Annotations:
    return Annotations(entries)


# Off the nodes by more than the merge moves them.
offs = st.integers(0, 2 * SIZE).map(lambda k: k / 2.0 - 0.25)
boxes = st.tuples(offs, offs, offs, offs).filter(lambda b: b[0] < b[2] and b[1] < b[3])
steps = st.tuples(st.integers(0, SIZE - 2), st.integers(0, SIZE - 1), st.booleans()).map(
    lambda s: (at(s[0], s[1]), at(s[0] + 1, s[1])) if s[2] else (at(s[1], s[0]), at(s[1], s[0] + 1))
)
factors = st.sampled_from([0.2, 0.5, 3.0, 10.0])


@settings(max_examples=60)
@given(
    st.lists(boxes, max_size=2), st.lists(steps, max_size=4),
    st.lists(st.tuples(boxes | steps, factors), max_size=3), st.data(),
)  # fmt: skip
def test_routes_are_the_cheapest_without_what_is_closed(grid, areas, edges, preferred, data):
    start, goal = (at(*data.draw(st.tuples(*[st.integers(0, SIZE - 1)] * 2))) for _ in range(2))
    entries = [said(f"c{k}", Closure(None, rectangle(*box))) for k, box in enumerate(areas)]
    entries += [said(f"e{k}", Closure(step)) for k, step in enumerate(edges)]
    for k, (where, factor) in enumerate(preferred):
        body = Preference(factor, None, rectangle(*where)) if len(where) == 4 else Preference(factor, where)
        entries.append(said(f"p{k}", body))
    router = grid.at(law(*entries), 0)
    if any(holds(box, start, start) for box in areas):
        return  # A robot that leaves a closed area has a test of its own.
    graph = nx.Graph()
    graph.add_nodes_from(grid.roads.poses)
    for edge in grid.roads.union.edges.values():
        pair = {edge.a, edge.b}
        if any(holds(box, edge.a, edge.b) for box in areas) or pair in map(set, edges):
            continue
        cost = edge_cost(edge, grid.roads.poses, True, grid.costs)
        for where, factor in preferred:
            covered = holds(where, edge.a, edge.b) if len(where) == 4 else pair == set(where)
            cost *= factor if covered else 1.0
        graph.add_edge(edge.a, edge.b, weight=cost)
    answer = router.route(start, goal)
    if any(holds(box, goal, goal) for box in areas):
        assert not answer.legs and "is in c" in answer.reason and "closed by anna" in answer.reason
    elif not nx.has_path(graph, start, goal):
        assert not answer.legs and "every way" in answer.reason and "closed by anna" in answer.reason
    else:
        way = [leg.node.id for leg in answer.legs]
        cost = sum(graph.edges[pair]["weight"] for pair in pairwise(way))
        assert cost == pytest.approx(nx.dijkstra_path_length(graph, start, goal))


def holds(box: tuple[float, float, float, float], a: NodeId, b: NodeId) -> bool:
    """Whether a box and a line along the grid have a point in common: by their intervals."""
    (ax, ay), (bx, by) = xy(a), xy(b)
    x0, y0, x1, y1 = box
    return x0 <= max(ax, bx) and x1 >= min(ax, bx) and y0 <= max(ay, by) and y1 >= min(ay, by)


def nodes_of(router: Router, start: NodeId, goal: NodeId, **more: object) -> list[NodeId]:
    return [leg.node.id for leg in router.route(start, goal, **more).legs]  # type: ignore[arg-type]


def test_a_closure_holds_between_its_times_alone(grid):
    record = law(said("door", Closure((at(1, 0), at(2, 0)), None, 2 * HOUR, 3 * HOUR)))
    straight = [at(x, 0) for x in range(SIZE)]
    assert nodes_of(grid.at(record, HOUR), at(0, 0), at(4, 0)) == straight
    assert nodes_of(grid.at(record, 2 * HOUR), at(0, 0), at(4, 0)) != straight
    assert nodes_of(grid.at(record, 3 * HOUR), at(0, 0), at(4, 0)) == straight
    withdrawn = law(*record.made, replace(record.made[0], removed=True))
    assert nodes_of(grid.at(withdrawn, 2 * HOUR), at(0, 0), at(4, 0)) == straight


def test_an_explanation_names_who_closed_the_way_until_when_and_the_detour(grid):
    router = grid.at(law(said("door", Closure((at(1, 0), at(2, 0)), None, None, 4 * HOUR))), 0)
    explanation = explain_route(router, at(0, 0), at(4, 0))
    assert explanation.found and len(explanation.hops) == 6
    closed = 'door is closed by anna until 1970-01-01 04:00 UTC: "wet floor"'
    assert explanation.reason.endswith(f"; a detour of 2.0 m, since {closed}")
    assert [(gap.a, gap.b, gap.words) for gap in explanation.gaps] == [(at(1, 0), at(2, 0), closed)]
    every = law(*(said(f"e{y}", Closure((at(1, y), at(2, y)))) for y in range(SIZE)))
    none = explain_route(grid.at(every, 0), at(0, 0), at(4, 0))
    assert not none.found and any("closed by anna" in gap.words for gap in none.gaps)
    inside = law(said("hall", Closure(None, rectangle(3.5, -0.5, 4.5, 0.5))))
    refused = explain_route(grid.at(inside, 0), at(0, 0), at(4, 0))
    assert refused.reason == f'goal {at(4, 0)} is in hall, which is closed by anna: "wet floor"'
    with pytest.raises(InvalidValue, match="is in hall, which is closed by anna"):
        node_of_goal(str(at(4, 0)), MAP, PlaceResolver(grid.at(inside, 0), inside))


def test_an_explanation_names_who_prefers_a_way(grid):
    row = Preference(0.2, None, rectangle(-0.5, 0.5, 4.5, 1.5))
    explanation = explain_route(grid.at(law(said("row", row)), 0), at(0, 0), at(4, 0))
    preferred = 'row is preferred by anna (cost times 0.2): "wet floor"'
    assert explanation.reason.endswith(f"; a detour of 2.0 m; it leads this way since {preferred}")
    assert sum(preferred in hop.words for hop in explanation.hops) >= 4
    total = sum(hop.cost for hop in explanation.hops)
    assert f"cost {total:.2f} m" in explanation.reason


def test_a_way_that_is_avoided_is_named_and_no_detour_is_said_where_the_other_is_no_longer(grid):
    """Rules act on the cost, a detour is one in metres: of two ways of one length neither is one."""
    here, there = at(0, 0), at(1, 1)
    first = explain_route(grid, here, there).hops[0].b
    avoided = said("carpet", Preference(10.0, (here, first)))
    reason = explain_route(grid.at(law(avoided), 0), here, there).reason
    why = 'carpet is avoided by anna (cost times 10): "wet floor"'
    assert "detour" not in reason and reason.endswith(
        f"; a way that would cost less is not taken, since {why}"
    )
    second = at(1, 0) if first == at(0, 1) else at(0, 1)
    preferred = said("hall", Preference(0.2, (here, second)))
    reason = explain_route(grid.at(law(preferred), 0), here, there).reason
    assert "detour" not in reason and "since the way" not in reason
    assert reason.endswith(
        '; it leads this way since hall is preferred by anna (cost times 0.2): "wet floor"'
    )
    # What both ways have in common, and what speaks for the way that is left, is no reason.
    common = said("ramp", Preference(3.0, (at(0, 0), at(1, 0))))
    straight = [
        said("door", Closure((at(2, 0), at(3, 0)))),
        said("mat", Preference(0.9, (at(3, 0), at(4, 0)))),
    ]
    closed = said("gate", Closure((at(0, 0), at(0, 1))))
    explanation = explain_route(grid.at(law(common, *straight, closed), 0), at(0, 0), at(4, 0))
    assert "; a detour of 2.0 m, since door is closed by anna" in explanation.reason
    assert "ramp" not in explanation.reason and "mat" not in explanation.reason


@pytest.mark.parametrize("factor", [0.5, 4.0])
def test_an_edge_has_its_factor_once(grid, factor: float):
    """It crosses its own barrier, as parallel edges of other robots do."""
    pair = at(1, 0), at(2, 0)
    rules = grid.at(law(said("mat", Preference(factor, pair))), 0).rules
    assert rules.factors == {frozenset(pair): factor}
    (named,) = rules.preferences.values()
    assert [entry.name for entry in named] == ["mat"]
    closed = grid.at(law(said("door", Closure(pair))), 0).rules.closed
    assert [entry.name for entry in closed[frozenset(pair)]] == ["door"]


def test_a_route_that_begins_in_a_closed_area_says_so(grid):
    entry = said("kitchen", Closure(None, rectangle(-0.5, -0.5, 1.5, 4.5)))
    explanation = explain_route(grid.at(law(entry), 0), at(0, 0), at(4, 0))
    assert explanation.found and explanation.reason.endswith(
        '; it begins in a closed area, which a robot may leave: kitchen is closed by anna: "wet floor"'
    )
    dear = [hop for hop in explanation.hops if "in kitchen, which is closed (cost times 4)" in hop.words]
    assert [(hop.a, hop.b) for hop in dear] == [(at(0, 0), at(1, 0)), (at(1, 0), at(2, 0))]
    assert dear[0].cost == pytest.approx(4.0 * explanation.hops[-1].cost, rel=0.01)
    outside = explain_route(grid.at(law(entry), 0), at(3, 0), at(4, 0))
    assert "kitchen" not in outside.reason and "kitchen" not in outside.hops[0].words


def test_ways_that_are_no_edges_are_not_closed_or_preferred(grid):
    """A barrier between nodes that nothing joins would hold for the ways of others between the two."""
    wrong = said("door", Closure((at(0, 0), at(4, 0))))
    with pytest.raises(InvalidValue, match=r"no edge joins a.1.1 and a.1.5 \(a.1.1 has edges to nodes a.1.2"):
        check_edge(grid, law(), wrong)
    check_edge(grid, law(), replace(wrong, removed=True))
    for factor in (0.5, 4.0):
        with pytest.raises(InvalidValue, match=r"no edge joins a\.1\.1 and a\.1\.5"):
            check_edge(grid, law(), said("mat", Preference(factor, (at(0, 0), at(4, 0)))))
    check_edge(grid, law(), said("mat", Preference(0.5, (at(1, 0), at(0, 0)))))
    with pytest.raises(InvalidValue, match=r"z\.1"):
        check_edge(grid, law(), said("door", Closure((at(0, 0), NodeId("z", 1, 1)))))
    check_edge(grid, law(), said("door", Closure((at(1, 0), at(0, 0)))))
    door = Annotation("door", Portal(at(0, 0), at(4, 0), PortalMeans.DOOR), False, "anna", 1)
    check_edge(grid, law(door), said("shut", Closure((at(4, 0), at(0, 0)))))


def test_a_robot_in_an_area_that_is_closed_may_leave_it(grid):
    router = grid.at(law(said("middle", Closure(None, rectangle(0.6, 0.6, 3.4, 3.4)))), 0)
    way = nodes_of(router, at(2, 2), at(2, 4), start_from_robot=Pose2())
    assert way in ([at(2, 3), at(2, 4)], [at(2, 2), at(2, 3), at(2, 4)])
    assert nodes_of(router, at(2, 0), at(2, 4)) != [at(2, y) for y in range(SIZE)], "another goes around"
    assert not router.route(at(2, 2), at(2, 1)).legs, "but not to another node within"


def test_parallel_corridor_edges_of_another_robot_are_closed_too(grid):
    """A closed edge is a barrier: an edge that crosses it, of any robot, is closed; one beside it is not."""
    rules = grid.at(law(said("door", Closure((at(1, 1), at(3, 1))))), 0).rules
    assert rules.closed.keys() == {frozenset((at(1, 1), at(3, 1)))} | {
        frozenset(pair) for pair in ((at(1, 1), at(2, 1)), (at(2, 1), at(3, 1)))
    } | {frozenset((at(2, 1), at(2, y))) for y in (0, 2)}, "the barrier touches the node in its middle"

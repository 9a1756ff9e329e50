"""Routes over several floors, against relaxation over one list of edges; portals that are mistakes."""

import math
import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave.hybridmap.annotation import Annotation, Annotations, Body, Closure, Floor, Preference
from mapweave.hybridmap.constraint_subject import RetiredNodes
from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.hybridmap.node import EdgeKind
from mapweave.hybridmap.portal import Portal, PortalMeans, PortalStop
from mapweave.hybridmap.query import RouteAnswer
from mapweave.hybridmap.route import RouteSettings, edge_cost
from mapweave.mapserver.annotator import check_annotation
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.portals import Portals
from mapweave.mapserver.route_explaining import explain_route
from mapweave.mapserver.routes import Router
from mapweave.wire.messages import decode, encode
from tests.mapserver.driven_maps import driven_map, place_node, take_in

MAPS = [MapId(name, 1) for name in "abc"]
SIZE = 3
CROSSING = RouteSettings().per_portal


@pytest.fixture(scope="module")
def house() -> Router:
    """Three floors, each a square of corridors that its own robot has mapped, around the same origin."""
    merger = Merger()
    joints = [(n, n + 1) for n in range(SIZE * SIZE) if n % SIZE < SIZE - 1]
    joints += [(n, n + SIZE) for n in range(SIZE * (SIZE - 1))]
    for k, which in enumerate(MAPS):
        nodes = [place_node(at(k, n), (float(n % SIZE), float(n // SIZE))) for n in range(SIZE * SIZE)]
        take_in(merger, which, driven_map(which, nodes, joints))
    return Router(merger.merged())


def at(floor: int, number: int) -> NodeId:
    return NodeId(*MAPS[floor], number + 1)


def said(name: str, body: Body) -> Annotation:
    return Annotation(name, body, False, "anna", 1)


LABELS = tuple(said(str(which), Floor(NodeId(*which, 1), str(k + 1))) for k, which in enumerate(MAPS))
numbers = st.integers(0, SIZE * SIZE - 1)
lifts = st.tuples(st.sampled_from([(0, 1), (1, 2), (2, 0)]), numbers, numbers).map(
    lambda drawn: (at(drawn[0][0], drawn[1]), at(drawn[0][1], drawn[2]))
)


@settings(max_examples=60)
@given(
    st.lists(lifts, max_size=5, unique=True), st.lists(st.booleans(), min_size=5, max_size=5),
    st.lists(st.sampled_from([0.5, 1.0, 4.0]), min_size=5, max_size=5), st.data(),
)  # fmt: skip
def test_a_way_through_portals_is_the_cheapest_that_there_is(house, pairs, closed, factors, data):
    entries = [said(f"lift {k}", Portal(*pair, PortalMeans.LIFT)) for k, pair in enumerate(pairs)]
    entries += [said(f"c{k}", Closure(pair)) for k, pair in enumerate(pairs) if closed[k]]
    entries += [
        said(f"p{k}", Preference(factors[k], pair)) for k, pair in enumerate(pairs) if factors[k] != 1
    ]
    router = house.at(Annotations((*LABELS, *entries)), 0)
    start, goal = (at(data.draw(st.integers(0, 2)), data.draw(numbers)) for _ in range(2))
    edges = [
        (e.a, e.b, edge_cost(e, house.roads.poses, True, house.costs))
        for e in house.roads.union.edges.values()
    ]
    edges += [(*pair, CROSSING * factors[k]) for k, pair in enumerate(pairs) if not closed[k]]
    cost = relaxed(edges, start)

    # As robots do: to the first portal, through it, and asked again.
    here, spent, reason = start, 0.0, ""
    while here != goal:
        answer = decode(encode(router.route(here, goal)), RouteAnswer)
        if not answer.legs:
            reason = answer.reason
            break
        way = [leg.node.id for leg in answer.legs]
        assert way[0] == here and len({node.map for node in way}) == 1, "it drives on one floor"
        spent += sum(min(c for a, b, c in edges if {a, b} == {*hop}) for hop in pairwise(way))
        here = way[-1]
        if answer.portal is not None:
            stop = answer.portal
            assert stop.entry == here and stop.floor == str(MAPS.index(stop.exit.map) + 1)
            assert f"lift '{stop.name}' to floor {stop.floor}" in answer.reason
            open_ = [
                k for k, pair in enumerate(pairs) if {*pair} == {stop.entry, stop.exit} and not closed[k]
            ]
            spent, here = spent + min(CROSSING * factors[k] for k in open_), stop.exit
    explanation = explain_route(router, start, goal)
    assert explanation.found == (here == goal)
    if math.isinf(cost.get(goal, math.inf)):
        assert here != goal and ("no portal leads there" in reason or "closed by anna" in reason)
        assert not explanation.gaps or all("closed by anna" in gap.words for gap in explanation.gaps)
    else:
        assert here == goal and spent == pytest.approx(cost[goal])
        assert sum(hop.cost for hop in explanation.hops) == pytest.approx(cost[goal])


def relaxed(edges: list[tuple[NodeId, NodeId, float]], start: NodeId) -> dict[NodeId, float]:
    """What it costs to get to each node, by relaxing all edges until nothing changes."""
    cost, changed = {start: 0.0}, True
    while changed:
        changed = False
        for a, b, length in edges:
            for one, other in ((a, b), (b, a)):
                if cost.get(one, math.inf) + length < cost.get(other, math.inf) - 1e-12:
                    cost[other], changed = cost[one] + length, True
    return cost


def test_an_explanation_names_the_portal_and_the_floors(house):
    lift = said("east lift", Portal(at(0, 2), at(1, 0), PortalMeans.LIFT, "key: desk"))
    explanation = explain_route(house.at(Annotations((*LABELS, lift)), 0), at(0, 0), at(1, 1))
    assert "on floor 1, through lift 'east lift' to floor 2" in explanation.reason
    (hop,) = [hop for hop in explanation.hops if hop.kind == "lift"]
    assert (hop.a, hop.b, hop.cost) == (at(0, 2), at(1, 0), CROSSING)
    none = explain_route(house.at(Annotations(LABELS), 0), at(0, 0), at(1, 1))
    assert "a.1.1 is on floor 1 and b.1.2 on floor 2, and no portal leads there" in none.reason
    blocked = house.at(Annotations((*LABELS, lift)), 0).route(at(0, 0), at(1, 1), [(at(1, 0), at(0, 2))])
    assert not blocked.legs and "blocked" in blocked.reason


def test_a_portal_at_a_retired_node_is_named_where_it_is_missed(house):
    lift = said("east lift", Portal(at(0, 4), at(1, 4), PortalMeans.LIFT))
    annotations = Annotations((*LABELS, lift))
    retired = ManualConstraint(RetiredNodes((at(1, 4),)), True, "bob", 1, "a mirror")
    poses = {node: house.merged.poses[node] for node in house.merged.poses if node != at(1, 4)}
    constraints = ManualConstraints([retired], {at(1, 4): retired})
    merged = replace(house.merged, poses=poses, constraints=constraints)
    assert Portals(house.merged, annotations).lead(at(0, 0), at(1, 0))
    without = Portals(merged, annotations)
    assert not without.lead(at(0, 0), at(1, 0))
    assert re.search(
        "; portal east lift has no effect, as b.1.5 is not in the merged map "
        r'\(node b.1.5 is retired by bob on .*: "a mirror"\)$',
        without.apart(at(0, 0), at(1, 0)),
    )


def test_a_door_is_a_way_within_one_part_that_a_robot_asks_to_be_taken_along(house):
    door = said("gate", Portal(at(0, 0), at(0, 8), PortalMeans.DOOR))
    router, around = house.at(Annotations((*LABELS, door)), 0), [(at(0, 0), at(0, 1)), (at(0, 0), at(0, 3))]
    through = router.route(at(0, 0), at(0, 8), around)
    assert through.portal == PortalStop("gate", PortalMeans.DOOR, at(0, 0), at(0, 8), "1")
    free = router.route(at(0, 0), at(0, 8))
    assert free.portal is None and len(free.legs) == 5, "4 m are less than a wait for a person"


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (Portal(at(0, 0), at(0, 5), PortalMeans.LIFT), "to another floor, but .* are on floor 1"),
        (Portal(at(0, 0), at(2, 5), PortalMeans.RAMP), "the floor of c.1.6 has no label"),
        (Portal(at(0, 0), at(1, 5), PortalMeans.DOOR), "on floor 1 and b.1.6 on floor 2: is it a lift"),
        (Portal(at(0, 0), NodeId("z", 1, 1), PortalMeans.LIFT), "z.1"),
        (Portal(at(1, 4), at(0, 3), PortalMeans.RAMP), "are the two sides of lift west"),
        (Floor(at(1, 0), "1"), "map b.1 cannot be on floor 1: portal west is a lift"),
    ],
)  # fmt: skip
def test_portals_and_labels_that_contradict_each_other_are_refused(house, body: Body, words: str):
    record = Annotations((*LABELS[:2], said("west", Portal(at(0, 3), at(1, 4), PortalMeans.LIFT))))
    name = str(body.node.map) if isinstance(body, Floor) else "east"
    with pytest.raises(InvalidValue, match=words):
        check_annotation(house.merged, record, said(name, body), ManualConstraints())


def test_a_door_is_refused_where_the_map_has_its_sides_far_apart():
    """A corridor of 12 m: within one component the map says how far two nodes are from each other."""
    merger, which = Merger(), MapId("a", 1)
    nodes = [place_node(at(0, n), (float(n), 0.0)) for n in range(13)]
    spread = np.diag([0.1, 0.1, 1e-3]) ** 2
    take_in(merger, which, driven_map(which, nodes, pairwise(range(13)), EdgeKind.MAPPED, spread))
    merged = merger.merged()

    def check(far: int, means: PortalMeans = PortalMeans.DOOR) -> None:
        gate = said("gate", Portal(at(0, 0), at(0, far), means))
        check_annotation(merged, Annotations(), gate, ManualConstraints())

    for far in (1, 8, 9):  # 9 m are 8 m within what is uncertain
        check(far)
    with pytest.raises(
        InvalidValue,
        match=r"has them 12\.00 m apart \(sigma 0\.\d\d m\), and .* at most 8 m apart: 1\d\.\d standard "
        r"deviations more, at most 4\.0 pass\. Map a\.1 says so by its robot's own way",
    ):
        check(12)
    with pytest.raises(InvalidValue, match="has no label"):
        check(12, PortalMeans.LIFT)


def test_a_portal_goes_and_comes_again_and_bad_ones_are_no_values(house):
    lift = said("lift", Portal(at(0, 3), at(1, 4), PortalMeans.LIFT))
    gone = replace(lift, removed=True)
    check_annotation(house.merged, Annotations((*LABELS, lift)), gone, ManualConstraints())
    record = Annotations((*LABELS, lift, gone))
    assert not house.at(record, 0).route(at(0, 3), at(1, 4)).legs
    check_annotation(house.merged, record, lift, ManualConstraints())
    with pytest.raises(InvalidValue, match="to itself"):
        Portal(at(0, 0), at(0, 0), PortalMeans.DOOR)
    with pytest.raises(InvalidValue, match="printable"):
        Portal(at(0, 0), at(0, 1), PortalMeans.DOOR, "two\nlines")
    packed = encode(lift).replace(b"\xa4lift", b"\xa4lyft")
    with pytest.raises(InvalidMessage):
        decode(packed, Annotation)

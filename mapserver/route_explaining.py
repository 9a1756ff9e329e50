"""Explanations of routes, and of what is missing where there is none."""

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

from mapweave.hybridmap.annotation import Annotation, Preference
from mapweave.hybridmap.explanation import Hop, MapsExplanation, RouteExplanation
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Edge
from mapweave.hybridmap.portal import PortalStop
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.reachability import RECOGNISED
from mapweave.hybridmap.route import Route, edge_cost
from mapweave.mapserver.roadmap import IMPLIED
from mapweave.mapserver.route_rules import OUT, RouteRules, named_words
from mapweave.mapserver.routes import WARY_COST, Router
from mapweave.merge.explanation.component_changes import joined_maps
from mapweave.merge.explanation.map_explanation import explain_maps
from mapweave.merge.explanation.own_edges import reach_words
from mapweave.merge.pose_graph.merged_map import MergedMap

TOLL = 1e4
"""Cost of a gap in the search for as few gaps as possible, m: more than any way through a building."""
CLEARLY = 0.01
"""A way that is not used is mentioned if it is cheaper by more than this, m."""
WORDS = {
    "mapped": "its robot drove here while it mapped",
    "turned": "its robot turned here on the spot",
    "driven": "a robot has driven here",
    "near": "both are at one place",
    "superseded": "one supersedes the other",
}
Pairs = Collection[tuple[NodeId, NodeId]]


@dataclass(frozen=True)
class _Hindrances:
    """Pairs between which a robot could not drive."""

    blocked: frozenset[frozenset[NodeId]]
    wary: frozenset[frozenset[NodeId]]
    wary_cost: float
    rules: RouteRules
    within: frozenset[Annotation]

    def words(self, pair: frozenset[NodeId]) -> str:
        """A pair in words; empty if it is none."""
        if pair in self.blocked:
            return "reported as blocked"
        for closure in self.rules.closed.get(pair, ()):
            if closure not in self.within:
                return named_words([closure])
        if pair in self.wary:
            return f"another robot recently could not get through: {self.wary_cost:g} m dearer"
        return ""

    def preferred(self, pair: frozenset[NodeId]) -> str:
        """Why a pair on a way costs less or more than by itself, in words; empty if it is not so."""
        leaving = [entry.name for entry in self.rules.closed.get(pair, ()) if entry in self.within]
        said = [f"in {' and '.join(leaving)}, which is closed (cost times {OUT:g})"] if leaving else []
        return "; ".join((*said, *(named_words([entry]) for entry in self.rules.preferences.get(pair, ()))))


def explain_route(
    router: Router, start: NodeId, goal: NodeId, blocked: Pairs = (), wary: Pairs = ()
) -> RouteExplanation:
    """Explain a route from node to node, or why there is none: the same route that robots get.

    Args:
        router: of the merged map.
        start: where it begins.
        goal: where it shall end.
        blocked: as in Router.route.
        wary: as in Router.route.

    Raises:
        InvalidValue: an unknown node, also among those that are blocked.
    """
    merged = router.merged
    for end in (start, goal, *(node for pair in blocked for node in pair)):
        merged.check(end)
    if missing := router.missing(start, goal):
        if closed := router.closed_goal(goal):
            return RouteExplanation(start, goal, False, closed)
        floors = {router.portals.floor(node) for node in (start, goal)} - {""}
        if len(floors) == 2:
            return RouteExplanation(start, goal, False, missing)
        return _apart(merged, start, goal, missing)
    if start == goal:
        return RouteExplanation(start, goal, True, "start and goal are one node")
    rules, within = router.rules, router.rules.around(start, Pose2())
    hindrances = _Hindrances(
        frozenset(map(frozenset, blocked)), frozenset(map(frozenset, wary)), WARY_COST, rules, within
    )
    route, why_not = Route((), (), 0.0, ""), ""
    for choice in router.choices(start, goal):
        route = router.ways(choice, blocked, wary, within=within).find(start, goal)
        if route.nodes:
            break
        why_not = route.reason
    poses = choice.poses
    if not route.nodes:
        least = router.ways(choice, blocked, wary, TOLL, within).find(start, goal)
        gaps = _gaps(router, least, poses, hindrances)
        many = "1 gap is" if len(gaps) == 1 else f"{len(gaps)} gaps are"
        more = f"; {many} on the way that lacks least" if gaps else ""
        return RouteExplanation(start, goal, False, f"{why_not}{more}", gaps=gaps)
    best = router.ways(choice, toll=0.0, within=within).find(start, goal)
    gaps = _gaps(router, best, poses, hindrances) if best.cost < route.cost - CLEARLY else ()
    hops = tuple(_hops(router, route, poses, hindrances))
    reason = _why(router, route, best, hops, gaps) + _leaving(within)
    if rules:
        free = router.ways(choice, blocked, wary, within=None).find(start, goal)
        reason += _detour(router, route, free, poses)
    return RouteExplanation(start, goal, True, reason, hops, gaps)


def _leaving(within: Collection[Annotation]) -> str:
    """That a route begins where robots may not drive, in words; empty if it does not."""
    if not within:
        return ""
    closed = named_words(sorted(within, key=lambda entry: entry.name))
    return f"; it begins in a closed area, which a robot may leave: {closed}"


def _detour(router: Router, route: Route, free: Route, poses: Mapping[NodeId, Pose2]) -> str:
    """What closures and preferences change of a route, in words; empty if it is the same without them."""
    if not free.nodes or free.nodes == route.nodes:
        return ""
    rules, of = router.rules, router.merged.component_of
    taken, left = ([frozenset(pair) for pair in pairwise(way.nodes)] for way in (route, free))
    # What both ways have in common is no reason to choose one of them.
    against = [
        entry
        for pair in left
        if pair not in taken
        for entry in (*rules.closed.get(pair, ()), *_preferences(rules, pair, lambda factor: factor > 1.0))
    ]
    in_favour = [
        entry
        for pair in taken
        if pair not in left
        for entry in _preferences(rules, pair, lambda factor: factor < 1.0)
    ]
    longer = _length(route, poses, of) - _length(free, poses, of)
    # Rules act on the cost, so that a way may also be shorter by them.
    said = f"; a detour of {longer:.1f} m" if round(longer, 1) > 0.0 else ""
    if against:
        said = f"{said or '; a way that would cost less is not taken'}, since {named_words(against)}"
    if in_favour:
        said += f"; it leads this way since {named_words(in_favour)}"
    return said if against or in_favour else ""


def _preferences(
    rules: RouteRules, pair: frozenset[NodeId], wanted: Callable[[float], bool]
) -> Iterator[Annotation]:
    """Preferences of a pair that have such factors."""
    for entry in rules.preferences.get(pair, ()):
        if isinstance(entry.body, Preference) and wanted(entry.body.factor):
            yield entry


def _length(route: Route, poses: Mapping[NodeId, Pose2], of: Callable[[NodeId], int | None]) -> float:
    """How far a robot drives; not through portals, whose sides are in two frames."""
    return sum(poses[a].distance(poses[b]) for a, b in pairwise(route.nodes) if of(a) == of(b))


def _why(router: Router, route: Route, best: Route, hops: tuple[Hop, ...], gaps: tuple[Hop, ...]) -> str:
    """Reason of a route."""
    steps = "1 step" if len(hops) == 1 else f"{len(hops)} steps"
    length = sum(hop.distance for hop in hops)
    reason = f"{steps} over {length:.1f} m, cost {route.cost:.2f} m"
    begin = router.portals.floor(route.nodes[0])
    reason += f", on floor {begin}" if begin else ""
    for _, stop in router.portals.stops(route.nodes, route.edges):
        reason += f", through {stop.title} to {stop.beyond}"
    if gaps:
        many = "a gap" if len(gaps) == 1 else f"{len(gaps)} gaps"
        reason += f"; a way for {best.cost:.2f} m has {many} that robots do not drive"
    else:
        reason += "; no cheaper one is known, not even over edges that cannot be driven"
    older = sum(node in router.merged.superseded for node in route.nodes[1:-1])
    if older:
        reason += f"; {older} of its nodes are superseded: nothing else connects it"
    return reason


def _hops(
    router: Router, way: Route, poses: Mapping[NodeId, Pose2], hindrances: _Hindrances
) -> Iterator[Hop]:
    edges, portals = router.roads.union.edges, dict(router.portals.stops(way.nodes, way.edges))
    for number, ((a, b), edge_id) in enumerate(zip(pairwise(way.nodes), way.edges, strict=True)):
        pair = frozenset((a, b))
        if number in portals:
            yield _through(router, portals[number], pair, hindrances)
            continue
        edge, words = edges[edge_id], hindrances.words(pair)
        more = WARY_COST if words else 0.0
        hop = _hop(
            router, edge, a, b, poses, more, hindrances.rules.factors_for(hindrances.within).get(pair, 1.0)
        )
        words = "; ".join(filter(None, (hop.words, words, hindrances.preferred(pair))))
        yield replace(hop, words=words)


def _gaps(
    router: Router, way: Route, poses: Mapping[NodeId, Pose2], hindrances: _Hindrances
) -> tuple[Hop, ...]:
    """Those hops of a way that robots cannot drive, or should not."""
    roads, out = router.roads, []
    portals = dict(router.portals.stops(way.nodes, way.edges))
    for number, (a, b) in enumerate(pairwise(way.nodes)):
        if number in portals:
            if hindrances.words(frozenset((a, b))):
                out.append(_through(router, portals[number], frozenset((a, b)), hindrances))
            continue
        between = roads.union.edges_between(a, b)
        best = min(between, key=lambda e: (edge_cost(e, poses, True, router.costs), e.id))
        words = hindrances.words(frozenset((a, b)))
        if words or all(edge.id in roads.closed for edge in between):
            hop = _hop(router, best, a, b, poses, 0.0)
            out.append(replace(hop, words=words) if words else hop)
    return tuple(out)


def _through(router: Router, stop: PortalStop, pair: frozenset[NodeId], hindrances: _Hindrances) -> Hop:
    """A portal as a step of a way."""
    words = f"{stop.title}: the robot asks to be taken to {stop.beyond}"
    said = "; ".join(filter(None, (words, hindrances.words(pair), hindrances.preferred(pair))))
    cost = router.costs.per_portal * hindrances.rules.factors_for(hindrances.within).get(pair, 1.0)
    return Hop(stop.entry, stop.exit, str(stop.means), 0.0, 0.0, cost, said)


def _hop(
    router: Router,
    edge: Edge,
    a: NodeId,
    b: NodeId,
    poses: Mapping[NodeId, Pose2],
    more: float,
    factor: float = 1.0,
) -> Hop:
    between = poses[a].inverse() @ poses[b]
    implied = edge.id.agent in IMPLIED
    kind = edge.id.agent if implied else str(edge.kind)
    words = WORDS[kind] if implied or edge.kind not in RECOGNISED else reach_words(router.merged, edge)
    cost = factor * edge_cost(edge, poses, True, router.costs) + more
    return Hop(a, b, kind, between.distance(Pose2()), between.heading, cost, words)


def _apart(merged: MergedMap, start: NodeId, goal: NodeId, missing: str) -> RouteExplanation:
    """The explanation of two nodes that nothing joins, or of which one takes no part."""
    first, second = merged.component_of(start), merged.component_of(goal)
    if first is None or second is None:
        return RouteExplanation(start, goal, False, missing)
    apart = _nearest_maps(merged, start, goal, first, second)
    if apart is None:
        torn = [str(map_id) for map_id in sorted({start.map, goal.map}) if _pieces(merged, map_id) > 1]
        missing += f"; {' and '.join(torn)} {'is' if len(torn) == 1 else 'are'} in pieces"
    return RouteExplanation(start, goal, False, missing, apart=apart)


def _pieces(merged: MergedMap, hybrid_map: MapId) -> int:
    return sum(any(node.map == hybrid_map for node in component) for component in merged.components)


def _nearest_maps(
    merged: MergedMap, start: NodeId, goal: NodeId, first: int, second: int
) -> MapsExplanation | None:
    """Two maps, one of each part, between which most was found; None if one map lies in both parts."""
    sides = [merged.components[number] for number in (first, second)]
    part_of = {node: part for part in joined_maps(merged) for node in part}
    if part_of[start.map] == part_of[goal.map]:
        return None
    between: Counter[tuple[MapId, MapId]] = Counter({(start.map, goal.map): 0})
    for r in merged.refused:
        for a, b in ((r.a, r.b), (r.b, r.a)):
            if r.edge is None and a in sides[0] and b in sides[1]:
                between[a.map, b.map] += 1000 if r.link is not None else 1
    most = max(between, key=lambda pair: (between[pair], pair == (start.map, goal.map), pair))
    return explain_maps(merged, *most)

"""Ways through a hybrid map: A* with the paper's Euclidean weights and heuristic."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from heapq import heappop, heappush
from itertools import count, pairwise

from mapweave.hybridmap.counted import counted
from mapweave.hybridmap.hybrid_map import HybridMap, reached
from mapweave.hybridmap.ids import EdgeId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind
from mapweave.hybridmap.pose import Pose2


@dataclass(frozen=True)
class RouteSettings:
    """What a way costs, in metres. Everything is added to the Euclidean weight, so the heuristic stays below.

    Attributes:
        per_edge: each hop means one more recognition and one more approach.
        per_turn: a radian between the headings of two nodes.
        per_undriven: 1/m; an edge that was recognised but never driven costs more by its length times
            this: there may be an obstacle in between, as a wall where a room is seen through its door.
        per_portal: a portal; the robot stands there until a person has come, two minutes perhaps, in which it
            drives as far as this.
    """

    per_edge: float = 0.02
    per_turn: float = 0.1
    per_undriven: float = 1.5
    per_portal: float = 30.0


@dataclass(frozen=True)
class Route:
    """A way, or why there is none.

    Attributes:
        nodes: from start to goal; empty if there is no way.
        edges: one fewer, that lead from each node to the next.
        cost: of the whole way, m.
        reason: of the outcome, in words.
    """

    nodes: tuple[NodeId, ...]
    edges: tuple[EdgeId, ...]
    cost: float
    reason: str


@dataclass(slots=True)
class _Hop:
    """What joins two nodes.

    Attributes:
        barred: whether a robot cannot drive between them now.
        choices: cost and id of each edge.
    """

    barred: bool
    choices: list[tuple[float, EdgeId]] = field(default_factory=list)


class RouteTable:
    """All ways through a map at one time: made once, asked from several starts."""

    def __init__(
        self,
        hybrid_map: HybridMap,
        *,
        poses: Mapping[NodeId, Pose2] | None = None,
        penalties: Mapping[EdgeId, float] | None = None,
        blocked: Collection[tuple[NodeId, NodeId] | frozenset[NodeId]] = (),
        closed: Collection[EdgeId] = (),
        settings: RouteSettings | None = None,
        toll: float | None = None,
        factors: Mapping[frozenset[NodeId], float] | None = None,
        portals: Mapping[EdgeId, tuple[NodeId, NodeId]] | None = None,
    ) -> None:
        """Take a map.

        An edge costs the Euclidean distance of its two nodes, as in the paper, by `poses`; the heuristic is
        the distance to the goal by the same poses, so it is admissible and consistent by the triangle
        inequality, with any additional cost. Where no poses are given, each node's own pose in its map is
        used; between nodes of two maps, whose frames have nothing in common, the heuristic is then zero and a
        link costs the distance that it measured.

        Args:
            hybrid_map: nodes and edges; edges to nodes that are not there lead nowhere.
            poses: all in one frame; nodes without one cannot be on the way.
            penalties: extra cost of edges, m; not negative, negative ones count as none.
            blocked: pairs of nodes, in either order, between which the robot cannot drive.
            closed: edges that cannot be driven: they only give relative poses, see
                mapweave.hybridmap.reachability.
            settings: what a way costs.
            toll: then the search also passes pairs that are blocked or cannot be driven; each costs so much
                in addition, m. The cheapest way shows what is in the way.
            factors: by pairs of nodes, how many times as much edges cost; positive.
            portals: join nodes, also of different frames: distances say nothing of the ways through them, so
                that with portals A* is Dijkstra's search.
        """
        s = settings or RouteSettings()
        self._map = hybrid_map
        self._poses = poses
        self._closed = closed
        self._toll = toll
        self._places = poses if poses is not None else _own_poses(hybrid_map)
        self._barred = {frozenset(pair) for pair in blocked}
        factors = factors or {}
        # An edge may cost less than its length: the heuristic must stay below.
        self._least = min((1.0, *factors.values()))
        self._hops: dict[NodeId, dict[NodeId, _Hop]] = {}
        # In the order of ids, so that of ways of equal cost the same one is found in any order of insertion.
        for edge in sorted(hybrid_map.edges.values(), key=lambda edge: edge.id):
            barred = frozenset((edge.a, edge.b)) in self._barred
            if edge.a == edge.b or (barred and toll is None):
                continue
            if edge.a not in self._places or edge.b not in self._places:
                continue
            cost = edge_cost(edge, self._places, poses is not None, s)
            cost *= factors.get(frozenset((edge.a, edge.b)), 1.0) if factors else 1.0
            cost += max((penalties or {}).get(edge.id, 0.0), 0.0)
            self._hop(edge.a, edge.b, barred).choices.append((cost, edge.id))
        for edge_id, (a, b) in sorted((portals or {}).items()):
            barred = frozenset((a, b)) in self._barred
            if a not in self._places or b not in self._places or (barred and toll is None):
                continue
            cost = s.per_portal * factors.get(frozenset((a, b)), 1.0)
            self._hop(a, b, barred).choices.append((cost, edge_id))
        self._portals = tuple((portals or {}).values())
        one_frame = poses is not None or len({node_id.map for node_id in self._hops}) <= 1
        self._comparable = one_frame and not portals

    def find(self, start: NodeId, goal: NodeId) -> Route:
        """The cheapest way; one node and no edge if start is goal."""
        for name, node_id in (("start", start), ("goal", goal)):
            if node_id not in self._map.nodes:
                return Route((), (), 0.0, f"{name} {node_id} is not in the map")
            if self._poses is not None and node_id not in self._poses:
                return Route((), (), 0.0, f"{name} {node_id} has no pose in the merged map")
        if start == goal:
            return Route((start,), (), 0.0, "already there")
        nodes = self._cheapest_nodes(start, goal)
        if not nodes:
            return Route((), (), 0.0, self._why_not(start, goal))
        hops = [self._cheapest(self._hops[a][b]) for a, b in pairwise(nodes)]
        cost = sum(hop[0] for hop in hops if hop is not None)
        edges = tuple(hop[1] for hop in hops if hop is not None)
        return Route(tuple(nodes), edges, cost, f"{len(edges)} edges, {cost:.1f} m")

    def _hop(self, a: NodeId, b: NodeId, barred: bool) -> _Hop:
        """What joins two nodes, in either direction; made if there is nothing yet."""
        ahead, back = self._hops.setdefault(a, {}), self._hops.setdefault(b, {})
        back[a] = ahead.setdefault(b, _Hop(barred))
        return ahead[b]

    def _cheapest_nodes(self, start: NodeId, goal: NodeId) -> list[NodeId]:
        """The nodes of the cheapest way, by A* (Hart, Nilsson and Raphael 1968); none if there is no way."""
        # Of ways that cost the same, the one that was found first.
        order = count()
        queue: list[tuple[float, int, NodeId, float, NodeId | None]] = [(0.0, next(order), start, 0.0, None)]
        found: dict[NodeId, tuple[float, float]] = {}
        before: dict[NodeId, NodeId | None] = {}
        while queue:
            _, _, node, so_far, came_from = heappop(queue)
            if node in before:
                continue
            before[node] = came_from
            if node == goal:
                break
            for neighbour, hop in self._hops.get(node, {}).items():
                best = None if neighbour in before else self._cheapest(hop)
                if best is None:
                    continue
                cost = so_far + best[0]
                known = found.get(neighbour)
                if known is not None and known[0] <= cost:
                    continue
                left = self._distance(neighbour, goal) if known is None else known[1]
                found[neighbour] = cost, left
                heappush(queue, (cost + left, next(order), neighbour, cost, node))
        way: list[NodeId] = []
        at: NodeId | None = goal if goal in before else None
        while at is not None:
            way.append(at)
            at = before[at]
        return way[::-1]

    def _cheapest(self, hop: _Hop) -> tuple[float, EdgeId] | None:
        """The cheapest open edge between two nodes; whether one is closed is asked only on the way.

        None if nothing there can be driven.
        """
        choices = sorted(hop.choices, key=lambda choice: choice[0])
        free = (
            None
            if hop.barred
            else next((option for option in choices if option[1] not in self._closed), None)
        )
        if free is None and self._toll is not None:
            cost, edge_id = choices[0]
            return cost + self._toll, edge_id
        return free

    def _distance(self, node: NodeId, target: NodeId) -> float:
        return self._least * self._places[node].distance(self._places[target]) if self._comparable else 0.0

    def _why_not(self, start: NodeId, goal: NodeId) -> str:
        if not joined(self._map, start, goal, (), self._portals):
            return f"{start} and {goal} are in parts of the map that nothing joins"
        if not joined(self._map, start, goal, self._closed, self._portals):
            return f"what joins {start} and {goal} only ties poses: nothing there could be driven"
        if self._barred:
            return f"every way from {start} to {goal} is blocked ({counted(len(self._barred), 'pair')})"
        return f"a node on every way from {start} to {goal} has no pose in the merged map"


def joined(
    hybrid_map: HybridMap,
    start: NodeId,
    goal: NodeId,
    closed: Collection[EdgeId] = (),
    portals: Collection[tuple[NodeId, NodeId]] = (),
) -> bool:
    """Whether edges, or portals, lead from a node to another, whatever is blocked.

    Args:
        hybrid_map: nodes and edges; edges to nodes that are not there lead nowhere.
        start: one node.
        goal: the other.
        closed: edges that are not passed.
        portals: pairs of nodes that are joined, too.
    """
    there = hybrid_map.nodes

    def neighbours(node: NodeId) -> Iterator[NodeId]:
        for edge in hybrid_map.edges_at(node):
            if edge.a in there and edge.b in there and edge.id not in closed:
                yield edge.b if edge.a == node else edge.a
        for a, b in portals:
            if node in (a, b):
                yield b if node == a else a

    return goal in reached(start, neighbours)


def edge_cost(edge: Edge, places: Mapping[NodeId, Pose2], one_frame: bool, settings: RouteSettings) -> float:
    """What driving an edge costs, m; never less than the distance of its nodes by `places`."""
    measured = edge.a_from_b.mean
    relative = places[edge.a].inverse() @ places[edge.b]
    if not one_frame and edge.a.map != edge.b.map:
        relative = measured
    turn = abs(measured.heading) if edge.kind is EdgeKind.TURNED else abs(relative.heading)
    driven = edge.kind not in (EdgeKind.LOOP, EdgeKind.MERGED)
    way = relative.distance(Pose2())
    way *= 1.0 if driven else 1.0 + settings.per_undriven * way
    return way + settings.per_edge + settings.per_turn * turn


def _own_poses(hybrid_map: HybridMap) -> dict[NodeId, Pose2]:
    return {node.id: node.map_from_robot.mean for node in hybrid_map.nodes.values()}

"""Routes through the merged map."""

from __future__ import annotations

import math
import threading
from collections.abc import Collection, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from mapweave.hybridmap.annotation import Annotation, Annotations, Closure
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import EdgeId, NodeId
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import RouteAnswer, RouteLeg
from mapweave.hybridmap.reachability import RECOGNISED
from mapweave.hybridmap.reachability_cache import ReachabilityCache
from mapweave.hybridmap.route import Route, RouteSettings, RouteTable, joined
from mapweave.mapserver.active_nodes import without_faded
from mapweave.mapserver.obstacles import Disc, Discs
from mapweave.mapserver.portals import Portals
from mapweave.mapserver.roadmap import Roadmap
from mapweave.mapserver.route_rules import RouteRules, rule_words
from mapweave.merge.pose_graph.merged_map import MergedMap

NEAR = 0.5
"""Nodes nearer than this to each other count as joined, whatever they show, m: less than the distance that
two robots keep on the two sides of a wall."""
ENTRY_REACH = 1.5
"""A robot may enter the map at nodes nearer than this, m."""
ENTRY_COST = 3.0
"""Cost of a metre from the robot to its first node: no robot has driven it yet."""
ON_EDGE = 0.25
"""A robot this near to an edge that was driven is on it, m: along it a metre costs a metre, so that it
need not turn back to the edge's beginning."""
WARY_COST = 4.0
"""Cost of an edge that another robot could not drive, m."""


ENTRIES = 12
"""Nodes that are tried as the beginning of a route."""


class Choice(NamedTuple):
    """What a way is searched over.

    Attributes:
        poses: of the nodes.
        closed: edges that it does not pass.
    """

    poses: Mapping[NodeId, Pose2]
    closed: Collection[EdgeId]


class _Shared:
    """What all routers of one merged map share; made when it is asked for first."""

    def __init__(self, merged: MergedMap, reaches: ReachabilityCache | None) -> None:
        self._merged = merged
        self._reaches = reaches or ReachabilityCache()
        self._turn = threading.Lock()
        self._roads: Roadmap | None = None
        self._rules: tuple[Annotations, frozenset[Annotation], RouteRules] | None = None

    def roads(self) -> Roadmap:
        """What routes may use."""
        with self._turn:
            if self._roads is None:
                self._roads = Roadmap(self._merged, NEAR, self._reaches)
            return self._roads

    def rules(self, annotations: Annotations, stamp_ns: int) -> RouteRules:
        """What is closed and preferred; worked out again when the record has changed, or what holds of it."""
        holding = frozenset(
            entry for entry, closure in annotations.in_force(Closure) if closure.holds(stamp_ns)
        )
        kept = self._rules
        if kept is None or kept[0] is not annotations or kept[1] != holding:
            kept = self._rules = annotations, holding, RouteRules(self.roads(), annotations, stamp_ns)
        return kept[2]


class Router:
    """Finds routes from node to node. It belongs to one merged map; make another for the next.

    Attributes:
        merged: the map.
        costs: what a way costs.
        annotations: the record, with closures and preferences.
    """

    def __init__(
        self,
        merged: MergedMap,
        costs: RouteSettings | None = None,
        reaches: ReachabilityCache | None = None,
    ) -> None:
        """Take a merged map. Nothing is made of it before the first question.

        Args:
            merged: the map.
            costs: what a way costs.
            reaches: cache of reachability from earlier maps; it is filled.
        """
        self.merged = merged
        self.costs = costs or RouteSettings()
        self._shared = _Shared(merged, reaches)
        self.annotations, self._stamp_ns = Annotations(), 0
        self._discs: Discs | None = None

    def past(self, discs: Collection[Disc]) -> Router:
        """The same router, with places that ways should not pass."""
        router = copy(self)
        router._discs = Discs(self.roads, discs) if discs else None
        return router

    def at(self, annotations: Annotations, stamp_ns: int) -> Router:
        """The same router, by closures and preferences at a time (wall time, ns); costs nothing."""
        router = copy(self)
        router.annotations, router._stamp_ns = annotations, stamp_ns
        return router

    @property
    def roads(self) -> Roadmap:
        """What routes may use; made when it is asked for first."""
        return self._shared.roads()

    @property
    def rules(self) -> RouteRules:
        """What is closed, preferred and avoided."""
        return self._shared.rules(self.annotations, self._stamp_ns)

    @property
    def portals(self) -> Portals:
        """Where people take robots from one part of the map to another."""
        return Portals(self.merged, self.annotations)

    def route(
        self,
        start: NodeId,
        goal: NodeId,
        blocked: Collection[tuple[NodeId, NodeId]] = (),
        wary: Collection[tuple[NodeId, NodeId]] = (),
        start_from_robot: Pose2 | None = None,
    ) -> RouteAnswer:
        """Find the cheapest way.

        Args:
            start: a node by which the robot is localized.
            goal: the node to reach.
            blocked: pairs of nodes, in either order, between which the robot cannot drive.
            wary: pairs of nodes, in either order, between which another robot did not get through: they are
                driven only where every other way is much longer.
            start_from_robot: where the robot is. It may see the start node from afar, then the route begins
                at a node that is nearer and better placed; None if it is at the start node.

        Returns:
            The legs. Their relative poses are those of the optimised graph: each is the best estimate
            from all edges together. That of the first is relative to `start`. A way through portals ends at
            the first of them.
        """
        present, pruned = self.merged.poses, self.merged.pruned
        if any(node in pruned and node not in present for node in (start, goal)):
            first, last = pruned.successor(start, present), pruned.successor(goal, present)
            if first is not None and last is not None:
                return self._beside(start, *first, last[0], blocked, wary, start_from_robot)
        if missing := self.missing(start, goal):
            return RouteAnswer((), missing)
        within = self.rules.around(start, start_from_robot or Pose2())
        for rules in (True, False) if self.rules else (True,):
            reason = ""
            for choice in self.choices(start, goal):
                best, why_not = self._cheapest(
                    start, goal, choice, blocked, wary, start_from_robot, within if rules else None
                )
                if best is not None and rules:
                    return self._answer(start, best)
                if best is not None:
                    return RouteAnswer((), self._all_closed(best.nodes, goal, within))
                reason = reason or why_not
        return RouteAnswer((), reason or f"every way into the map near {start} is blocked")

    def _beside(
        self,
        start: NodeId,
        near: NodeId,
        near_from_start: Pose2,
        goal: NodeId,
        blocked: Collection[tuple[NodeId, NodeId]],
        wary: Collection[tuple[NodeId, NodeId]],
        start_from_robot: Pose2 | None,
    ) -> RouteAnswer:
        """The way from a node that may have left the map, by another one that replaces it."""
        if near == start:
            return self.route(near, goal, blocked, wary, start_from_robot)
        answer = self.route(near, goal, blocked, wary, near_from_start @ (start_from_robot or Pose2()))
        if not answer.legs:
            return answer
        known = PoseGaussian(near_from_start.inverse(), np.zeros((3, 3)))
        entry = replace(answer.legs[0], previous_from_node=known @ answer.legs[0].previous_from_node)
        return replace(answer, legs=(entry, *answer.legs[1:]))

    def missing(self, start: NodeId, goal: NodeId, names: tuple[str, str] = ("start", "goal")) -> str:
        """Why no route can exist, in words; empty if there may be one.

        Args:
            start: where it begins.
            goal: where it ends.
            names: what the words call the two.
        """
        for name, node in zip(names, (start, goal), strict=True):
            if node not in self.merged.poses:
                why = self.merged.why_left_out(node)
                return f"{name} {node} is not in the merged map{f': {why}' if why else self._nearest(node)}"
        parts = self.merged.component_of(start), self.merged.component_of(goal)
        if parts[0] != parts[1] and not (portals := self.portals).lead(start, goal):
            return portals.apart(start, goal)
        return self.closed_goal(goal, names[1])

    def _nearest(self, node: NodeId) -> str:
        """Which maps or nodes there are instead of one that is not there."""
        try:
            self.merged.check(node)
        except InvalidValue as error:
            return f": {error}"
        return ""

    def closed_goal(self, goal: NodeId, name: str = "goal") -> str:
        """Why a goal, which the words call `name`, is closed; empty if it is not."""
        closure = self.rules.closure_at(goal)
        return (
            "" if closure is None else f"{name} {goal} is in {closure.name}, which is {rule_words(closure)}"
        )

    def choices(self, start: NodeId, goal: NodeId) -> Iterator[Choice]:
        """What a way is searched over, one after the other.

        Superseded nodes are passed only where necessary, and at portals. Where nothing that can be driven
        joins the two, an edge is tried that is longer, or turns more, than the servo manages, if landmarks
        stay in view on it: a robot with proximity sensors gets near by these. Others refuse.
        """
        roads, portals = self.roads, self.portals.edges.values()
        sides = (node for pair in portals for node in pair)
        active = roads.active_poses | {node: roads.poses[node] for node in (start, goal, *sides)}
        yield Choice(active, roads.closed)
        yield Choice(roads.poses, roads.closed)
        if not joined(roads.union, start, goal, roads.closed, portals):
            yield Choice(roads.poses, roads.out_of_sight)

    def ways(
        self,
        choice: Choice,
        blocked: Collection[tuple[NodeId, NodeId]] = (),
        wary: Collection[tuple[NodeId, NodeId]] = (),
        toll: float | None = None,
        within: Collection[Annotation] | None = (),
    ) -> RouteTable:
        """The ways over some nodes and edges; see `route` and mapweave.hybridmap.route.RouteTable.

        Args:
            choice: which.
            blocked: pairs of nodes between which the robot cannot drive.
            wary: pairs of nodes between which another robot did not get through.
            toll: what a pair that is blocked, closed, or cannot be driven costs, m; None: it is not passed.
            within: closures of areas which the robot may leave; None: as if nothing were closed or preferred.
        """
        rules = self.rules
        closed = set() if within is None else rules.closed_for(within)
        barred = [*map(frozenset, blocked), *closed, *(self._discs.barred if self._discs else ())]
        return RouteTable(
            self.roads.union, poses=choice.poses, penalties=self._penalties(wary), blocked=barred,
            closed=choice.closed, settings=self.costs, toll=toll,
            factors={} if within is None else rules.factors_for(within), portals=self.portals.edges,
        )  # fmt: skip

    def _all_closed(self, nodes: Sequence[NodeId], goal: NodeId, within: Collection[Annotation]) -> str:
        """Why there is no way, if there would be one without closures."""
        first = self.rules.first_closed(nodes, within)
        if first is None:
            return f"every way to {goal} is closed where the robot is"
        number, closure = first
        return (
            f"every way to {goal} is closed; the cheapest between {nodes[number]} and {nodes[number + 1]}, "
            f"{rule_words(closure)}"
        )

    def _cheapest(
        self,
        start: NodeId,
        goal: NodeId,
        choice: Choice,
        blocked: Collection[tuple[NodeId, NodeId]],
        wary: Collection[tuple[NodeId, NodeId]],
        start_from_robot: Pose2 | None,
        within: Collection[Annotation] | None,
    ) -> tuple[Route | None, str]:
        """The cheapest way over some nodes and edges, or why the nearest entry has none."""
        ways, poses = self.ways(choice, blocked, wary, within=within), choice.poses
        best: Route | None = None
        reason, best_cost = "", math.inf
        for entry, cost in self._entries(start, poses, start_from_robot, blocked, within):
            if cost >= best_cost:
                break
            route = ways.find(entry, goal)
            reason = reason or route.reason
            if route.nodes and cost + route.cost < best_cost:
                best, best_cost = route, cost + route.cost
        return best, reason

    def _answer(self, start: NodeId, best: Route) -> RouteAnswer:
        union = self.roads.union
        stops = list(self.portals.stops(best.nodes, best.edges))
        last, portal = stops[0] if stops else (len(best.edges), None)
        way = best.nodes[: last + 1]
        nodes = {node: without_faded(union.nodes[node], self.merged) for node in way}
        legs = [RouteLeg(nodes[way[0]], self._relative(start, way[0]), None)]
        for (before, node), edge_id in zip(pairwise(way), best.edges, strict=False):
            kind = union.edges[edge_id].kind
            legs.append(RouteLeg(nodes[node], self._relative(before, node), kind))
        through = "".join(f", through {stop.title} to {stop.beyond}" for _, stop in stops)
        tried = "".join(
            f"; no robot has driven between {a} and {b}"
            for (a, b), edge_id in zip(pairwise(way), best.edges, strict=False)
            if edge_id in self.roads.closed
        )
        return RouteAnswer(tuple(legs), best.reason + through + tried, portal)

    def _entries(
        self,
        start: NodeId,
        poses: Mapping[NodeId, Pose2],
        start_from_robot: Pose2 | None,
        blocked: Collection[tuple[NodeId, NodeId]],
        within: Collection[Annotation] | None,
    ) -> list[tuple[NodeId, float]]:
        """Nodes where the route may begin with what it costs to get there, cheapest first."""
        if start_from_robot is None:
            return [(start, 0.0)]
        pose = poses[start] @ start_from_robot
        component = self.merged.component_of(start)
        barred = {frozenset(pair) for pair in blocked}
        members = self.merged.components[component or 0]
        nearest = sorted((pose.distance(poses[n]), n) for n in members if n in poses)
        entries = [
            (node, ENTRY_COST * distance - self._saved(pose, node, distance, barred))
            for distance, node in nearest
            if (distance <= ENTRY_REACH or node == start) and frozenset((start, node)) not in barred
        ]
        if discs := self._discs:
            number = component or 0
            entries = [(node, cost + discs.entry(number, pose, poses[node])) for node, cost in entries]
            entries = [entry for entry in entries if math.isfinite(entry[1])]
        if within is not None and (rules := self.rules):
            entries = [
                (node, cost)
                for node, cost in entries
                if not rules.bars(component or 0, pose, poses[node], within)
            ]
        return sorted(entries, key=lambda entry: entry[1])[:ENTRIES]

    def _saved(self, pose: Pose2, node: NodeId, distance: float, barred: set[frozenset[NodeId]]) -> float:
        """How much cheaper it is to get to a node for a robot that is on an edge to it, m."""
        roads = self.roads
        target = roads.poses[node]
        goal = np.array([target.x, target.y])
        at = np.array([pose.x, pose.y])
        saved = 0.0
        for edge in roads.union.edges_at(node):
            neighbour = edge.b if edge.a == node else edge.a
            if edge.kind in RECOGNISED or frozenset((node, neighbour)) in barred:
                continue
            if neighbour not in roads.poses:
                continue
            along = np.array([roads.poses[neighbour].x, roads.poses[neighbour].y]) - goal
            share = float(np.clip((at - goal) @ along / max(along @ along, 1e-9), 0.0, 1.0))
            off = float(np.linalg.norm(at - goal - share * along))
            if off <= ON_EDGE and share < 1.0:
                saved = max(saved, (ENTRY_COST - 1.0) * (distance - off))
        return saved

    def _penalties(self, wary: Collection[tuple[NodeId, NodeId]]) -> Mapping[EdgeId, float]:
        costs = dict(self._discs.costs) if self._discs else {}
        for pair in map(frozenset, wary):
            costs[pair] = costs.get(pair, 0.0) + WARY_COST
        if not costs:
            return {}
        hops = ((edge.id, frozenset((edge.a, edge.b))) for edge in self.roads.union.edges.values())
        return {edge: costs[hop] for edge, hop in hops if hop in costs}

    def _relative(self, a: NodeId, b: NodeId) -> PoseGaussian:
        if a == b:
            return PoseGaussian(Pose2(), np.zeros((3, 3)))
        relative = self.merged.relative(a, b)
        assert relative is not None, "nodes of one component"
        return relative

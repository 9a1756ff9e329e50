"""Renewal: nodes that others of the same place stand for, so that a map does not grow with every drive.

A node is superseded if a robot that stood there would know itself by another one and could servo to it: the
two were verified to show the same, enough common landmarks stay in view between them, and they stand within
the servo's basin. Besides, the other one must know about as many depths; whatever the node stood for itself
must have somebody else to stand for it; and no way between its neighbours may become much longer without it.

What is left dominates all nodes (each is covered by a living one, directly) and holds none that could be
spared. To find the fewest is NP-hard; here nodes go one by one, those first that stand for little and of
which newer views were taken since.

Superseded nodes stay where they are: they tie poses, and come back if what supersedes them does not stand.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from mapweave.hybridmap.node import Node, NodeId
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.hybridmap.reachability import FARTHEST, STOPS, WIDEST, least_in_view
from mapweave.hybridmap.reachability_cache import ReachabilityCache
from mapweave.hybridmap.superseded import Superseded
from mapweave.merge.map_maintenance.adjacency import Adjacency
from mapweave.merge.map_maintenance.comparisons import Comparisons
from mapweave.merge.map_maintenance.node_age import is_older
from mapweave.merge.map_maintenance.traversability import ForeignEdges, Traversability
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.pose_graph.solved_graph import PoseGraph

NEAR = 0.5
"""Nodes nearer than this to each other stand in one place, as for routes, m."""


SECOND = 1_000_000_000


class NodeSuperseder:
    """Goes from merged map to merged map with what was superseded: only what is new is looked at."""

    def __init__(
        self,
        reaches: ReachabilityCache | None = None,
    ) -> None:
        """Begin with nothing superseded.

        Args:
            reaches: what is known of edges; it is written to.
        """
        self._comparisons = Comparisons()
        self._reaches = reaches or ReachabilityCache()
        self._fates: dict[NodeId, Superseded] = {}
        self._seen: dict[NodeId, Node] = {}
        self._links = Adjacency()
        self._graphs: tuple[PoseGraph, ...] = ()
        self._foreign = ForeignEdges()
        self._firm: dict[NodeId, NodeId] = {}

    def renewed(self, merged: MergedMap) -> MergedMap:
        """The same map with the nodes that are superseded.

        Args:
            merged: the next merged map of the same fleet.
        """
        nodes = self._changed(merged)
        anew = {node for node, one in nodes.items() if self._seen.get(node) is not one}
        self._seen |= nodes
        fresh = {node for link in self._links.follow(merged.links) for node in link.pair}
        fresh = anew | fresh & nodes.keys()
        # One that is known better is judged anew, as are those that it stood for.
        for node, fate in tuple(self._fates.items()):
            if node not in self._seen or fate.by not in self._seen or {node, fate.by} & anew:
                del self._fates[node]
                fresh |= {node} & nodes.keys()
        if nodes:
            foreign = self._foreign.of(merged.maps)
            passages = Traversability(merged, self._links, self._reaches, NEAR, foreign, self._fates)
            this = _Round(merged, nodes, self._links, self._fates, self._firm, passages, self._comparisons)
            this.look_at(fresh | this.revive())
        return replace(merged, superseded=dict(sorted(self._fates.items())))

    def _changed(self, merged: MergedMap) -> dict[NodeId, Node]:
        """Nodes of components that were solved anew; those that are gone are forgotten."""
        known = {id(graph) for graph in self._graphs}
        left = {id(graph) for graph in merged.graphs}
        for graph in self._graphs:
            if id(graph) not in left:
                for node in graph.nodes:
                    # Known still, if it is in another component now.
                    if merged.component_of(node) is None:
                        self._seen.pop(node, None)
                        self._firm.pop(node, None)
        self._graphs = merged.graphs
        return {
            node: merged.maps[node.map].nodes[node]
            for graph in merged.graphs
            if id(graph) not in known
            for node in graph.nodes
        }


FOUND = 20
"""Landmarks that both show and that stay in view between them."""
DETOUR = 1.5
"""A way between neighbours may become longer by this, m."""
DEPTHS = 0.7
"""A node that stands for another knows at least this share of the number of depths that the other knows,"""
ENOUGH = 60
"""or at least this many."""
AGAIN = 120.0
"""Nodes of one map stand for each other only if this much time lies between them, s: views of one visit
complete each other."""
GATE = 16.3
"""Chi-square with 3 degrees of freedom within which a comparison of two nodes bears out the merged map."""
FLOOR = (0.05, 0.05, 0.03)
"""Error of comparison and map that no covariance tells of, m, m and rad."""


class _Round:
    """One merged map's worth of work on the table of what is superseded."""

    def __init__(
        self,
        merged: MergedMap,
        nodes: dict[NodeId, Node],
        links: Adjacency,
        fates: dict[NodeId, Superseded],
        firm: dict[NodeId, NodeId],
        passages: Traversability,
        comparisons: Comparisons,
    ) -> None:
        self._merged, self._nodes, self._fates, self._firm = merged, nodes, fates, firm
        self._comparisons = comparisons
        self._links = links
        self._refused = {refusal.pair for refusal in merged.refused if refusal.edge is None}
        self._stands_for: dict[NodeId, set[NodeId]] = {}
        for node, fate in fates.items():
            self._stands_for.setdefault(fate.by, set()).add(node)
        self._passages = passages
        self._basins: dict[NodeId, list[tuple[NodeId, Pose2]]] = {}

    def revive(self) -> set[NodeId]:
        """Give life back to nodes whose successor is too far off now, or shown to be wrong."""
        gone = set()
        for node, fate in self._fates.items():
            if node not in self._nodes and fate.by not in self._nodes:
                continue
            if self._merged.component_of(node) == self._merged.component_of(fate.by):
                between = self._between(node, fate.by)
                near = between.distance(Pose2()) < 1.1 * FARTHEST and abs(between.heading) < 1.1 * WIDEST
                if near and _ordered(node, fate.by) not in self._refused:
                    continue
            gone.add(node)
        for node in gone:
            self._stands_for[self._fates.pop(node).by].discard(node)
            self._passages.add(node)
        return gone

    def look_at(self, fresh: Iterable[NodeId]) -> None:
        """See which nodes can be spared where something is new, the least needed first."""
        reach = FARTHEST
        living = {node for node in fresh if node not in self._fates}
        for node in tuple(living):
            living.update(self._passages.around(node, reach))
        since = {node: self._since(node) for node in living}

        def need(node: NodeId) -> tuple[int, int, NodeId]:
            # It is worth what it stands for; each later view of its place makes it as much less so.
            return len(self._stands_for.get(node, ())) - since[node], self._nodes[node].stamp_ns, node

        queue = [need(node) for node in living]
        heapq.heapify(queue)
        while queue:
            node = queue[0][-1]
            # What it stands for may have become more since; it never becomes less.
            if (now := need(node)) != queue[0]:
                heapq.heapreplace(queue, now)
                continue
            heapq.heappop(queue)
            self._try(node)

    def _since(self, node: NodeId) -> int:
        """How many newer nodes of other visits, superseded or not, are within the basin."""
        one, others = self._nodes[node], (self._nodes[other] for other, _ in self._like(node))
        return sum(is_older(one, other) and not self._one_visit(one, other) for other in others)

    def _try(self, node: NodeId) -> None:
        """Leave a node out if others stand for it, and for all that it stood for."""
        heirs: dict[NodeId, Superseded] = {}
        # What could not be left to others the last time comes first.
        for orphan in sorted(
            self._stands_for.get(node, ()), key=lambda one: (one != self._firm.get(node), one)
        ):
            heir = self._heir(orphan, node)
            if heir is None:
                self._firm[node] = orphan
                return
            heirs[orphan] = heir
        fate = self._heir(node, node)
        if fate is None or not self._passages.spare(node, fate.by, DETOUR):
            return
        self._passages.remove(node)
        self._stands_for.pop(node, None)
        self._firm.pop(node, None)
        for one, heir in ((node, fate), *heirs.items()):
            self._fates[one] = heir
            self._stands_for.setdefault(heir.by, set()).add(one)

    def _heir(self, orphan: NodeId, but: NodeId) -> Superseded | None:
        """Who stands for a node if it is not the one given: the living one that is most like it."""
        for other, between in self._like(orphan):
            if other != but and self._passages.has(other):
                fate = self._covers(orphan, other, between)
                if fate is not None:
                    return fate
        return None

    def _like(self, node: NodeId) -> list[tuple[NodeId, Pose2]]:
        """Nodes within the basin, living or not, and how they stand to it: those most like it first."""
        if node not in self._basins:
            around = self._passages.around(node, FARTHEST, also_gone=True)
            between = self._passages.stances(node, around)
            distances, turns = np.hypot(between[:, 0], between[:, 1]), np.abs(between[:, 2])
            order = np.argsort(distances / FARTHEST + turns / WIDEST, kind="stable")
            inside = (distances <= FARTHEST) & (turns <= WIDEST)
            self._basins[node] = [
                (around[k], Pose2.from_vector(between[k])) for k in order[inside[order]].tolist()
            ]
        return self._basins[node]

    def _covers(self, one: NodeId, other: NodeId, between: Pose2) -> Superseded | None:
        """Whether the other one, which is within the basin, can stand for the one."""
        a, b = self._nodes[one], self._nodes[other]
        if self._one_visit(a, b):
            return None
        if b.landmarks.has_depth.sum() < min(DEPTHS * a.landmarks.has_depth.sum(), ENOUGH):
            return None
        link = self._links.between(one, other) or self._compare(a, b)
        if link is None:
            return None
        link = link if link.a == one else link.turned()
        found = least_in_view(link.shared, a, b, between, STOPS)
        if found < FOUND:
            return None
        return Superseded(other, found, between.distance(Pose2()), abs(between.heading))

    def _compare(self, a: Node, b: Node) -> Link | None:
        """A link between two nodes that the merge had no need to compare; one that it refused is none."""
        pair = _ordered(a.id, b.id)
        if pair in self._refused:
            return None
        verdict = self._comparisons.link(a, b, FOUND)
        if verdict is None:
            return None
        off = (verdict.a_from_b.mean.inverse() @ self._between(*verdict.pair)).vector
        spread = verdict.a_from_b.covariance + np.diag(np.square(FLOOR))
        # The map's own doubt only lets more pass, and of a large map it takes long to say.
        if _distance2(off, spread) >= GATE:
            there = self._merged.relative(*verdict.pair)
            assert there is not None, "nodes of one component"
            return verdict if _distance2(off, spread + there.covariance) < GATE else None
        return verdict

    def _one_visit(self, a: Node, b: Node) -> bool:
        return a.id.map == b.id.map and abs(a.stamp_ns - b.stamp_ns) < AGAIN * SECOND

    def _between(self, a: NodeId, b: NodeId) -> Pose2:
        return self._merged.pose(a).inverse() @ self._merged.pose(b)


def _distance2(off: Array, spread: Array) -> float:
    return float(off @ np.linalg.solve(spread, off))


def _ordered(a: NodeId, b: NodeId) -> tuple[NodeId, NodeId]:
    return (a, b) if a <= b else (b, a)

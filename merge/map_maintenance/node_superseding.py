"""Node superseding: newer nodes of the same place replace older ones, so maps do not grow with every drive.

A node is superseded if a robot at its pose would recognise another node and could servo to it: the two were
verified, enough common landmarks stay in view between them, and the distance is within the servo's basin. In
addition, the other node must have about as many depths; the nodes that the first one covers must be covered
by others; and no way between its neighbours may become much longer without it.

The active nodes dominate all nodes (each is covered directly by an active one) and none of them can be
removed. To find the fewest is NP-hard; here nodes are tried one by one, first those that cover few nodes and
of which newer views exist.

Views from next to a wall show what no other view does, and every drive adds some. So a node that many later
views surround is superseded whatever they show.

Superseded nodes keep their poses and edges, and become active again if their successor is removed.

Nodes of maps that may not be right supersede none of other robots' nodes, and are not asked about the ways of
these: a superseded node answers no more, and is deleted in the end.
"""

import heapq
from collections.abc import Iterable, Mapping, Set
from dataclasses import dataclass, field, replace

import numpy as np

from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.hybridmap.reachability import FARTHEST, WIDEST
from mapweave.hybridmap.reachability_cache import ReachabilityCache
from mapweave.hybridmap.superseded import Superseded
from mapweave.hybridmap.superseding import (
    CROWD,
    DETOUR,
    FOUND,
    LATER,
    SECOND,
    WAY,
    is_candidate,
    same_visit,
    superseded_by,
)
from mapweave.merge.map_maintenance.adjacency import Adjacency
from mapweave.merge.map_maintenance.comparisons import Comparisons
from mapweave.merge.map_maintenance.node_age import is_older
from mapweave.merge.map_maintenance.superseding_log import SupersedingLog
from mapweave.merge.map_maintenance.traversability import ForeignEdges, Traversability
from mapweave.merge.pose_graph.candidates import Pair
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.pose_graph.solved_graph import PoseGraph

NEAR = 0.5
"""Nodes nearer than this to each other stand in one place, as for routes, m."""


@dataclass(frozen=True)
class Superseding:
    """What a superseder knows after a merge, so that another one can go on from there.

    Attributes:
        superseded: nodes, and why.
        judged: nodes that were evaluated, as they were then.
        linked: pairs of nodes with a link.
        unsure: maps that may not be right.
        log: what the last merges changed.
    """

    superseded: Mapping[NodeId, Superseded] = field(default_factory=dict)
    judged: Mapping[NodeId, Node] = field(default_factory=dict)
    linked: Set[Pair] = frozenset()
    unsure: Set[MapId] = frozenset()
    log: SupersedingLog = field(default_factory=SupersedingLog)


class NodeSuperseder:
    """Keeps the superseded nodes from merged map to merged map: only changes are evaluated."""

    def __init__(
        self,
        reaches: ReachabilityCache | None = None,
    ) -> None:
        self._comparisons = Comparisons()
        self._reaches = reaches or ReachabilityCache()
        self._superseded: dict[NodeId, Superseded] = {}
        self._nodes_seen: dict[NodeId, Node] = {}
        self._links = Adjacency()
        self._graphs: tuple[PoseGraph, ...] = ()
        self._foreign = ForeignEdges()
        self._blocking: dict[NodeId, NodeId] = {}
        self._unsure: Set[MapId] = frozenset()
        self._linked: Set[Pair] = frozenset()
        self._log = SupersedingLog()

    @property
    def state(self) -> Superseding:
        """What it knows after the newest merged map."""
        linked = frozenset(link.pair for link in self._links)
        unsure = frozenset(self._unsure)
        return Superseding(dict(self._superseded), dict(self._nodes_seen), linked, unsure, self._log)

    def resume(self, state: Superseding) -> None:
        """Go on from what another superseder knew, with the next merged map.

        What is not as it was then is judged again: nodes that are others now or gone, and new links.

        Args:
            state: of merged maps of the same fleet.
        """
        self._superseded, self._nodes_seen = dict(state.superseded), dict(state.judged)
        self._linked, self._unsure, self._log = state.linked, state.unsure, state.log

    def renewed(self, merged: MergedMap, unsure: Set[MapId] = frozenset()) -> MergedMap:
        """The same map with the nodes that are superseded.

        Args:
            merged: the next merged map of the same fleet.
            unsure: maps that may not be right: their nodes and those of other robots do not supersede each
                other.
        """
        doubted, differ, self._unsure = unsure - self._unsure, self._unsure ^ unsure, unsure
        nodes, gone = self._changed(merged, differ)
        changed = {node for node, content in nodes.items() if self._nodes_seen.get(node) is not content}
        self._nodes_seen |= nodes
        come = {link.pair for link in self._links.follow(merged.links)} - self._linked
        cut = {pair for pair in (*self._links.cut, *self._linked) if self._links.between(*pair) is None}
        self._linked = frozenset()
        # How others have superseded each other does not depend on a map that is no longer with them.
        self._log, undone = self._log.followed(merged, doubted, self._superseded, nodes)
        changed |= undone.judged
        come = {
            pair for pair in come - undone.known | undone.linked if self._links.between(*pair) is not None
        }
        cut |= {pair for pair in undone.known if self._links.between(*pair) is None}
        noted = frozenset(changed), frozenset(come), cut - undone.linked
        changed |= undone.parted_judged
        come |= {pair for pair in undone.parted_linked if self._links.between(*pair) is not None}
        fresh = {node for pair in come for node in pair}
        fresh = changed | fresh & nodes.keys() | {node for node in nodes if node.map in differ}
        # A node that was written again is judged again, with those that it covers.
        for node, successor in tuple(self._superseded.items()):
            if (
                node not in self._nodes_seen
                or successor.by not in self._nodes_seen
                or {node, successor.by} & changed
                or _apart(node, successor.by, unsure)
            ):
                del self._superseded[node]
                fresh |= {node} & nodes.keys()
        if nodes:
            foreign = self._foreign.of(merged.maps)
            traversability = Traversability(
                merged, self._links, self._reaches, NEAR, foreign, self._superseded, unsure
            )
            round_ = _Round(
                merged,
                nodes,
                self._links,
                self._superseded,
                self._blocking,
                traversability,
                self._comparisons,
                unsure,
            )
            round_.update(fresh | round_.reinstate())
        pruned = {node for node in gone if node in merged.pruned.nodes}
        self._log = self._log.noted(self._superseded, undone, *noted, pruned)
        return replace(merged, superseded=dict(sorted(self._superseded.items())))

    def _changed(self, merged: MergedMap, differ: Set[MapId]) -> tuple[dict[NodeId, Node], Set[NodeId]]:
        """Nodes of components that were solved again, or with maps that became unsure, or sure; and those
        that have gone, which are forgotten.
        """
        solved = {id(graph) for graph in self._graphs}
        remaining = {id(graph) for graph in merged.graphs}
        gone = {
            node
            for graph in self._graphs
            if id(graph) not in remaining
            for node in graph.nodes
            # Known still, if it is in another component now.
            if merged.component_of(node) is None
        }
        if not self._graphs:
            # Of what it resumed from, some may be gone, too.
            gone = {node for node in self._nodes_seen if merged.component_of(node) is None}
        for node in gone:
            self._nodes_seen.pop(node, None)
            self._blocking.pop(node, None)
        if gone:
            self._comparisons.forget(gone)
        self._graphs = merged.graphs
        nodes = {
            node: merged.maps[node.map].nodes[node]
            for graph in merged.graphs
            if id(graph) not in solved or not graph.maps.isdisjoint(differ)
            for node in graph.nodes
        }
        return nodes, gone


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
        superseded: dict[NodeId, Superseded],
        blocking: dict[NodeId, NodeId],
        traversability: Traversability,
        comparisons: Comparisons,
        unsure: Set[MapId],
    ) -> None:
        self._merged, self._nodes, self._superseded, self._blocking = merged, nodes, superseded, blocking
        self._comparisons, self._unsure = comparisons, unsure
        self._links = links
        self._refused = {refusal.pair for refusal in merged.refused if refusal.edge is None}
        self._covered: dict[NodeId, set[NodeId]] = {}
        for node, successor in superseded.items():
            self._covered.setdefault(successor.by, set()).add(node)
        self._traversability = traversability
        self._basins: dict[NodeId, list[tuple[NodeId, Pose2]]] = {}

    def reinstate(self) -> set[NodeId]:
        """Give life back to nodes whose successor is too far off now, or shown to be wrong."""
        reinstated = set()
        for node, successor in self._superseded.items():
            if node not in self._nodes and successor.by not in self._nodes:
                continue
            if self._merged.component_of(node) == self._merged.component_of(successor.by):
                between = self._between(node, successor.by)
                close = between.distance(Pose2()) < 1.1 * FARTHEST and abs(between.heading) < 1.1 * WIDEST
                if close and _ordered(node, successor.by) not in self._refused:
                    continue
            reinstated.add(node)
        for node in reinstated:
            self._covered[self._superseded.pop(node).by].discard(node)
            self._traversability.add(node)
        return reinstated

    def update(self, fresh: Iterable[NodeId]) -> None:
        """See which nodes can be spared where something is new, the least needed first."""
        reach = FARTHEST
        active = {node for node in fresh if node not in self._superseded}
        for node in tuple(active):
            active.update(self._traversability.around(node, reach))
        newer = {node: self._newer_nodes(node) for node in active}

        def need(node: NodeId) -> tuple[int, int, NodeId]:
            # A node's value is the count of nodes that it covers, less the later views of its place.
            return len(self._covered.get(node, ())) - newer[node], self._nodes[node].stamp_ns, node

        queue = [need(node) for node in active]
        heapq.heapify(queue)
        while queue:
            node = queue[0][-1]
            # The count of covered nodes may have grown since; it never shrinks.
            if (now := need(node)) != queue[0]:
                heapq.heapreplace(queue, now)
                continue
            heapq.heappop(queue)
            self._try_removing(node)

    def _newer_nodes(self, node: NodeId) -> int:
        """How many newer nodes of other visits, superseded or not, are within the basin."""
        this, neighbours = (
            self._nodes[node],
            (self._nodes[neighbour] for neighbour, _ in self._neighbours(node)),
        )
        return sum(is_older(this, neighbour) and not same_visit(this, neighbour) for neighbour in neighbours)

    def _try_removing(self, node: NodeId) -> None:
        """Supersede a node if others cover it, and all nodes that it covers."""
        successors: dict[NodeId, Superseded] = {}
        # What could not be left to others the last time comes first.
        for covered in sorted(
            self._covered.get(node, ()), key=lambda other: (other != self._blocking.get(node), other)
        ):
            replacement = self._find_successor(covered, node)
            if replacement is None:
                self._blocking[node] = covered
                return
            successors[covered] = replacement
        successor = self._find_successor(node, node) or self._crowded_out(node)
        if successor is None or not self._traversability.spare(node, successor.by, DETOUR):
            return
        self._traversability.remove(node)
        self._covered.pop(node, None)
        self._blocking.pop(node, None)
        for other, replacement in ((node, successor), *successors.items()):
            self._superseded[other] = replacement
            self._covered.setdefault(replacement.by, set()).add(other)

    def _find_successor(self, covered: NodeId, excluded: NodeId) -> Superseded | None:
        """The successor of a node, without the one excluded: the most similar active node."""
        for candidate, between in self._neighbours(covered):
            if candidate != excluded and self._traversability.has(candidate):
                successor = self._covers(covered, candidate, between)
                if successor is not None:
                    return successor
        return None

    def _crowded_out(self, node: NodeId) -> Superseded | None:
        """The most similar of the later views of a place, if there are many."""
        now = self._nodes[node].stamp_ns
        later = [
            (neighbour, between)
            for neighbour, between in self._neighbours(node)
            if self._traversability.has(neighbour) and self._nodes[neighbour].stamp_ns - now >= LATER * SECOND
        ]
        if len(later) < CROWD:
            return None
        here = self._traversability.within(node, WAY * FARTHEST)
        later = [(neighbour, between) for neighbour, between in later if neighbour in here]
        # What was refused with its successor is reinstated by the next merge: without the ways that are gone.
        fit = [(other, between) for other, between in later if _ordered(node, other) not in self._refused]
        if len(later) < CROWD or not fit:
            return None
        successor, between = fit[0]
        return Superseded(successor, 0, between.distance(Pose2()), abs(between.heading))

    def _neighbours(self, node: NodeId) -> list[tuple[NodeId, Pose2]]:
        """Nodes within the basin that may supersede a node, or that it may, active or not, with relative
        poses; the most similar first.
        """
        if node not in self._basins:
            around = self._traversability.around(node, FARTHEST, with_removed=True)
            around = [other for other in around if not _apart(node, other, self._unsure)]
            between = self._traversability.stances(node, around)
            distances, turns = np.hypot(between[:, 0], between[:, 1]), np.abs(between[:, 2])
            order = np.argsort(distances / FARTHEST + turns / WIDEST, kind="stable")
            inside = (distances <= FARTHEST) & (turns <= WIDEST)
            self._basins[node] = [
                (around[k], Pose2.from_vector(between[k])) for k in order[inside[order]].tolist()
            ]
        return self._basins[node]

    def _covers(self, covered: NodeId, successor: NodeId, between: Pose2) -> Superseded | None:
        """Whether a node within the basin can supersede another."""
        a, b = self._nodes[covered], self._nodes[successor]
        if not is_candidate(a, b):
            return None
        link = self._links.between(covered, successor)
        # A link may be of poses alone: by a person, or left of nodes that are gone.
        link = link if link is not None and len(link.shared) else self._compare(a, b)
        if link is None:
            return None
        link = link if link.a == covered else link.turned()
        return superseded_by(a, b, link.shared, between)

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
        # The map's own covariance only lets more pass, and is slow to compute for a large map.
        if _distance2(off, spread) >= GATE:
            relative = self._merged.relative(*verdict.pair)
            assert relative is not None, "nodes of one component"
            return verdict if _distance2(off, spread + relative.covariance) < GATE else None
        return verdict

    def _between(self, a: NodeId, b: NodeId) -> Pose2:
        return self._merged.pose(a).inverse() @ self._merged.pose(b)


def _apart(a: NodeId, b: NodeId, unsure: Set[MapId]) -> bool:
    """Whether two nodes are of different robots, and the map of one of them may not be right."""
    return a.agent != b.agent and (a.map in unsure or b.map in unsure)


def _distance2(off: Array, spread: Array) -> float:
    return float(off @ np.linalg.solve(spread, off))


def _ordered(a: NodeId, b: NodeId) -> tuple[NodeId, NodeId]:
    return (a, b) if a <= b else (b, a)

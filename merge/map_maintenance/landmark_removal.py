"""Fading: landmarks that later views should have shown again and again, and did not, are thought to be gone.

A landmark is there or it is not. From one visit of its place to the next it may have gone, or come back. A
view that should show it finds it with a probability q if it is there, and by mistake with a small one if it
is not. So what is believed of it is a hidden Markov chain of two states, filtered forward from visit to visit
(compare the persistence filter of Rosen, Mason and Leonard, ICRA 2016). How often a landmark that is there is
found again is measured in each view by all that it should show: descriptors fail, and nodes keep only some of
what they saw.

That a view misses one landmark says little, for it misses most. But landmarks go together: who moves a
cupboard moves all of its landmarks. So a landmark that a view does not find is judged with those around it,
as one thing that is there or is gone. Somebody may stand before it unknown to all, for as long as a visit
takes; so no single visit is enough.

The views are all that stand near in the merged map, linked with the node or not: the better a place is known
to have changed, the fewer are linked with it. A view that is not linked tells only if the merged map is sure
where it stands.
"""

from __future__ import annotations

import math
from collections.abc import Container, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from mapweave.hybridmap.node import Node, NodeId
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.merge.map_maintenance.adjacency import Adjacency
from mapweave.merge.map_maintenance.changed_nodes import ChangedNodes
from mapweave.merge.map_maintenance.landmark_observations import LandmarkObservations
from mapweave.merge.map_maintenance.node_age import is_older
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.pose_graph.solved_graph import PoseGraph

MOVED = 0.05
"""Two nodes may move to each other by this before their views are compared anew, m."""


LEAST_SHOWN = 15
"""A view that should show fewer landmarks tells nothing."""
SURE = (0.05, 0.05, 0.03)
"""A view tells nothing that the merged map does not place within one sigma of this, m, m and rad."""
THING = 0.3
"""Landmarks that are nearer than this to each other go together, m."""
FAINT = 0.2
"""A landmark that is there with less than this has faded."""
NEAR = 2.5
"""Views of a place that are not linked with it stand within this, m."""
TURNED = math.radians(45.0)
"""Views of a place that are not linked with it are turned by at most this, rad."""
MOST = 12
"""Views of a place that are looked at without a link, the newest."""
AGAIN = 120.0
"""Views of one map that lie nearer in time are of one visit, s."""


SECOND = 1_000_000_000


class LandmarkRemover:
    """Goes from merged map to merged map with what later views tell: each is compared once."""

    def __init__(self) -> None:
        """Begin with nothing seen again.

        Args:
            settings: when a landmark has faded.
        """
        self._looks: dict[NodeId, list[LandmarkObservations]] = {}
        self._faded: dict[NodeId, NDArray[np.bool_]] = {}
        self._graphs: tuple[PoseGraph, ...] = ()
        self._links = Adjacency()
        # Two nodes have drifted by a part of what matters each, since one of them was looked at and before.
        self._drift = ChangedNodes(MOVED / 8.0, MOVED / (4.0 * NEAR))

    def fade(self, merged: MergedMap) -> MergedMap:
        """The same map with the landmarks that have faded, of nodes that no others stand for.

        Args:
            merged: the next merged map of the same fleet.
        """
        solved = {id(graph) for graph in self._graphs}
        self._graphs = merged.graphs
        self._links.follow(merged.links)
        for node_id in self._drift.gone(merged.components):
            self._looks.pop(node_id, None)
            self._faded.pop(node_id, None)
        for graph in merged.graphs:
            if id(graph) not in solved:
                self._fade(merged, graph)
        living = {one: gone for one, gone in sorted(self._faded.items()) if one not in merged.superseded}
        return replace(merged, faded=living)

    def _fade(self, merged: MergedMap, graph: PoseGraph) -> None:
        nodes = [merged.maps[node.map].nodes[node] for node in graph.nodes]
        tree = cKDTree(graph.means[:, :2])
        for row in self._affected(graph, nodes, tree, merged.superseded):
            node = nodes[row]
            linked = {link.b if link.a == node.id else link.a: link for link in self._links.at(node.id)}
            near = [nodes[k] for k in self._around(graph, row, tree)]
            views = self._views(node, near, [nodes[graph.rows[one]] for one in linked])
            before = self._looks.get(node.id)
            self._looks[node.id] = looks = self._seen(merged, graph, node, views, linked)
            if before is not None and list(map(id, before)) == list(map(id, looks)):
                continue
            gone = presence(things(node, THING), [one for one in looks if tells(one)]) < FAINT
            self._faded.pop(node.id, None)
            if gone.any():
                self._faded[node.id] = gone

    def _affected(
        self, graph: PoseGraph, nodes: Sequence[Node], tree: cKDTree, but: Container[NodeId]
    ) -> list[int]:
        """Rows of nodes of which the later views may tell something else than they did before."""
        told = self._drift.told(nodes, graph.means)
        touched = [graph.rows[node] for node in self._links.touched if node in graph.rows]
        seen = np.array([node.id in self._looks for node in nodes], np.bool_)
        affected = told | ~seen
        affected[touched] = True
        if not told.all():
            for row in np.flatnonzero(told).tolist():
                affected[self._around(graph, row, tree)] = True
                views = (one for link in self._links.at(nodes[row].id) for one in link.pair)
                affected[[graph.rows[one] for one in views]] = True
        rows = np.flatnonzero(affected).tolist()
        for node in (nodes[row].id for row in rows if nodes[row].id in but):
            # If it comes back to life it is looked at anew.
            self._looks.pop(node, None)
        return [row for row in rows if nodes[row].id not in but]

    def _around(self, graph: PoseGraph, row: int, tree: cKDTree) -> list[int]:
        """Rows of nodes that stand near a node and look about the same way, itself among them."""
        near = np.sort(tree.query_ball_point(graph.means[row, :2], NEAR))
        turns = np.cos(graph.means[near, 2] - graph.means[row, 2])
        out: list[int] = near[turns > math.cos(TURNED)].tolist()
        return out

    def _views(self, node: Node, near: Sequence[Node], linked: Sequence[Node]) -> list[Node]:
        """Later views of a node's place, the earliest first."""
        known = {one.id for one in linked}
        others = [one for one in near if one.id not in known and is_older(node, one)]
        others = [
            one
            for one in others
            if one.id.map != node.id.map or one.stamp_ns - node.stamp_ns > AGAIN * SECOND
        ]
        newest = sorted(others, key=lambda one: (one.stamp_ns, one.id))[-MOST:]
        views = [*(one for one in linked if is_older(node, one)), *newest]
        return sorted(views, key=lambda one: (one.stamp_ns, one.id))

    def _seen(
        self, merged: MergedMap, graph: PoseGraph, node: Node, views: list[Node], linked: dict[NodeId, Link]
    ) -> list[LandmarkObservations]:
        """What the views tell; what they told before holds while they stand to the node as they did."""
        before = {id(look.view): look for look in self._looks.get(node.id, ())}
        looks: list[LandmarkObservations] = []
        doubted: list[int] = []
        for view in views:
            between = merged.pose(node.id).inverse() @ merged.pose(view.id)
            link, look = linked.get(view.id), before.get(id(view))
            if look is None or look.node is not node or look.link is not link or self._off(look, between):
                look = LandmarkObservations.of(node, view, link, between)
                if link is None and look.expected.sum() >= LEAST_SHOWN:
                    doubted.append(len(looks))
            looks.append(look)
        if doubted:
            there = graph.relative([node.id] * len(doubted), [looks[k].view.id for k in doubted])
            sigmas = np.sqrt(np.diagonal(there.covariances, axis1=1, axis2=2))
            for k, those in zip(doubted, sigmas, strict=True):
                looks[k] = replace(looks[k], sure=bool((those <= SURE).all()))
        return looks

    def _off(self, look: LandmarkObservations, between: Pose2) -> bool:
        off = look.between.inverse() @ between
        return max(off.distance(Pose2()), abs(off.heading)) >= MOVED


def tells(look: LandmarkObservations) -> bool:
    """Whether a view tells anything: it should show enough, and stands where it is thought to."""
    return int(look.expected.sum()) >= LEAST_SHOWN and look.sure


def things(node: Node, size: float) -> NDArray[np.bool_]:
    """(N, N) which landmarks of a node may be of one thing; each is so with itself.

    Args:
        node: has N landmarks.
        size: m, what is nearer to each other may be.
    """
    points = node.points_in_robot
    near: NDArray[np.bool_] = (cdist(points, points) < size) | np.eye(len(points), dtype=np.bool_)
    return near


HIDDEN = 0.05
"""Probability that a thing is hidden during a visit by what nobody knows of."""
MISTAKEN = 0.01
"""Probability that a landmark that is gone is found all the same."""
GOES = 0.02
"""Probability that a landmark has gone from one visit to the next."""
COMES = 0.02
"""Probability that a landmark that had gone is back at the next visit."""
AT_FIRST = 0.95
"""Probability that it was really there when it was mapped."""


def presence(together: NDArray[np.bool_], looks: Sequence[LandmarkObservations]) -> Array:
    """(N,) probability that each landmark of a node is still there after some views.

    Args:
        together: (N, N) which of them may be of one thing, see `things`.
        looks: later views of it that tell something, the earliest first.
    """
    there = np.full(len(together), AT_FIRST)
    for visit in visits(looks, AGAIN):
        # Of the visit's views together: if it is there and in sight, there and hidden, and gone.
        in_sight, hidden, gone = np.ones((3, len(together)))
        told = np.zeros(len(together), np.bool_)
        for look in visit:
            again = look.found & look.expected
            rate = found_again(together, look)
            # One that is found is there, whatever is around it; one that is not is judged with its thing.
            seen = np.where(look.found, 1, together @ again.astype(np.int64))
            missed = np.where(look.found, 0, together @ (look.expected & ~look.found).astype(np.int64))
            tells_of = look.expected | look.found
            in_sight *= np.where(tells_of, rate**seen * (1.0 - rate) ** missed, 1.0)
            hidden *= np.where(tells_of, seen == 0, 1.0)
            gone *= np.where(tells_of, MISTAKEN**seen * (1.0 - MISTAKEN) ** missed, 1.0)
            told |= tells_of
        if_there = (1.0 - HIDDEN) * in_sight + HIDDEN * hidden
        prior = there * (1.0 - GOES) + (1.0 - there) * COMES
        posterior = prior * if_there / (prior * if_there + (1.0 - prior) * gone)
        there = np.where(told, posterior, there)
    return there


def visits(looks: Sequence[LandmarkObservations], again: float) -> list[list[LandmarkObservations]]:
    """Looks visit by visit.

    Args:
        looks: the earliest first.
        again: s, views of one map that lie nearer to the one before are of one visit.
    """
    found: list[list[LandmarkObservations]] = []
    for look in looks:
        view, last = look.view, found[-1][-1].view if found else None
        if last is None or last.id.map != view.id.map or view.stamp_ns - last.stamp_ns >= again * SECOND:
            found.append([])
        found[-1].append(look)
    return found


USUAL = 0.1
"""Prior share of the landmarks it should show that a view finds."""
RATES = (0.1, 0.9)
"""Bounds of that share."""
WEIGHT = 15.0
"""Landmarks that the prior share weighs as much as."""


def found_again(together: NDArray[np.bool_], look: LandmarkObservations) -> float:
    """How often a view finds a landmark that it should show and that is there.

    That is measured where it finds something else of the same thing, as far as there is enough of it: so what
    has gone does not count.

    Args:
        together: (N, N) which landmarks may be of one thing.
        look: what the view shows.
    """
    again = look.found & look.expected
    others: NDArray[np.int64] = together @ again.astype(np.int64) - again
    firm = look.expected & (others > 0)
    rate = ((again & firm).sum() + USUAL * WEIGHT) / (firm.sum() + WEIGHT)
    return float(np.clip(rate, *RATES))

"""Faded landmarks: later views should have shown them repeatedly and did not, so they are probably gone.

A landmark is present or absent. From one visit of its place to the next it may disappear or come back. A view
that should show it finds it with a probability q if it is present, and by mistake with a small one if it is
absent. So its presence is a hidden Markov chain of two states, filtered forward from visit to visit (compare
the persistence filter of Rosen, Mason and Leonard, ICRA 2016). The rate q is measured in each view on all the
landmarks that it should show: descriptors fail, and nodes keep only some of their features.

One missed landmark is weak evidence, since a view misses most of them. But landmarks belong to things: a
cupboard that is moved takes all of its landmarks along. So a missed landmark is judged together with those
around it, as one thing that is present or absent. An unmapped person may occlude it during a whole visit; so
a single visit is never enough.

The views are all that are near in the merged map, linked with the node or not: the more a place has changed,
the fewer views are linked with it. A view that is not linked counts only if its pose in the merged map is
certain. Views of an implausible map count for its own robot's nodes alone.
"""

from __future__ import annotations

import math
from collections.abc import Container, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.merge.map_maintenance.adjacency import Adjacency
from mapweave.merge.map_maintenance.changed_nodes import ChangedNodes
from mapweave.merge.map_maintenance.landmark_observations import LandmarkObservations
from mapweave.merge.map_maintenance.node_age import is_older
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.pose_graph.solved_graph import PoseGraph

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

MOVED = 0.05
"""Two nodes may move relative to each other by this before their views are compared again, m."""


LEAST_SHOWN = 15
"""A view that should show fewer landmarks is not used."""
SURE = (0.05, 0.05, 0.03)
"""A view tells nothing that the merged map does not place within one sigma of this, m, m and rad."""
THING = 0.3
"""Landmarks that are nearer than this to each other go together, m."""
FAINT = 0.2
"""A landmark that is there with less than this has faded."""
NEAR = 2.5
"""Views of a place that are not linked with it are within this, m."""
TURNED = math.radians(45.0)
"""Views of a place that are not linked with it are turned by at most this, rad."""
MOST = 12
"""Views of a place that are looked at without a link, the newest."""
AGAIN = 120.0
"""Views of one map that lie nearer in time are of one visit, s."""


SECOND = 1_000_000_000


class LandmarkRemover:
    """Keeps the landmark observations from merged map to merged map: each view is compared once."""

    def __init__(self) -> None:
        """Begin with nothing seen again."""
        self._observations: dict[NodeId, list[LandmarkObservations]] = {}
        self._faded: dict[NodeId, NDArray[np.bool_]] = {}
        self._graphs: tuple[PoseGraph, ...] = ()
        self._links = Adjacency()
        self._implausible: frozenset[MapId] = frozenset()
        # Each of two nodes may move by a part of `moved`, before and after their comparison.
        self._drift = ChangedNodes(MOVED / 8.0, MOVED / (4.0 * NEAR))

    def fade(self, merged: MergedMap) -> MergedMap:
        """The same map with the faded landmarks of its active nodes.

        Args:
            merged: the next merged map of the same fleet.
        """
        solved = {id(graph) for graph in self._graphs}
        self._graphs = merged.graphs
        # One of poses alone shows no landmarks: by a person, or left of nodes that are gone.
        self._links.follow(link for link in merged.links if len(link.shared))
        for node_id in self._drift.removed(merged.components):
            self._observations.pop(node_id, None)
            self._faded.pop(node_id, None)
        others = self._implausible ^ merged.implausible.keys()
        self._implausible = frozenset(merged.implausible)
        for graph in merged.graphs:
            if id(graph) not in solved or not graph.maps.isdisjoint(others):
                self._fade(merged, graph, others)
        active = {node: mask for node, mask in sorted(self._faded.items()) if node not in merged.superseded}
        return replace(merged, faded=active)

    def _fade(self, merged: MergedMap, graph: PoseGraph, others: Container[MapId]) -> None:
        from scipy.spatial import cKDTree

        nodes = [merged.maps[node.map].nodes[node] for node in graph.nodes]
        tree = cKDTree(graph.means[:, :2])
        for row in self._affected(graph, nodes, tree, merged.superseded, others):
            node = nodes[row]
            linked = {link.b if link.a == node.id else link.a: link for link in self._links.at(node.id)}
            nearby = [nodes[k] for k in self._around(graph, row, tree)]
            views = self._views(node, nearby, [nodes[graph.rows[observation]] for observation in linked])
            before = self._observations.get(node.id)
            self._observations[node.id] = observations = self._observe(merged, graph, node, views, linked)
            if before is not None and list(map(id, before)) == list(map(id, observations)):
                continue
            faded = (
                presence(
                    things(node, THING),
                    [observation for observation in observations if is_informative(observation)],
                )
                < FAINT
            )
            self._faded.pop(node.id, None)
            if faded.any():
                self._faded[node.id] = faded

    def _affected(
        self,
        graph: PoseGraph,
        nodes: Sequence[Node],
        tree: cKDTree,
        but: Container[NodeId],
        others: Container[MapId],
    ) -> list[int]:
        """Rows of nodes whose observations may have changed.

        Args:
            graph: that they are in.
            nodes: all of its nodes.
            tree: of their positions.
            but: superseded nodes.
            others: maps that have become implausible, or plausible again.
        """
        changed = self._drift.changed(nodes, graph.means)
        changed |= np.array([node.id.map in others for node in nodes], np.bool_)
        touched = [graph.rows[node] for node in self._links.touched if node in graph.rows]
        observed = np.array([node.id in self._observations for node in nodes], np.bool_)
        affected = changed | ~observed
        affected[touched] = True
        if not changed.all():
            for row in np.flatnonzero(changed).tolist():
                affected[self._around(graph, row, tree)] = True
                views = (node_id for link in self._links.at(nodes[row].id) for node_id in link.pair)
                affected[[graph.rows[node_id] for node_id in views]] = True
        rows = np.flatnonzero(affected).tolist()
        for node in (nodes[row].id for row in rows if nodes[row].id in but):
            # A node that becomes active again is observed again.
            self._observations.pop(node, None)
        return [row for row in rows if nodes[row].id not in but]

    def _around(self, graph: PoseGraph, row: int, tree: cKDTree) -> list[int]:
        """Rows of nodes near a node with a similar heading, itself among them."""
        nearby = np.sort(tree.query_ball_point(graph.means[row, :2], NEAR))
        turns = np.cos(graph.means[nearby, 2] - graph.means[row, 2])
        out: list[int] = nearby[turns > math.cos(TURNED)].tolist()
        return out

    def _views(self, node: Node, nearby: Sequence[Node], linked: Sequence[Node]) -> list[Node]:
        """Later views of a node's place, the earliest first."""
        nearby, linked = ([k for k in some if self._counts(node, k)] for some in (nearby, linked))
        linked_ids = {candidate.id for candidate in linked}
        unlinked = [
            candidate for candidate in nearby if candidate.id not in linked_ids and is_older(node, candidate)
        ]
        unlinked = [
            candidate
            for candidate in unlinked
            if candidate.id.map != node.id.map or candidate.stamp_ns - node.stamp_ns > AGAIN * SECOND
        ]
        newest = sorted(unlinked, key=lambda candidate: (candidate.stamp_ns, candidate.id))[-MOST:]
        views = [*(candidate for candidate in linked if is_older(node, candidate)), *newest]
        return sorted(views, key=lambda candidate: (candidate.stamp_ns, candidate.id))

    def _counts(self, node: Node, view: Node) -> bool:
        """Whether a view tells anything of a node: no robot takes others' landmarks by an impossible map."""
        return view.id.agent == node.id.agent or view.id.map not in self._implausible

    def _observe(
        self, merged: MergedMap, graph: PoseGraph, node: Node, views: list[Node], linked: dict[NodeId, Link]
    ) -> list[LandmarkObservations]:
        """Observations by the views; earlier ones are kept while the relative poses have not changed."""
        before = {id(observation.view): observation for observation in self._observations.get(node.id, ())}
        observations: list[LandmarkObservations] = []
        unlinked: list[int] = []
        for view in views:
            between = merged.pose(node.id).inverse() @ merged.pose(view.id)
            link, observation = linked.get(view.id), before.get(id(view))
            if (
                observation is None
                or observation.node is not node
                or observation.link is not link
                or self._off(observation, between)
            ):
                observation = LandmarkObservations.of(node, view, link, between)
                if link is None and observation.expected.sum() >= LEAST_SHOWN:
                    unlinked.append(len(observations))
            observations.append(observation)
        if unlinked:
            relative = graph.relative([node.id] * len(unlinked), [observations[k].view.id for k in unlinked])
            sigmas = np.sqrt(np.diagonal(relative.covariances, axis1=1, axis2=2))
            for k, sigma in zip(unlinked, sigmas, strict=True):
                observations[k] = replace(observations[k], sure=bool((sigma <= SURE).all()))
        return observations

    def _off(self, observation: LandmarkObservations, between: Pose2) -> bool:
        off = observation.between.inverse() @ between
        return max(off.distance(Pose2()), abs(off.heading)) >= MOVED


def is_informative(observation: LandmarkObservations) -> bool:
    """Whether a view is informative: it should show enough landmarks, and its pose is certain."""
    return int(observation.expected.sum()) >= LEAST_SHOWN and observation.sure


def things(node: Node, size: float) -> NDArray[np.bool_]:
    """(N, N) which landmarks of a node may be of one thing; each is so with itself.

    Args:
        node: has N landmarks.
        size: m, what is nearer to each other may be.
    """
    from scipy.spatial.distance import cdist

    points = node.points_in_robot
    together: NDArray[np.bool_] = (cdist(points, points) < size) | np.eye(len(points), dtype=np.bool_)
    return together


HIDDEN = 0.05
"""Probability that a thing is occluded during a visit by something unmapped."""
MISTAKEN = 0.01
"""Probability that a landmark that is gone is found all the same."""
GOES = 0.02
"""Probability that a landmark has gone from one visit to the next."""
COMES = 0.02
"""Probability that a landmark that had gone is back at the next visit."""
AT_FIRST = 0.95
"""Probability that it was really there when it was mapped."""


def presence(together: NDArray[np.bool_], observations: Sequence[LandmarkObservations]) -> Array:
    """(N,) probability that each landmark of a node is still there after some views.

    Args:
        together: (N, N) which of them may be of one thing, see `things`.
        observations: informative later views of it, the earliest first.
    """
    present = np.full(len(together), AT_FIRST)
    for visit in visits(observations, AGAIN):
        # Likelihoods of the visit's views: present and visible, present and occluded, absent.
        visible, hidden, absent = np.ones((3, len(together)))
        informed = np.zeros(len(together), np.bool_)
        for observation in visit:
            again = observation.found & observation.expected
            rate = detection_rate(together, observation)
            # A found landmark is present, regardless of its neighbours; a missed one is judged with its
            # thing.
            found = np.where(observation.found, 1, together @ again.astype(np.int64))
            missed = np.where(
                observation.found, 0, together @ (observation.expected & ~observation.found).astype(np.int64)
            )
            informative = observation.expected | observation.found
            visible *= np.where(informative, rate**found * (1.0 - rate) ** missed, 1.0)
            hidden *= np.where(informative, found == 0, 1.0)
            absent *= np.where(informative, MISTAKEN**found * (1.0 - MISTAKEN) ** missed, 1.0)
            informed |= informative
            # Only their ratios count. Scaled by powers of two they lose no digit, and never all vanish.
            exponents = np.frexp(np.maximum(np.maximum(visible, hidden), absent))[1]
            visible, hidden, absent = (np.ldexp(some, -exponents) for some in (visible, hidden, absent))
        if_present = (1.0 - HIDDEN) * visible + HIDDEN * hidden
        prior = present * (1.0 - GOES) + (1.0 - present) * COMES
        posterior = prior * if_present / (prior * if_present + (1.0 - prior) * absent)
        present = np.where(informed, posterior, present)
    return present


def visits(observations: Sequence[LandmarkObservations], again: float) -> list[list[LandmarkObservations]]:
    """Observations grouped by visit.

    Args:
        observations: the earliest first.
        again: s, views of one map with smaller gaps in time are of one visit.
    """
    grouped: list[list[LandmarkObservations]] = []
    for observation in observations:
        view, last = observation.view, grouped[-1][-1].view if grouped else None
        if last is None or last.id.map != view.id.map or view.stamp_ns - last.stamp_ns >= again * SECOND:
            grouped.append([])
        grouped[-1].append(observation)
    return grouped


USUAL = 0.1
"""Prior share of the landmarks it should show that a view finds."""
RATES = (0.1, 0.9)
"""Bounds of that share."""
WEIGHT = 15.0
"""Landmarks that the prior share weighs as much as."""


def detection_rate(together: NDArray[np.bool_], observation: LandmarkObservations) -> float:
    """How often a view finds a landmark that it should show and that is there.

    Measured on landmarks of which another one of the same thing is found, if there are enough: so absent
    things do not count.

    Args:
        together: (N, N) which landmarks may be of one thing.
        observation: of the view.
    """
    again = observation.found & observation.expected
    others_found: NDArray[np.int64] = together @ again.astype(np.int64) - again
    firm = observation.expected & (others_found > 0)
    rate = ((again & firm).sum() + USUAL * WEIGHT) / (firm.sum() + WEIGHT)
    return float(np.clip(rate, *RATES))

"""A connected component of measurements, solved, with covariances from what was measured nearby."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.merge.pose_graph.factors import Factors, RelativePose, Rows, believable
from mapweave.merge.pose_graph.optimization import ANCHOR_SIGMA, optimized
from mapweave.merge.pose_graph.solved_graph import PoseGraph, factorized, relative_covariances
from mapweave.registration.pose_arrays import PoseGaussians, compose_poses, inverse_poses

if TYPE_CHECKING:
    from scipy import sparse

EXACT = 1000
"""Up to as many nodes a covariance is that of all measurements ..."""
MOST_EXACT = 4000
"""... and up to as many where nearly all nodes are asked for ..."""
NEARBY = 300
"""... beyond, of as many nodes around the pair; of more, if none of these joins it ..."""
AROUND = 4
"""... and of so many at least for each node of the pairs."""
ROWS_AT_ONCE = 96
"""Nodes for which it is worked out together ..."""
MOST_AT_ONCE = 400
"""... or so many, if most pairs of them are asked for."""


class Component(PoseGraph):
    """A solved pose graph with the measurements that made it; its nodes are in the order of their ids.

    In a large one, the relative pose of two nodes is determined by the measurements around them. Measurements
    further away would make it a little more certain and are left out, so covariances are a little too large,
    never too small.

    Attributes:
        factors: the measurements between its rows.
        unsettled: how many of them have come or gone since all of it was optimised at once.
    """

    factors: Factors
    unsettled: int

    def __init__(
        self,
        anchor: NodeId,
        nodes: tuple[NodeId, ...],
        means: Array,
        factors: Factors,
        unsettled: int = 0,
    ) -> None:
        """Take a solution.

        Args:
            anchor: the node that is held.
            nodes: of one connected component.
            means: (N, 3) m, m, rad.
            factors: between rows of the nodes.
            unsettled: measurements that have come or gone since all of it was optimised at once.
        """
        values = {"anchor": anchor, "nodes": nodes, "means": means, "factors": factors}
        for name, value in {**values, "unsettled": unsettled}.items():
            object.__setattr__(self, name, value)

    @cached_property
    def information(self) -> sparse.csc_matrix:
        """(3N, 3N) sparse, of the right perturbations of all nodes, anchor held."""
        return self.factors.information(self.means, self.index([self.anchor]), ANCHOR_SIGMA**-2)

    def relative_rows(self, i: Rows, j: Rows) -> PoseGaussians:
        """Poses `i_from_j` of (K,) rows, by what was measured around them.

        Raises:
            ValueError: nothing joins a pair: this is no component.
        """
        count = len(self.nodes)
        if count <= EXACT or (count <= MOST_EXACT and AROUND * len(np.unique([i, j])) >= count):
            return super().relative_rows(i, j)
        means = compose_poses(inverse_poses(self.means[i]), self.means[j])
        covariances = np.zeros((len(i), 3, 3))
        left, least = np.flatnonzero(i != j), NEARBY
        while len(left):
            apart = []
            # Rows of one map are together, and what is near each other shares its surroundings.
            for some in _shares(left[np.lexsort([j[left], i[left]])], i, j):
                covariances[some], joined = self._covariances(i[some], j[some], means[some], least)
                apart.append(some[~joined])
            left = np.concatenate(apart)
            if len(left) and least >= len(self.nodes):
                k = int(left[0])
                raise ValueError(f"nothing joins {self.nodes[i[k]]} and {self.nodes[j[k]]}")
            least *= 4
        return PoseGaussians(means, covariances)

    def _covariances(self, i: Rows, j: Rows, means: Array, least: int) -> tuple[Array, NDArray[np.bool_]]:
        """Covariances of pairs of rows, by what was measured around all of them.

        Args:
            i: (K,) rows.
            j: (K,) rows.
            means: (K, 3) of j in i.
            least: nodes at least that are around them.

        Returns:
            (K, 3, 3); and (K,) whether what is around joins a pair: else its covariance means nothing.
        """
        seats, which = np.unique(np.concatenate([i, j]), return_inverse=True)
        rows = self.factors.around(seats, max(least, AROUND * len(seats)), len(self.nodes))
        order = np.full(len(self.nodes), len(rows))
        order[rows] = np.arange(len(rows))
        part = self._within(rows, order)
        piece = pieces(part, len(rows))
        # Only differences count: one node of each piece is held.
        held = np.unique(piece, return_index=True)[1]
        information = part.information(self.means[rows], held, ANCHOR_SIGMA**-2)
        columns = (3 * order[seats][:, None] + np.arange(3)).ravel()
        right = np.zeros((3 * len(rows), len(columns)))
        right[columns, np.arange(len(columns))] = 1.0
        joint = factorized(information).solve(right)[columns]
        joint = (0.5 * (joint + joint.T)).reshape(len(seats), 3, len(seats), 3)
        joined = piece[order[i]] == piece[order[j]]
        first, second = np.split(which, 2)
        return relative_covariances(joint, first, second, means), joined

    def _within(self, rows: Rows, order: Rows) -> Factors:
        """Measurements with both ends among the rows."""
        index = self.factors.at(rows)
        both = (order[self.factors.a[index]] < len(rows)) & (order[self.factors.b[index]] < len(rows))
        return self.factors.take(index[both], order)


def _shares(pairs: Rows, i: Rows, j: Rows) -> list[Rows]:
    """Pairs of rows i and j, in their order, so many at a time that few rows are involved."""
    count = len(np.unique(np.concatenate([i[pairs], j[pairs]])))
    if count <= MOST_AT_ONCE and len(pairs) > AROUND * count:
        return [pairs]
    out: list[list[int]] = []
    involved: set[int] = set()
    for k in pairs.tolist():
        ends = {int(i[k]), int(j[k])}
        if not out or len(involved | ends) > ROWS_AT_ONCE:
            out.append([])
            involved = set()
        involved |= ends
        out[-1].append(k)
    return [np.array(some, np.int64) for some in out]


def pieces(part: Factors, count: int) -> Rows:
    """(count,) which connected piece each of so many rows is in, by measurements between them."""
    from scipy import sparse
    from scipy.sparse.csgraph import connected_components

    links = sparse.coo_matrix((np.ones(len(part)), (part.a, part.b)), shape=(count, count))
    out: Rows = connected_components(links, directed=False)[1].astype(np.int64)
    return out


def solve_graph(anchor: NodeId, anchor_pose: Pose2, measurements: Iterable[RelativePose]) -> Component:
    """Optimise one connected component, from along a tree of the most certain measurements.

    Args:
        anchor: the node that is held.
        anchor_pose: where.
        measurements: those that do not connect to the anchor are left out.

    Returns:
        The solved graph. It depends on the set of measurements, not on their order.
    """
    ordered = sorted(measurements, key=lambda m: (m.a, m.b, m.a_from_b.mean.vector.tolist()))
    start = along_tree(anchor, anchor_pose, ordered)
    ordered = [m for m in ordered if m.a in start]
    nodes = tuple(sorted(start))
    row = {node: k for k, node in enumerate(nodes)}
    means = np.array([start[node].vector for node in nodes])
    factors = Factors.of(ordered, [row[m.a] for m in ordered], [row[m.b] for m in ordered])
    if len(ordered) >= len(nodes):
        # A tree is at its optimum already.
        means = optimized(factors, means, np.arange(len(nodes)), np.array([row[anchor]]))
    return Component(anchor, nodes, means, factors)


def along_tree(
    anchor: NodeId, anchor_pose: Pose2, measurements: Sequence[RelativePose]
) -> dict[NodeId, Pose2]:
    """Poses along a minimum spanning tree of uncertainty."""
    graph: nx.Graph = nx.Graph()
    graph.add_node(anchor)
    covariances = believable(np.array([m.a_from_b.covariance for m in measurements]).reshape(-1, 3, 3))
    for m, trace in zip(measurements, np.trace(covariances, axis1=1, axis2=2).tolist(), strict=True):
        weight = trace + (100.0 if m.robust else 0.0)
        edge = graph.get_edge_data(m.a, m.b)
        if m.a != m.b and (edge is None or weight < edge["weight"]):
            graph.add_edge(m.a, m.b, weight=weight, measurement=m)
    joined = graph.subgraph(nx.node_connected_component(graph, anchor))
    # A map's way without its loops is a tree already.
    tree = joined if joined.size() < len(joined) else nx.minimum_spanning_tree(joined)
    poses = {anchor: anchor_pose}
    for parent, node in nx.bfs_edges(tree, anchor):
        m = tree.edges[parent, node]["measurement"]
        relative = m.a_from_b.mean if m.a == parent else m.a_from_b.mean.inverse()
        poses[node] = poses[parent] @ relative
    return poses

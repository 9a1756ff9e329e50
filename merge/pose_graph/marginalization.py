"""Marginalisation: nodes leave the pose graph, and what they measured stays, between the nodes that remain.

What was measured at removed nodes is solved by itself, with the marginal links of earlier removals. The
marginal distribution of the nodes that remain is dense, and is approximated by the tree that is nearest to it
by Kullback-Leibler divergence: the Chow-Liu tree [1, 2]. Of poses relative to each other it is the minimum
spanning tree of the entropies of relative poses, log det of their covariances; and a link of the tree has the
pose and the covariance that the marginal distribution gives its two nodes. So there are fewer marginal links
than nodes that remain, however many are removed. Links and edges between remaining nodes stay as they are.

[1] C. K. Chow, C. N. Liu, Approximating discrete probability distributions with dependence trees, IEEE
    Transactions on Information Theory 14, 1968.
[2] N. Carlevaris-Bianco, M. Kaess, R. Eustice, Generic node removal for factor-graph SLAM, IEEE Transactions
    on Robotics 30, 2014.
"""

from __future__ import annotations

from collections.abc import Iterable, Set

import networkx as nx
import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from mapweave.hybridmap.explanation import MARGINAL
from mapweave.hybridmap.node import NodeId
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian, nearest_covariance
from mapweave.merge.pose_graph.component import Component
from mapweave.merge.pose_graph.factors import Factors, Rows, believable
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.optimization import optimized

NEIGHBOURS = 24
"""Pairs of each node that may be in the tree, the nearest; more if these do not connect what is connected."""
TURN = 1.0
"""m/rad, how far a turn is: two rad apart, two nodes of one place see nothing in common."""


def is_marginal(link: Link) -> bool:
    """Whether a link is left of removed nodes."""
    return MARGINAL in link.evidence


def marginal_links(graph: Component, removed: Set[NodeId], earlier: Iterable[Link]) -> list[Link]:
    """What is left of the measurements at some nodes, in the place of earlier marginal links of the graph.

    Args:
        graph: a solved component.
        removed: some of its nodes, not all.
        earlier: marginal links that are part of it, as this made them.

    Returns:
        At most one between two nodes, smaller id first, in the order of ids.
    """
    factors = _about(graph, removed, earlier)
    if not len(factors):
        return []
    rows = np.unique(np.concatenate([factors.a, factors.b]))
    order = np.zeros(len(graph.nodes), np.int64)
    order[rows] = np.arange(len(rows))
    part = factors.take(np.arange(len(factors)), order)
    ties = sparse.coo_matrix((np.ones(len(part), np.int8), (part.a, part.b)), (len(rows), len(rows)))
    labels = connected_components(ties, directed=False)[1]
    first = np.unique(labels, return_index=True)[1]
    means = optimized(part, graph.means[rows], np.arange(len(rows)), first)
    left = np.array([graph.nodes[row] not in removed for row in rows.tolist()], np.bool_)
    out: list[Link] = []
    for label in range(len(first)):
        inside = np.flatnonzero(labels == label)
        if np.count_nonzero(left[inside]) > 1:
            seat = np.full(len(rows), -1)
            seat[inside] = np.arange(len(inside))
            own = part.take(labels[part.a] == label, seat)
            nodes = tuple(graph.nodes[row] for row in rows[inside].tolist())
            out += _tree(Component(nodes[0], nodes, means[inside], own), np.flatnonzero(left[inside]))
    return sorted(out, key=lambda link: link.pair)


def fused(marginal: Link, link: Link) -> Link | None:
    """A marginal link together with what was verified of the same two nodes; None if they disagree.

    The two are independent: what was verified between nodes that remain is in no marginal link.
    """
    m, v = marginal.a_from_b, link.canonical().a_from_b
    off = (m.mean.inverse() @ v.mean).vector
    spreads = believable(m.covariance), believable(v.covariance)
    if off @ np.linalg.solve(spreads[0] + spreads[1], off) >= GATE:
        return None
    weights = [np.linalg.inv(spread) for spread in spreads]
    covariance = np.linalg.inv(weights[0] + weights[1])
    mean = m.mean @ Pose2.from_vector(covariance @ weights[1] @ off)
    pose = PoseGaussian(mean, nearest_covariance(0.5 * (covariance + covariance.T)))
    verified = link.canonical()
    return Link(marginal.a, marginal.b, pose, verified.shared, {**verified.evidence, MARGINAL: 1.0})


GATE = 16.27
"""Chi-square with 3 degrees of freedom, 99.9 %, within which a verified link agrees with a marginal one."""


def _about(graph: Component, removed: Set[NodeId], earlier: Iterable[Link]) -> Factors:
    """Measurements at removed nodes, and earlier marginal links between the others, by rows of the graph."""
    part = graph.factors.take(graph.factors.at(np.sort(graph.index([*removed]))))
    rows = graph.rows
    others = [link for link in earlier if link.a in rows and link.b in rows and not removed & {*link.pair}]
    ends = ([rows[link.pair[end]] for link in others] for end in (0, 1))
    return Factors.together([part, Factors.of([link.measurement for link in others], *ends)])


def _tree(graph: Component, left: Rows) -> list[Link]:
    """The Chow-Liu tree of some nodes of a graph, as links."""
    pairs = _near(graph.means[left])
    starts, ends = ([graph.nodes[left[k]] for k in column.tolist()] for column in pairs.T)
    poses = graph.relative(starts, ends)
    entropies = np.linalg.slogdet(poses.covariances)[1]
    tree: nx.Graph = nx.Graph()
    for k, (a, b) in enumerate(zip(starts, ends, strict=True)):
        tree.add_edge(a, b, weight=float(entropies[k]), row=k)
    kept = sorted(tree.edges[edge]["row"] for edge in nx.minimum_spanning_edges(tree, data=False))
    return [_link(starts[k], ends[k], poses.means[k], poses.covariances[k]) for k in kept]


def _link(a: NodeId, b: NodeId, mean: Array, covariance: Array) -> Link:
    pose = PoseGaussian(Pose2.from_vector(mean), nearest_covariance(covariance))
    return Link(a, b, pose, evidence={MARGINAL: 1.0})


def _near(means: Array) -> Rows:
    """(K, 2) rows of near poses, smaller first; so many that they are connected."""
    headings = means[:, 2:]
    places = np.hstack([means[:, :2], TURN * np.cos(headings), TURN * np.sin(headings)])
    index, count = cKDTree(places), len(means)
    k = NEIGHBOURS
    while True:
        k = min(k, count - 1)
        near = np.asarray(index.query(places, k + 1)[1])
        pairs = np.column_stack([np.repeat(np.arange(count), k + 1), near.ravel()])
        pairs = np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0)
        ties = sparse.coo_matrix((np.ones(len(pairs), np.int8), tuple(pairs.T)), (count, count))
        if k == count - 1 or connected_components(ties, directed=False)[0] == 1:
            return pairs
        k *= 2

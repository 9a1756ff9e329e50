"""Marginalisation: nodes leave the pose graph, and what they measured stays, between the nodes that remain.

What was measured at removed nodes is solved by itself, with the marginal links of earlier removals between
the same nodes. The marginal distribution of the nodes that remain is dense. It is approximated by links of
near nodes, as [1] and [2] do: the minimum spanning tree of the entropies of relative poses, log det of their
covariances (the Chow-Liu tree), and the surest few links of each node beside it. Their poses and covariances
are those of the marginal distribution; but since they are not independent, each covariance is divided by a
weight below 1. The weights minimise the Kullback-Leibler divergence from the marginal distribution,

    -log det(sum_e w_e J_e' S_e^-1 J_e) + 3 sum_e w_e,

which is the problem of D-optimal design and is solved by its multiplicative algorithm [3]:
w_e := w_e tr(S_e^-1 S_e(w)) / 3, with S_e(w) the covariance of the pair by all links together. So there are
never more than a few marginal links a node, however many were removed. Links and edges between remaining
nodes stay as they are.

[1] N. Carlevaris-Bianco, M. Kaess, R. Eustice, Generic node removal for factor-graph SLAM, IEEE Transactions
    on Robotics 30, 2014.
[2] M. Mazuran, W. Burgard, G. D. Tipaldi, Nonlinear factor recovery for long-term SLAM, International Journal
    of Robotics Research 35, 2016.
[3] S. D. Silvey, D. M. Titterington, B. Torsney, An algorithm for optimal designs on a finite design space,
    Communications in Statistics 7, 1978.
"""

from collections.abc import Collection, Iterable, Set

import networkx as nx
import numpy as np

from mapweave.hybridmap.explanation import MARGINAL
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian, nearest_covariance
from mapweave.merge.pose_graph.candidates import Pair
from mapweave.merge.pose_graph.component import Component
from mapweave.merge.pose_graph.factors import Factors, Rows, believable
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.optimization import optimized

NEIGHBOURS = 24
"""Pairs of each node that may become links, the nearest; more if these do not connect what is connected."""
LINKS = 8
"""Links of each node beside the tree. With none, 2, 5 and 10 the nodes of a hall that was driven through for
twelve days were 46, 29, 10 and 6 mm off the optimum of all measurements, which itself is 57 mm off the truth
(two seeds of tests/merge/test_pruned_days.py)."""
ROUNDS = 30
"""Of the multiplicative algorithm; the divergence falls with each."""
TURN = 1.0
"""m/rad, how far a turn is: two rad apart, two nodes of one place see nothing in common."""
GATE = 16.27
"""Chi-square with 3 degrees of freedom, 99.9 %, within which a verified link agrees with a marginal one."""


def is_marginal(link: Link) -> bool:
    """Whether a link is left of removed nodes."""
    return MARGINAL in link.evidence


def marginal_links(
    graph: Component, removed: Set[NodeId], earlier: Iterable[Link], taken: Set[Pair] = frozenset()
) -> list[Link]:
    """The marginal links of a graph without some of its nodes.

    Args:
        graph: a solved component.
        removed: some of its nodes, not all.
        earlier: its marginal links so far, as this made them.
        taken: pairs, smaller id first, between which there shall be none where others do as well: a link
            that may yet be refuted is verified there.

    Returns:
        Those of them at which nothing changes, as they are, and new ones: at most one between two nodes,
        smaller id first, in the order of ids.
    """
    from scipy import sparse
    from scipy.sparse.csgraph import connected_components

    earlier = tuple(earlier)
    factors = _about(graph, removed, earlier)
    if not len(factors):
        return sorted(earlier, key=lambda link: link.pair)
    rows = np.unique(np.concatenate([factors.a, factors.b]))
    order = np.zeros(len(graph.nodes), np.int64)
    order[rows] = np.arange(len(rows))
    part = factors.take(np.arange(len(factors)), order)
    ties = sparse.coo_matrix((np.ones(len(part), np.int8), (part.a, part.b)), (len(rows), len(rows)))
    labels = connected_components(ties, directed=False)[1]
    first = np.unique(labels, return_index=True)[1]
    means = optimized(part, graph.means[rows], np.arange(len(rows)), first)
    left = np.array([graph.nodes[row] not in removed for row in rows.tolist()], np.bool_)
    replaced = {link.pair for link in _among(graph, factors, earlier)}
    out = [link for link in earlier if link.pair not in replaced and removed.isdisjoint(link.pair)]
    for label in range(len(first)):
        inside = np.flatnonzero(labels == label)
        if np.count_nonzero(left[inside]) > 1:
            seat = np.full(len(rows), -1)
            seat[inside] = np.arange(len(inside))
            own = part.take(labels[part.a] == label, seat)
            nodes = tuple(graph.nodes[row] for row in rows[inside].tolist())
            piece = Component(nodes[0], nodes, means[inside], own)
            out += _approximation(piece, np.flatnonzero(left[inside]), taken)
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


def _about(graph: Component, removed: Set[NodeId], earlier: Iterable[Link]) -> Factors:
    """Measurements at removed nodes, and marginal links between their neighbours, by rows of the graph."""
    part = graph.factors.take(graph.factors.at(np.sort(graph.index([*removed]))))
    rows = graph.rows
    others = [link for link in _among(graph, part, earlier) if removed.isdisjoint(link.pair)]
    ends = ([rows[link.pair[end]] for link in others] for end in (0, 1))
    return Factors.together([part, Factors.of([link.measurement for link in others], *ends)])


def _among(graph: Component, part: Factors, links: Iterable[Link]) -> list[Link]:
    """Links between nodes that measurements are about."""
    about = {graph.nodes[row] for row in np.unique(np.concatenate([part.a, part.b])).tolist()}
    return [link for link in links if about.issuperset(link.pair)]


def _approximation(graph: Component, left: Rows, taken: Set[Pair]) -> list[Link]:
    """Links that approximate the marginal distribution of some nodes of a graph."""
    nodes = [graph.nodes[row] for row in left.tolist()]
    seat = {node: k for k, node in enumerate(nodes)}
    barred = [(seat[a], seat[b]) for a, b in taken if a in seat and b in seat]
    pairs = _near(graph.means[left], barred)
    starts, ends = ([graph.nodes[left[k]] for k in column.tolist()] for column in pairs.T)
    poses = graph.relative(starts, ends)
    chosen = _chosen(pairs, np.linalg.slogdet(poses.covariances)[1])
    means, covariances = poses.means[chosen], poses.covariances[chosen]
    weights = _weights(
        graph.means[left], pairs[chosen], means, np.asarray(np.linalg.inv(covariances), np.float64)
    )
    out = []
    for k, row in enumerate(chosen.tolist()):
        pose = PoseGaussian(Pose2.from_vector(means[k]), nearest_covariance(covariances[k] / weights[k]))
        out.append(Link(starts[row], ends[row], pose, evidence={MARGINAL: 1.0}))
    return out


def _chosen(pairs: Rows, entropies: Array) -> Rows:
    """Rows of the pairs of the tree, and of the surest pairs of each node, ascending."""
    graph: nx.Graph = nx.Graph()
    for row, (a, b) in enumerate(pairs.tolist()):
        graph.add_edge(a, b, weight=float(entropies[row]), row=row)
    chosen = {graph.edges[edge]["row"] for edge in nx.minimum_spanning_edges(graph, data=False)}
    for node in graph:
        rows = (edge["row"] for _, _, edge in graph.edges(node, data=True))
        chosen.update(sorted(rows, key=lambda row: (entropies[row], row))[:LINKS])
    return np.array(sorted(chosen), np.int64)


def _weights(places: Array, pairs: Rows, means: Array, information: Array) -> Array:
    """(K,) the weights of K links, see the module.

    Args:
        places: (N, 3) m, m, rad, of the nodes.
        pairs: (K, 2) rows of nodes, which they connect.
        means: (K, 3) m, m, rad, of the links.
        information: (K, 3, 3) of the links.
    """
    nodes = tuple(NodeId("", 0, k) for k in range(len(places)))
    starts, ends = ([nodes[k] for k in column.tolist()] for column in pairs.T)
    weights = np.full(len(pairs), (len(nodes) - 1) / len(pairs))
    for _ in range(ROUNDS):
        factors = Factors(pairs[:, 0], pairs[:, 1], means, weights[:, None, None] * information)
        spreads = Component(nodes[0], nodes, places, factors).relative(starts, ends).covariances
        weights *= np.einsum("nij,nji->n", information, spreads) / 3.0
    return weights


def _near(means: Array, barred: Collection[tuple[int, int]]) -> Rows:
    """(K, 2) rows of near poses, smaller first; so many that they are connected.

    Args:
        means: (N, 3) m, m, rad.
        barred: pairs that are left out, unless nothing else connects all.
    """
    from scipy import sparse
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    codes = np.array([a * len(means) + b for a, b in barred], np.int64)
    headings = means[:, 2:]
    places = np.hstack([means[:, :2], TURN * np.cos(headings), TURN * np.sin(headings)])
    index, count = cKDTree(places), len(means)
    k = NEIGHBOURS
    while True:
        k = min(k, count - 1)
        near = np.asarray(index.query(places, k + 1)[1])
        pairs = np.column_stack([np.repeat(np.arange(count), k + 1), near.ravel()])
        pairs = np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0)
        every, pairs = pairs, pairs[~np.isin(pairs[:, 0] * count + pairs[:, 1], codes)]
        ties = sparse.coo_matrix((np.ones(len(pairs), np.int8), tuple(pairs.T)), (count, count))
        if connected_components(ties, directed=False)[0] == 1:
            return pairs
        if k == count - 1:
            return every
        k *= 2

"""Link probability: how probable it is that a link is right, by the rest of the map.

Two images cannot distinguish two places that look the same. So the prior odds are those of this merge's
verified links. The rest of the merged map then predicts the relative pose of the two nodes: a right link
differs from that within the covariances, a link into an aliased place by anything within the mapped floor.
The ratio of these two densities is Bayes' factor.

A link is taken out of the graph before it is compared with it, without solving again: with P the covariance
of the two nodes' relative pose, W the information of the link as the solver weighed it, and e the residual,
the rest of the graph has the covariance (P^-1 - W)^-1, and the residual against it is (I - P W)^-1 e (the
leave-one-out residual of least squares; exact where the graph is linear).

The probability assumes that links are right or wrong independently. Links into a whole room that looks the
same agree with one another; against these the merge has other rules
(mapweave.merge.mutual_exclusion.refutation and mapweave.merge.outlier_rejection.pairwise_consistency).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian, nearest_covariance
from mapweave.merge.pose_graph.factors import LOOP_FLOOR, believable
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.pose_graph.solved_graph import PoseGraph

AT_ONCE = 64
"""Links whose covariances are solved for together: all at once would take memory by the square."""
LEAST_AREA = 4.0
"""What is mapped is never smaller than this, m^2: a single full turn."""
NO_INFORMATION = 1e-6
"""Share of a link's own information below which the rest of the graph is no evidence."""


class Standpoint(NamedTuple):
    """How a link compares with the merged map.

    Attributes:
        merged_a_from_b: of its two nodes, by everything that is joined, the link included if it is kept.
        off: (3,) m, m, rad, from the link's b to the merged one, in the link's b.
        strain2: `off` in the link's own uncertainty, chi-square with 3 degrees of freedom.
        alone: whether only this link connects the two.
        log_factor: natural logarithm of Bayes' factor for the link, 0 if it is alone.
        residual2: of the link in a map that is solved with it, in its own uncertainty and `LOOP_FLOOR`,
            chi-square with 3 degrees of freedom: what is left where the map yields as far as it is uncertain.
    """

    merged_a_from_b: PoseGaussian
    off: Array
    strain2: float
    alone: bool
    log_factor: float
    residual2: float


def prior_odds(merged: MergedMap) -> float:
    """Prior odds that a verified link is right: the ratio of accepted to refused links.

    Links excluded by manual constraints do not count. Half a link is added to either side (Jeffreys' prior).
    """
    refused = sum(
        r.link is not None and r.edge is None and merged.constraints.against(*r.pair) is None
        for r in merged.refused
    )
    return (len(merged.links) + 0.5) / (refused + 0.5)


def probability(log_factor: float, odds: float) -> float:
    """By Bayes' factor and prior odds; never so near to 0 or 1 that nothing could change it."""
    log_odds = float(np.clip(log_factor + math.log(odds), -12.0, 12.0))
    return 1.0 / (1.0 + math.exp(-log_odds))


def link_probabilities(merged: MergedMap) -> dict[tuple[NodeId, NodeId], float]:
    """Probability of each accepted link, by its pair."""
    odds = prior_odds(merged)
    out: dict[tuple[NodeId, NodeId], float] = {}
    for graph in merged.graphs:
        inside = [link for link in merged.links if link.a in graph.rows]
        for k in range(0, len(inside), AT_ONCE):
            some = inside[k : k + AT_ONCE]
            for link, standpoint in zip(some, standpoints(some, graph, kept=True), strict=True):
                out[link.pair] = probability(standpoint.log_factor, odds)
    return out


def standpoints(links: Sequence[Link], graph: PoseGraph, *, kept: bool) -> list[Standpoint]:
    """Compare links with a solved component.

    Args:
        links: with both ends in the graph.
        graph: the component.
        kept: whether they are among its measurements.
    """
    if not links:
        return []
    merged = graph.relative([link.a for link in links], [link.b for link in links])
    area = max(float(np.prod(np.ptp(graph.means[:, :2], axis=0))), LEAST_AREA)
    return [
        _standpoint(
            link,
            PoseGaussian(Pose2.from_vector(mean), nearest_covariance(covariance)),
            area,
            kept,
        )
        for link, mean, covariance in zip(links, merged.means, merged.covariances, strict=True)
    ]


def _standpoint(link: Link, merged: PoseGaussian, area: float, kept: bool) -> Standpoint:
    off = (link.a_from_b.mean.inverse() @ merged.mean).vector
    own = believable(link.a_from_b.covariance)
    strain2 = float(off @ np.linalg.solve(own, off))
    rest, moved = merged.covariance, off
    if kept:
        weight = np.linalg.inv(own)
        information = np.linalg.inv(merged.covariance) - weight
        scale = np.linalg.inv(np.linalg.cholesky(weight))
        if np.linalg.eigvalsh(scale @ information @ scale.T)[0] < NO_INFORMATION:
            return Standpoint(merged, off, strain2, True, 0.0, 0.0)
        rest = np.linalg.inv(information)
        moved = rest @ np.linalg.solve(merged.covariance, off)
    spread = own + rest + LOOP_FLOOR
    # In the plane anywhere on the floor that is mapped, in heading anyhow.
    anywhere = -math.log(area * 2.0 * math.pi)
    log_density = -0.5 * float(np.linalg.slogdet(2.0 * math.pi * spread)[1])
    if log_density <= anywhere:
        return Standpoint(merged, off, strain2, True, 0.0, 0.0)
    weighed = np.linalg.solve(spread, moved)
    factor = log_density - 0.5 * float(moved @ weighed) - anywhere
    return Standpoint(merged, off, strain2, False, factor, float(weighed @ (own + LOOP_FLOOR) @ weighed))

"""Loop closures: edges between two nodes of a robot's own map that rest on place recognition."""

from collections.abc import Iterable

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Edge, EdgeKind
from mapweave.hybridmap.pose import PoseGaussian
from mapweave.merge.pose_graph.factors import LOOP_FLOOR
from mapweave.merge.pose_graph.links import RefusedLink, link_of, refuse_edge
from mapweave.merge.settings import ConsistencySettings

CLAIMS = (EdgeKind.LOOP, EdgeKind.MERGED, EdgeKind.DRIVEN)
"""Edge kinds that rest on place recognition."""

Claims = dict[tuple[NodeId, NodeId], tuple[Edge, ...]]
"""Edges by the two nodes, smaller id first: of both kinds, the most certain first."""


def sort_loop_closures(edges: Iterable[Edge], s: ConsistencySettings) -> tuple[Claims, list[RefusedLink]]:
    """The claims among a robot's edges: between two nodes one that was recognised, one that was driven.

    Of several that were recognised the last counts. A driven edge connects nodes that two views showed one
    after the other; if it contradicts what one view shows, the one view is trusted.

    Args:
        edges: with both ends in the robot's map.
        s: when two measurements agree.

    Returns:
        The claims, and those that are left out, with reasons.
    """
    recognised: dict[tuple[NodeId, NodeId], Edge] = {}
    driven: dict[tuple[NodeId, NodeId], Edge] = {}
    refusals: list[RefusedLink] = []
    for edge in sorted((e for e in edges if e.kind in CLAIMS), key=lambda edge: edge.id):
        kind, word = (driven, "driven") if edge.kind is EdgeKind.DRIVEN else (recognised, "recognised")
        earlier = kind.get(link_of(edge).pair)
        if earlier is not None:
            refusals.append(refuse_edge(earlier, f"{word} again, see {edge.id}"))
        kind[link_of(edge).pair] = edge
    claims: Claims = {pair: (edge,) for pair, edge in recognised.items()}
    for pair, edge in driven.items():
        recognition = recognised.get(pair)
        if recognition is None:
            claims[pair] = (edge,)
        elif distance2_of(link_of(edge).a_from_b, link_of(recognition).a_from_b) < s.gate:
            both = sorted(
                (edge, recognition), key=lambda one: float(link_of(one).a_from_b.covariance.trace())
            )
            claims[pair] = tuple(both)
        else:
            refusals.append(refuse_edge(edge, f"contradicts what was recognised, see {recognition.id}"))
    return claims, refusals


def distance2_of(a: PoseGaussian, b: PoseGaussian) -> float:
    """Squared Mahalanobis distance of two measurements of one pose, chi-square with 3 degrees of freedom."""
    return PoseGaussian(a.mean, a.covariance + b.covariance + LOOP_FLOOR).mahalanobis2(b.mean)

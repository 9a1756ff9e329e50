"""What edges a robot can have measured."""

import math

from mapweave.hybridmap.node import Edge, EdgeKind

MOST_EDGE_M = 1000.0
"""Edges join nodes that show the same landmarks, or between which a robot drove by them."""
LEAST_EDGE_SIGMA, MOST_EDGE_SIGMA = 1e-6, 10.0
"""m and rad. Edges of robots have some 2e-3. Who knows an edge less well than the second knows nothing."""


def unmeasurable(edge: Edge) -> str:
    """Why no robot can have measured an edge; empty if one can have.

    Ranges of messages are wider: what they carry may be the sum of many measurements.
    """
    pose, which = edge.a_from_b, edge.id
    if edge.kind is not EdgeKind.DRIVEN and not edge.within:
        return f"edge {which} is {edge.kind} and joins nodes of others: robots only drive between those"
    length = math.hypot(pose.mean.x, pose.mean.y)
    if length > MOST_EDGE_M:
        return f"edge {which} is {length:.0f} m long, more than {MOST_EDGE_M:.0f} m"
    sigma = math.sqrt(pose.covariance.diagonal().max())
    if edge.within and sigma < LEAST_EDGE_SIGMA:
        return f"edge {which} has no uncertainty, which no robot measures"
    if sigma > MOST_EDGE_SIGMA:
        return (
            f"edge {which} has a standard deviation of {sigma:.0f} m or rad, more than {MOST_EDGE_SIGMA:.0f}"
        )
    return ""

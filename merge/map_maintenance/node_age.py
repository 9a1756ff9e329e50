"""Ages: which of two nodes is the older one."""

from __future__ import annotations

from mapweave.hybridmap.node import Node


def is_older(one: Node, other: Node) -> bool:
    """Whether a node was taken before another one.

    An agent counts its epochs and its nodes, whatever its clock says. Of two agents the clocks tell; where
    they cannot be compared the answer is always the same, and means little.
    """
    if one.id.agent == other.id.agent:
        return one.id < other.id
    return (one.stamp_ns, one.id) < (other.stamp_ns, other.id)

"""Ages: which of two nodes is the older one."""

from mapweave.hybridmap.node import Node


def is_older(a: Node, b: Node) -> bool:
    """Whether a node was taken before another one.

    An agent counts its epochs and its nodes, so its clock does not matter. Between two agents the clocks
    decide; without a common clock the answer is arbitrary, but always the same.
    """
    if a.id.agent == b.id.agent:
        return a.id < b.id
    return (a.stamp_ns, a.id) < (b.stamp_ns, b.id)

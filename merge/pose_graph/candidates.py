"""Which pairs of nodes are worth a verification: those that share many similar descriptors.

The overlap of two nodes depends on these two alone, not on the rest of the fleet, so a table of overlaps can
grow node by node and the choice made from it does not depend on the order.
"""

from mapweave.hybridmap.ids import NodeId

LEAST_OVERLAP = 3.0
"""Pairs whose nodes have less in common (mapserver/retrieval/voting.py) are not compared."""
ALIKE = 0.5
"""Distance of two decoded descriptors below which they may be the same landmark."""
MOST_PER_MAP = 4
"""Best pairs of one node with the nodes of any one map."""
LEAST_HOPS = 3
"""Nodes of one map that are fewer edges apart are neighbours, not loops."""

Pair = tuple[NodeId, NodeId]

"""The optimum of a planar pose graph of others, by the back end of the merge."""

import networkx as nx
import numpy as np

from mapweave.formats.g2o import G2oGraph
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from mapweave.merge.pose_graph.component import solve_graph
from mapweave.merge.pose_graph.factors import LEAST_SIGMAS, RelativePose

OTHERS = "g2o"
"""Takes the agent's place in the ids of foreign vertices."""


def optimum_of(graph: G2oGraph) -> dict[int, Pose2]:
    """Optimise all vertices; the first that is fixed is held, else that with the smallest number.

    Raises:
        InvalidValue: the graph is in several pieces.
    """
    joined: nx.Graph = nx.Graph()
    joined.add_nodes_from(graph.poses)
    joined.add_edges_from((edge.i, edge.j) for edge in graph.edges)
    pieces = nx.number_connected_components(joined)
    if pieces != 1:
        raise InvalidValue(f"the graph is in {pieces} pieces that no edge joins: give them one by one")
    held = graph.fixed[0] if graph.fixed else min(graph.poses)
    ids = {k: NodeId(OTHERS, 0, k) for k in graph.poses}
    # The back end adds its least error to every measurement; here the file's own numbers shall count.
    measurements = [
        RelativePose(ids[edge.i], ids[edge.j], PoseGaussian(edge.i_from_j, _less(edge.covariance)))
        for edge in graph.edges
    ]
    solved = solve_graph(ids[held], graph.poses[held], measurements)
    return {k: solved.pose(ids[k]) for k in graph.poses}


def _less(covariance: Array) -> Array:
    """A covariance without the least error, as far as that leaves one."""
    left: Array = covariance - np.diag(LEAST_SIGMAS**2)
    return left if np.linalg.eigvalsh(left)[0] >= 0.0 else covariance

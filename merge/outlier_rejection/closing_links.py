"""Joins pieces of map by sorted groups of links; how far a link is from a solved graph."""

from collections.abc import Mapping, Sequence

import networkx as nx
import numpy as np

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Array
from mapweave.merge.outlier_rejection.pairwise_consistency import Sorted
from mapweave.merge.pose_graph.component_solver import ComponentSolver
from mapweave.merge.pose_graph.factors import LOOP_FLOOR
from mapweave.merge.pose_graph.links import Link, RefusedLink, refuse
from mapweave.merge.pose_graph.solved_graph import PoseGraph
from mapweave.merge.settings import ConsistencySettings
from mapweave.registration.pose_arrays import PoseGaussians

Groups = Mapping[tuple[NodeId, NodeId], Sorted]
"""Sorted links by the names of the two fragments between which they are."""


def join(
    solver: ComponentSolver, groups: Groups, s: ConsistencySettings
) -> tuple[list[Link], list[RefusedLink]]:
    """Join pieces by their groups of links, best supported first; later ones must agree with earlier ones.

    Returns:
        The links that join, and those that were refused here.
    """
    joined: nx.Graph = nx.Graph()
    joined.add_nodes_from(fragment.name for fragment in solver.fragments)
    kept: list[Link] = []
    closing: list[Sorted] = []
    ranked = sorted(groups.items(), key=lambda item: (-item[1].weight, item[0]))
    for (first, second), group in ranked:
        if not group.kept:
            continue
        if first == second or not nx.has_path(joined, first, second):
            joined.add_edge(first, second)
            kept += group.kept
        else:
            closing.append(group)
    refusals: list[RefusedLink] = []
    for group in closing:
        solver.solve(kept)
        graph = solver.graph_of(group.kept[0].a)
        good = misfits(group.kept, graph) < s.gate
        kept += [link for link, fits in zip(group.kept, good, strict=True) if fits]
        refusals += [
            refuse(link, "contradicts better supported links by way of other maps")
            for link, fits in zip(group.kept, good, strict=True)
            if not fits
        ]
    return kept, refusals


def misfits(links: Sequence[Link], graph: PoseGraph) -> Array:
    """(N,) how far links that are not in the graph are from it, chi-square with 3 degrees of freedom."""
    measured = PoseGaussians(
        np.stack([link.a_from_b.mean.vector for link in links]),
        np.stack([link.a_from_b.covariance + LOOP_FLOOR for link in links]),
    )
    back = graph.relative([link.b for link in links], [link.a for link in links])
    return (measured @ back).distances2()

"""Pieces of map and sorted groups of links become components with optimised poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import networkx as nx
import numpy as np

from mapweave.hybridmap.node import NodeId
from mapweave.hybridmap.pose import Array
from mapweave.merge.outlier_rejection.pairwise_consistency import Sorted
from mapweave.merge.pose_graph.component_solver import ComponentSolver
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
        good = misfits(group.kept, graph, s) < s.gate
        kept += [link for link, fits in zip(group.kept, good, strict=True) if fits]
        refusals += [
            refuse(link, "contradicts better supported links by way of other maps")
            for link, fits in zip(group.kept, good, strict=True)
            if not fits
        ]
    return kept, refusals


def misfits(links: Sequence[Link], graph: PoseGraph, s: ConsistencySettings) -> Array:
    """(N,) how far links that are not in the graph are from it, chi-square with 3 degrees of freedom."""
    floor = np.diag([s.floor_xy**2, s.floor_xy**2, s.floor_heading**2])
    measured = PoseGaussians(
        np.stack([link.a_from_b.mean.vector for link in links]),
        np.stack([link.a_from_b.covariance + floor for link in links]),
    )
    back = graph.relative([link.b for link in links], [link.a for link in links])
    return (measured @ back).distances2()


def optimise(
    solver: ComponentSolver, links: Sequence[Link], strain: float, whole: bool = True
) -> tuple[list[PoseGraph], list[Link], list[RefusedLink]]:
    """Optimise; refuse links that strain too much, worst first.

    It never cuts a piece off: a link that is all that holds two pieces together has no strain.

    Args:
        solver: of the fragments.
        links: that join them.
        strain: chi-square with 3 degrees of freedom above which a link is refused.
        whole: whether large components are at last optimised as a whole.

    Returns:
        The components, the links that are kept, and those that were refused.
    """
    left = list(links)
    refusals: list[RefusedLink] = []
    # Limited pull lets the wrong ones stand out; where all are right it is not the best estimate.
    passes = ((False, False), (True, False), (True, True)) if whole else ((True, False),)
    while True:
        for believed, last in passes:
            solved = solver.solve(left, believed=believed, whole=last)
            worst, strain2 = solver.worst()
            if worst is not None and strain2 > strain:
                break
        else:
            return solved, left, refusals
        reason = f"strains the joined map: {strain2**0.5:.1f} standard deviations from where it ended"
        refusals.append(refuse(worst, reason))
        left = [link for link in left if link.key != worst.key]

"""Readmission: the few links that most of the map speaks against, tried once more by solving with them.

How far a link is off is judged along the tangent of the solution without it. Where headings are little known
that is not good enough: the map bends by more than its tangent tells. If nearly all links of a map are
believed, those that are not are likely to be right too, and if they are not far off worth a solution each.
How much the chi-square of everything rises takes the place of the misfit in Bayes' factor, and the odds begin
with how many links are believed for one that is not (see merge.belief.credence).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from hybridmap.recognising.pose_arrays import compose_poses, inverse_poses
from merge.belief.consistency import ConsistencySettings
from merge.belief.credence import standpoints
from merge.belief.joining import Solver, misfits
from merge.graph.links import Link
from merge.graph.posegraph import Measurement, PoseGraph

FEW = 0.05
"""Share of a component's links up to which those that are refused are tried."""
NEAR = 10.0
"""How many times the gate one may be off along the tangent: it saves the solutions that are in vain."""


def readmitted(
    solver: Solver, kept: Sequence[Link], refused: Sequence[Link], s: ConsistencySettings
) -> list[Link]:
    """Refused links with which the components are solved as well, each tried with those before it.

    Args:
        solver: of the fragments.
        kept: links that are believed.
        refused: links that are not.
        s: when links are believed.
    """
    out: list[Link] = []
    for graph in solver.solve(kept):
        here = [link for link in kept if link.a in graph.rows]
        inside = [link for link in refused if link.a in graph.rows and link.b in graph.rows]
        if not inside or len(inside) > FEW * (len(here) + len(inside)):
            continue
        log_odds = math.log((len(here) + 0.5) / (len(inside) + 0.5))
        known = zip(inside, misfits(inside, graph, s), standpoints(inside, graph, kept=False), strict=True)
        tried = sorted(
            ((link, far, found) for link, far, found in known if far < NEAR * s.gate and not found.alone),
            key=lambda item: item[0].canonical().pair,
        )
        cost = _cost(solver, here) if tried else 0.0
        for link, far, found in tried:
            now = _cost(solver, [*here, link])
            if log_odds + found.log_factor + 0.5 * (far - (now - cost)) > s.least_evidence:
                here, cost = [*here, link], now
                out.append(link)
    return out


def _cost(solver: Solver, links: Sequence[Link]) -> float:
    """Chi-square of all measurements of the one component that links make."""
    graph = next(g for g in solver.solve(links, believed=True) if links[0].a in g.rows)
    return chi2(graph, solver.measurements(links, graph))


def chi2(graph: PoseGraph, measurements: Sequence[Measurement]) -> float:
    """Sum of the squared normalised residuals of a solved graph."""
    if not measurements:
        return 0.0
    a = graph.means[graph.index([m.a for m in measurements])]
    b = graph.means[graph.index([m.b for m in measurements])]
    measured = np.stack([m.a_from_b.mean.vector for m in measurements])
    off = compose_poses(inverse_poses(measured), compose_poses(inverse_poses(a), b))
    covariances = np.stack([m.covariance for m in measurements])
    return float((off * np.linalg.solve(covariances, off[:, :, None])[:, :, 0]).sum())

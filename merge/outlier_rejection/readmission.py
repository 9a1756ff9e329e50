"""Readmission: the few links that most of the map speaks against, tried once more by solving with them.

How far a link is off is judged along the tangent of the solution without it. Where headings are little known
that is not good enough: the map bends by more than its tangent tells. If nearly all links of a map are
believed, those that are not are likely to be right too, and if they are not far off worth a solution each.
How much the chi-square of everything rises takes the place of the misfit in Bayes' factor, and the odds begin
with how many links are believed for one that is not (see mapweave.merge.outlier_rejection.link_probability).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from mapweave.merge.outlier_rejection.closing_links import misfits
from mapweave.merge.outlier_rejection.link_probability import standpoints
from mapweave.merge.outlier_rejection.pairwise_consistency import LEAST_EVIDENCE
from mapweave.merge.pose_graph.component import Component
from mapweave.merge.pose_graph.component_solver import ComponentSolver
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.settings import ConsistencySettings

FEW = 0.05
"""Share of a component's links up to which those that are refused are tried."""
NEAR = 10.0
"""How many times the gate one may be off along the tangent: it saves the solutions that are in vain."""


def readmitted(
    solver: ComponentSolver, kept: Sequence[Link], refused: Sequence[Link], s: ConsistencySettings
) -> list[Link]:
    """Refused links with which the components are solved as well, each tried with those before it.

    Args:
        solver: of the fragments.
        kept: links that are believed.
        refused: links that are not.
        s: when links are believed.
    """
    out: list[Link] = []
    if not refused:
        return out
    for graph in solver.solve(kept):
        inside = [link for link in refused if link.a in graph.rows and link.b in graph.rows]
        here = [link for link in kept if link.a in graph.rows] if inside else []
        if not inside or len(inside) > FEW * (len(here) + len(inside)):
            continue
        log_odds = math.log((len(here) + 0.5) / (len(inside) + 0.5))
        known = zip(inside, misfits(inside, graph, s), standpoints(inside, graph, kept=False), strict=True)
        tried = sorted(
            ((link, far, found) for link, far, found in known if far < NEAR * s.gate and not found.alone),
            key=lambda item: item[0].key,
        )
        cost = _cost(solver, here) if tried else 0.0
        for link, far, found in tried:
            now = _cost(solver, [*here, link])
            if log_odds + found.log_factor + 0.5 * (far - (now - cost)) > LEAST_EVIDENCE:
                here, cost = [*here, link], now
                out.append(link)
    return out


def _cost(solver: ComponentSolver, links: Sequence[Link]) -> float:
    """Chi-square of all measurements of the one component that links make."""
    solver.solve(links)
    graph = solver.graph_of(links[0].a)
    assert isinstance(graph, Component)
    return graph.chi2

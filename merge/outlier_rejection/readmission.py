"""Readmission: the few refused links of a map, tried once more by solving with them.

A link's residual is computed along the tangent of the solution without it. Where headings are uncertain that
is not good enough: the map bends by more than its tangent. If nearly all links of a map are accepted, the
refused ones are likely to be right too, and worth a solution each if their residuals are not large. The rise
of the total chi-square replaces the misfit in Bayes' factor, and the prior odds are accepted over refused
links (see mapweave.merge.outlier_rejection.link_probability).
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
"""Largest residual along the tangent, in gates: it saves useless solutions."""


def readmitted(
    solver: ComponentSolver, kept: Sequence[Link], refused: Sequence[Link], s: ConsistencySettings
) -> list[Link]:
    """Refused links with which the components are solved as well, each tried with those before it.

    Args:
        solver: of the fragments.
        kept: accepted links.
        refused: links that are not.
        s: when links are accepted.
    """
    out: list[Link] = []
    if not refused:
        return out
    for graph in solver.solve(kept):
        inside = [link for link in refused if link.a in graph.rows and link.b in graph.rows]
        accepted = [link for link in kept if link.a in graph.rows] if inside else []
        if not inside or len(inside) > FEW * (len(accepted) + len(inside)):
            continue
        log_odds = math.log((len(accepted) + 0.5) / (len(inside) + 0.5))
        rated = zip(inside, misfits(inside, graph, s), standpoints(inside, graph, kept=False), strict=True)
        tried = sorted(
            (
                (link, misfit, standpoint)
                for link, misfit, standpoint in rated
                if misfit < NEAR * s.gate and not standpoint.alone
            ),
            key=lambda item: item[0].key,
        )
        cost = _cost(solver, accepted) if tried else 0.0
        for link, misfit, standpoint in tried:
            now = _cost(solver, [*accepted, link])
            if log_odds + standpoint.log_factor + 0.5 * (misfit - (now - cost)) > LEAST_EVIDENCE:
                accepted, cost = [*accepted, link], now
                out.append(link)
    return out


def _cost(solver: ComponentSolver, links: Sequence[Link]) -> float:
    """Chi-square of all measurements of the one component that links make."""
    solver.solve(links)
    graph = solver.graph_of(links[0].a)
    assert isinstance(graph, Component)
    return graph.chi2

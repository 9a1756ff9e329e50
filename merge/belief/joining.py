"""Pieces of map and sorted groups of links become components with optimised postures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from enum import StrEnum

import networkx as nx
import numpy as np

from hybridmap.node import NodeId
from hybridmap.pose import Array
from hybridmap.recognising.pose_arrays import PoseGaussians, compose_poses, inverse_poses
from merge.belief.consistency import ConsistencySettings, Sorted
from merge.belief.graduated import wrong_measurements
from merge.graph.fragments import Fragment, fragment_by_node
from merge.graph.links import Link, RefusedLink, refuse
from merge.graph.posegraph import HUBER, Measurement, PoseGraph, believable, solve_graph

Groups = Mapping[tuple[NodeId, NodeId], Sorted]
"""Sorted links by the names of the two fragments between which they are."""


class Solver:
    """Optimises the components that links make of fragments, each set of links only once."""

    def __init__(self, fragments: Sequence[Fragment], huber: float = HUBER) -> None:
        """Take the fragments.

        Args:
            fragments: pieces of map.
            huber: see `solve_graph`.
        """
        self.fragments = fragments
        self._huber = huber
        self.by_node = fragment_by_node(fragments)
        self._by_name = {fragment.name: fragment for fragment in fragments}
        self._solved: dict[tuple[bool, tuple[tuple[NodeId, NodeId], ...]], PoseGraph] = {}

    def solve(self, links: Sequence[Link], *, believed: bool = False) -> list[PoseGraph]:
        """Each component, largest first, then by name.

        Args:
            links: at most one between two nodes.
            believed: whether all of them are, and none is held back: plain least squares.
        """
        solved = [
            self._component(names, here, believed) if here else self._by_name[names[0]].graph
            for names, here in self._components(links)
        ]
        return sorted(solved, key=lambda graph: (-len(graph.nodes), graph.anchor))

    def wrong(self, links: Sequence[Link], gate: float) -> set[tuple[NodeId, NodeId]]:
        """Pairs of the links that are wrong by graduated non-convexity.

        Args:
            links: at most one between two nodes.
            gate: chi-square with 3 degrees of freedom above which a link is wrong.
        """
        out: set[tuple[NodeId, NodeId]] = set()
        for names, here in self._components(links):
            if here:
                start = self._by_name[names[0]].graph.pose(names[0])
                wrong = wrong_measurements(names[0], start, self._measurements(names, here), gate)
                out |= {(m.a, m.b) for m in wrong} & {link.pair for link in here}
        return out

    def measurements(self, links: Sequence[Link], graph: PoseGraph) -> list[Measurement]:
        """All that a component was solved from, given its links."""
        names = [fragment.name for fragment in self.fragments if fragment.name in graph.rows]
        return self._measurements(names, links)

    def _components(self, links: Sequence[Link]) -> list[tuple[list[NodeId], list[Link]]]:
        """Names of the fragments of each component, ascending, and its links; in the order of the names."""
        joined: nx.Graph = nx.Graph()
        joined.add_nodes_from(self._by_name)
        joined.add_edges_from((self.by_node[link.a].name, self.by_node[link.b].name) for link in links)
        components = sorted(sorted(names) for names in nx.connected_components(joined))
        seats = {name: k for k, names in enumerate(components) for name in names}
        inside: list[list[Link]] = [[] for _ in components]
        for link in links:
            inside[seats[self.by_node[link.a].name]].append(link)
        return list(zip(components, inside, strict=True))

    def _measurements(self, names: Sequence[NodeId], links: Sequence[Link]) -> list[Measurement]:
        own = [m for name in names for m in self._by_name[name].measurements]
        return own + [Measurement(link.a, link.b, link.a_from_b, robust=True) for link in links]

    def _component(self, names: Sequence[NodeId], links: Sequence[Link], believed: bool) -> PoseGraph:
        pairs = tuple(sorted(link.canonical().pair for link in links))
        believed = believed or math.isinf(self._huber)
        key = believed, pairs
        if key not in self._solved:
            anchor = names[0]
            measurements = self._measurements(names, links)
            start = self._by_name[anchor].graph.pose(anchor)
            # The least squares of links that are believed are near where these were tried.
            tried = self._solved.get((False, pairs))
            guesses = {node: tried.pose(node) for node in tried.nodes} if tried is not None else None
            huber = math.inf if believed else self._huber
            self._solved[key] = solve_graph(anchor, start, measurements, guesses, huber)
        return self._solved[key]


def join(solver: Solver, groups: Groups, s: ConsistencySettings) -> tuple[list[Link], list[RefusedLink]]:
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
        if not s.cliques or first == second or not nx.has_path(joined, first, second):
            joined.add_edge(first, second)
            kept += group.kept
        else:
            closing.append(group)
    refusals: list[RefusedLink] = []
    for group in closing:
        graph = next(g for g in solver.solve(kept) if group.kept[0].a in g.rows)
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


class Outliers(StrEnum):
    """What becomes of links that the joined map does not bear out.

    All are believed (`none`, plain least squares). Or their pull is limited and the worst is refused, as long
    as one strains too much; the others then pull as hard as they were measured (`worst_first`). Or those that
    graduated non-convexity leaves out are refused at once (`graduated`).
    """

    NONE = "none"
    WORST_FIRST = "worst_first"
    GRADUATED = "graduated"


def optimise(
    solver: Solver, links: Sequence[Link], strain: float, outliers: Outliers = Outliers.WORST_FIRST
) -> tuple[list[PoseGraph], list[Link], list[RefusedLink]]:
    """Optimise; refuse links that strain too much.

    Worst first, it never cuts a piece off: a link that is all that holds two pieces together has no strain.

    Args:
        solver: of the fragments.
        links: that join them.
        strain: chi-square with 3 degrees of freedom above which a link is refused.
        outliers: how they are found.

    Returns:
        The components, the links that are kept, and those that were refused.
    """
    left = list(links)
    if outliers is Outliers.NONE:
        return solver.solve(left), left, []
    refusals: list[RefusedLink] = []
    if outliers is Outliers.GRADUATED:
        wrong = solver.wrong(left, strain)
        reason = "strains the joined map: graduated non-convexity leaves it out"
        refusals = [refuse(link, reason) for link in left if link.pair in wrong]
        left = [link for link in left if link.pair not in wrong]
    while True:
        # Limited pull lets the wrong ones stand out; where all are right it is not the best estimate.
        for believed in (False, True):
            solved = solver.solve(left, believed=believed)
            strains = _strains(left, solved)
            if strains.max(initial=0.0) > strain:
                break
        else:
            return solved, left, refusals
        worst = int(strains.argmax())
        off = float(strains[worst]) ** 0.5
        reason = f"strains the joined map: {off:.1f} standard deviations from where it ended"
        refusals.append(refuse(left.pop(worst), reason))


def _strains(links: Sequence[Link], solved: Sequence[PoseGraph]) -> Array:
    """(N,) how far optimised links are from where they ended, chi-square with 3 degrees of freedom."""
    if not links:
        return np.zeros(0)
    starts = np.cumsum([0, *(len(graph.nodes) for graph in solved)])
    rows = {
        node: start + k
        for start, graph in zip(starts, solved, strict=False)
        for node, k in graph.rows.items()
    }
    means = np.concatenate([graph.means for graph in solved])
    a, b = (means[[rows[node] for node in nodes]] for nodes in zip(*(x.pair for x in links), strict=True))
    measured = PoseGaussians(
        np.stack([link.a_from_b.mean.vector for link in links]),
        believable(np.stack([link.a_from_b.covariance for link in links])),
    )
    off = compose_poses(inverse_poses(measured.means), compose_poses(inverse_poses(a), b))
    out: Array = (off * np.linalg.solve(measured.covariances, off[:, :, None])[:, :, 0]).sum(axis=1)
    return out

"""Refutation: which groups of links cannot be true, because robots are bodies."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import pairwise

import networkx as nx
import numpy as np

from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.node import MapId, NodeId
from mapweave.merge.mutual_exclusion.collision import Collision
from mapweave.merge.mutual_exclusion.exclusion import clash_of
from mapweave.merge.mutual_exclusion.trajectories import BodyTrajectory, TrajectoryCache
from mapweave.merge.pose_graph.component_solver import ComponentSolver
from mapweave.merge.pose_graph.fragments import Fragment, fragment_by_node
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.solved_graph import PoseGraph
from mapweave.merge.settings import ExclusionSettings

Key = tuple[NodeId, NodeId]
"""Names of two fragments, smaller first."""
SIGHT = 8.0
"""Robots further apart than this neither meet nor see each other, m."""


class Refutation:
    """Knows where every robot was when, as far as its clock is known."""

    def __init__(
        self,
        maps: Mapping[MapId, HybridMap],
        fragments: Sequence[Fragment],
        exclusion: ExclusionSettings,
        trajectories: TrajectoryCache | None = None,
    ) -> None:
        """Read the trails.

        Args:
            maps: with the nodes of all fragments.
            fragments: pieces of map.
            exclusion: when two robots clash.
            trajectories: kept from merges before.
        """
        self._by_node = fragment_by_node(fragments)
        self._exclusion = exclusion
        cache = trajectories or TrajectoryCache()
        trails = ((f.name, cache.trajectories(f, maps[f.name.map])) for f in fragments)
        self._trails: dict[NodeId, tuple[BodyTrajectory, ...]] = {name: some for name, some in trails if some}

    def verdict(self, story: Sequence[Link]) -> str:
        """Why links that agree with each other cannot be true; empty if they can, as far as anybody knows."""
        ends = {self._by_node[node].name: self._by_node[node] for link in story for node in link.pair}
        if len(ends.keys() & self._trails.keys()) < 2:
            return ""
        graph = ComponentSolver(list(ends.values())).solve(story)[0]
        return next((clash.reason for _, clash in self._clashes([graph])), "")

    def key_of(self, link: Link) -> Key:
        """Between which fragments a link is."""
        first, second = sorted(self._by_node[node].name for node in link.pair)
        return first, second

    def impossible(
        self,
        solved: Sequence[PoseGraph],
        kept: Sequence[Link],
        changed: Collection[NodeId] | None = None,
    ) -> dict[Key, str]:
        """Groups that must fall, with reasons.

        Where two pieces that clash are joined by links of their own, those are wrong: all other links between
        them agree with these. Where they are joined by way of other pieces, one group on the way is wrong,
        and the weakest is the likeliest.

        Args:
            solved: the components.
            kept: the links that made them.
            changed: fragments whose robots may clash with others since it was looked at last; None: all.
        """
        clashes = dict(self._clashes(solved, changed))
        if not clashes:
            return {}
        weights: dict[Key, int] = {}
        for link in kept:
            key = self.key_of(link)
            weights[key] = weights.get(key, 0) + link.weight
        direct = {key: clash.reason for key, clash in clashes.items() if key in weights}
        if direct:
            return direct
        (start, end), clash = min(clashes.items(), key=lambda item: (-item[1].evidence, item[0]))
        weakest = _weakest_on_the_way(weights, start, end)
        return {weakest: f"{clash.reason}, and these are the weakest links that join the two"}

    def _clashes(
        self, solved: Sequence[PoseGraph], changed: Collection[NodeId] | None = None
    ) -> Iterator[tuple[Key, Collision]]:
        """Pairs of fragments in one component that clash, by whichever clock says so most clearly."""
        for graph in solved:
            trails = [
                (name, trail) for name, some in self._trails.items() if name in graph.rows for trail in some
            ]
            found: dict[Key, list[Collision]] = {}
            for k, other in _near(graph, [trail for _, trail in trails]):
                (first, one), (second, two) = trails[k], trails[other]
                if first == second or (changed is not None and not {first, second} & set(changed)):
                    continue
                clash = clash_of(graph, one, two, self._exclusion)
                if clash is not None:
                    found.setdefault((first, second), []).append(clash)
            for key, clashes in found.items():
                yield key, max(clashes, key=lambda clash: clash.evidence)


def _near(graph: PoseGraph, trails: Sequence[BodyTrajectory]) -> Iterator[tuple[int, int]]:
    """Pairs of trails of different robots that overlap in time, by one clock, and come near each other.

    Of a thousand robots in a large building few ever meet, and to look closely takes long.
    """
    if not trails:
        return
    clocks = np.unique([trail.clock for trail in trails], return_inverse=True)[1]
    agents = np.unique([trail.agent for trail in trails], return_inverse=True)[1]
    times = np.array([(trail.times[0], trail.times[-1]) for trail in trails])
    places = [graph.means[graph.index(trail.nodes), :2] for trail in trails]
    low, high = np.array([(one.min(axis=0), one.max(axis=0)) for one in places]).transpose(1, 0, 2)
    for k in range(len(trails) - 1):
        rest = slice(k + 1, None)
        near = (clocks[rest] == clocks[k]) & (agents[rest] != agents[k])
        near &= (times[rest, 0] <= times[k, 1]) & (times[rest, 1] >= times[k, 0])
        near &= ((low[rest] <= high[k] + SIGHT) & (high[rest] >= low[k] - SIGHT)).all(axis=1)
        yield from ((k, k + 1 + other) for other in np.flatnonzero(near).tolist())


def _weakest_on_the_way(weights: Mapping[Key, int], start: NodeId, end: NodeId) -> Key:
    """The weakest pair on the best supported way from one fragment to another."""
    graph: nx.Graph = nx.Graph()
    for (first, second), weight in sorted(weights.items()):
        if first != second:
            graph.add_edge(first, second, weight=weight)
    tree = nx.maximum_spanning_tree(graph)
    way = nx.shortest_path(tree, start, end)
    steps = [(min(a, b), max(a, b)) for a, b in pairwise(way)]
    return min(steps, key=lambda key: (weights[key], key))

"""Refutation: which groups of links cannot be true, because robots exclude each other."""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import pairwise

import networkx as nx
import numpy as np

from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.merge.mutual_exclusion.collision import Collision
from mapweave.merge.mutual_exclusion.exclusion import collision_of
from mapweave.merge.mutual_exclusion.trajectories import RobotTrajectory, TrajectoryCache
from mapweave.merge.pose_graph.component_solver import ComponentSolver
from mapweave.merge.pose_graph.fragments import Fragment, fragment_by_node
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.solved_graph import PoseGraph
from mapweave.merge.settings import ExclusionSettings

Key = tuple[NodeId, NodeId]
"""Names of two fragments, smaller first."""
Pair = tuple[NodeId, NodeId]
REACH = 8.0
"""Robots further apart than this neither meet nor see each other, m."""


class Refutation:
    """Keeps the trajectories of all robots with known clocks."""

    def __init__(
        self,
        maps: Mapping[MapId, HybridMap],
        fragments: Sequence[Fragment],
        exclusion: ExclusionSettings,
        trajectories: TrajectoryCache | None = None,
    ) -> None:
        """Read the trajectories.

        Args:
            maps: with the nodes of all fragments.
            fragments: pieces of map.
            exclusion: when two robots collide.
            trajectories: kept from merges before.
        """
        self._by_node = fragment_by_node(fragments)
        self._exclusion = exclusion
        cache = trajectories or TrajectoryCache()
        by_fragment = ((f.name, cache.trajectories(f, maps[f.name.map])) for f in fragments)
        self._trajectories: dict[NodeId, tuple[RobotTrajectory, ...]] = {
            name: some for name, some in by_fragment if some
        }

    def verdict(self, links: Sequence[Link]) -> str:
        """Why links that agree with each other cannot be true; empty if they may be."""
        ends = {self._by_node[node].name: self._by_node[node] for link in links for node in link.pair}
        if len(ends.keys() & self._trajectories.keys()) < 2:
            return ""
        graph = ComponentSolver(list(ends.values())).solve(links)[0]
        return next((collision.reason for _, collision in self.collisions([graph])), "")

    def key_of(self, link: Link) -> Key:
        """Between which fragments a link is."""
        first, second = sorted(self._by_node[node].name for node in link.pair)
        return first, second

    def impossible(
        self,
        solved: Sequence[PoseGraph],
        kept: Sequence[Link],
        changed: Collection[NodeId] | None = None,
        certain: Collection[Pair] = (),
    ) -> tuple[dict[Key, str], dict[Pair, str]]:
        """Groups that must fall, with reasons; and links by hand that are contradicted and stay.

        Where two pieces that collide are joined by links of their own, those are wrong: all other links
        between them agree with these. Where they are joined by way of other pieces, one group on the way is
        wrong, and the weakest is the likeliest.

        Args:
            solved: the components.
            kept: the links that made them.
            changed: fragments whose robots may collide with others since the last test; None: all.
            certain: links by hand, which never fall, nor do others between the same two pieces.
        """
        collisions = dict(self.collisions(solved, changed))
        if not collisions:
            return {}, {}
        weights: dict[Key, float] = {}
        by_hand: dict[Key, list[Pair]] = {}
        for link in kept:
            key = self.key_of(link)
            if link.key in certain:
                by_hand.setdefault(key, []).append(link.key)
            weights[key] = weights.get(key, 0) + (math.inf if link.key in certain else link.weight)
        contradicted = {
            pair: collision.reason for key, collision in collisions.items() for pair in by_hand.get(key, ())
        }
        direct = {
            key: collision.reason for key, collision in collisions.items() if key in weights.keys() - by_hand
        }
        if direct:
            return direct, contradicted
        distant = {key: collision for key, collision in collisions.items() if key not in weights}
        for (start, end), collision in sorted(distant.items(), key=lambda item: (-item[1].evidence, item[0])):
            weakest = _weakest_on_the_way(weights, start, end)
            if weakest not in by_hand:
                words = f"{collision.reason}, and these are the weakest links that join the two"
                return {weakest: words}, contradicted
            contradicted |= dict.fromkeys(
                by_hand[weakest], f"{collision.reason}, and links by hand join the two"
            )
        return {}, contradicted

    def collisions(
        self, solved: Sequence[PoseGraph], changed: Collection[NodeId] | None = None
    ) -> Iterator[tuple[Key, Collision]]:
        """Pairs of fragments in one component that collide, by the clock with most evidence."""
        for graph in solved:
            trajectories = [
                (name, trajectory)
                for name, some in self._trajectories.items()
                if name in graph.rows
                for trajectory in some
            ]
            collisions: dict[Key, list[Collision]] = {}
            for k, j in _near(graph, [trajectory for _, trajectory in trajectories]):
                (first, first_trajectory), (second, second_trajectory) = trajectories[k], trajectories[j]
                if first == second or (changed is not None and not {first, second} & set(changed)):
                    continue
                collision = collision_of(graph, first_trajectory, second_trajectory, self._exclusion)
                if collision is not None:
                    collisions.setdefault((first, second), []).append(collision)
            for key, of_pair in collisions.items():
                yield key, max(of_pair, key=lambda collision: collision.evidence)


def _near(graph: PoseGraph, trajectories: Sequence[RobotTrajectory]) -> Iterator[tuple[int, int]]:
    """Pairs of trajectories of different robots that overlap in time, by one clock, and come near each other.

    Of a thousand robots in a large building few ever meet, and a full test is slow.
    """
    if not trajectories:
        return
    clocks = np.unique([trajectory.clock for trajectory in trajectories], return_inverse=True)[1]
    agents = np.unique([trajectory.agent for trajectory in trajectories], return_inverse=True)[1]
    times = np.array([(trajectory.times[0], trajectory.times[-1]) for trajectory in trajectories])
    places = [graph.means[graph.index(trajectory.nodes), :2] for trajectory in trajectories]
    low, high = np.array([(positions.min(axis=0), positions.max(axis=0)) for positions in places]).transpose(
        1, 0, 2
    )
    for k in range(len(trajectories) - 1):
        rest = slice(k + 1, None)
        overlapping = (clocks[rest] == clocks[k]) & (agents[rest] != agents[k])
        overlapping &= (times[rest, 0] <= times[k, 1]) & (times[rest, 1] >= times[k, 0])
        overlapping &= ((low[rest] <= high[k] + REACH) & (high[rest] >= low[k] - REACH)).all(axis=1)
        yield from ((k, k + 1 + offset) for offset in np.flatnonzero(overlapping).tolist())


def _weakest_on_the_way(weights: Mapping[Key, float], start: NodeId, end: NodeId) -> Key:
    """The weakest pair on the best supported way from one fragment to another."""
    graph: nx.Graph = nx.Graph()
    for (first, second), weight in sorted(weights.items()):
        if first != second:
            graph.add_edge(first, second, weight=weight)
    tree = nx.maximum_spanning_tree(graph)
    way = nx.shortest_path(tree, start, end)
    steps = [(min(a, b), max(a, b)) for a, b in pairwise(way)]
    return min(steps, key=lambda key: (weights[key], key))

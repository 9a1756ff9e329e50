"""A robot that drives through one hall every day, with and without marginalising what is superseded for long.

Which links are true is known: pruning joins nothing wrongly, and the nodes that stay are where the optimum of
all measurements of all days has them.
"""

import numpy as np
import pytest

from mapweave.hybridmap.change import NodeRetired
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import NodeId
from mapweave.merge.pose_graph.candidates import Pair
from mapweave.merge.pose_graph.component import Component, solve_graph
from mapweave.merge.pose_graph.factors import RelativePose
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.marginalization import LINKS, is_marginal, marginal_links
from mapweave.merge.pose_graph.merged_map import MergedMap
from tests.merge.test_days import Daily
from tests.quick import first_quick

KEPT = 2
"""Days for which superseded nodes are kept."""


class Pruned(Daily):
    """Nodes that are superseded for some days are marginalised."""

    def __init__(self, seed: int, false_share: float) -> None:
        super().__init__(seed, false_share)
        self.marginals: list[Link] = []
        self.true: set[Pair] = set()
        self.gone: set[NodeId] = set()
        self.past: list[frozenset[NodeId]] = []
        self.linked: list[set[Pair]] = []
        self.standing: set[Pair] = set()

    def day(self) -> MergedMap:
        """One more, and what is pruned after it."""
        today = self.drive()
        self.true |= today.true
        merged = self.merged()
        self.past.append(today.past)
        self.linked.append({link.pair for link in merged.links if not is_marginal(link)})
        held = set.intersection(*self.linked[-1 - KEPT :]) if len(self.linked) > KEPT else set[Pair]()
        due = self.past[-1 - KEPT] - self.gone if len(self.past) > KEPT else frozenset[NodeId]()
        due = due - {node for pair in self.linked[-1] - held for node in pair}
        for graph in merged.graphs:
            assert isinstance(graph, Component)
            removed = {node for node in graph.nodes[1:] if node in due}
            if removed:
                inside = [link for link in self.marginals if link.a in graph.rows]
                taken = self.linked[-1] - held - self.standing
                taken |= {refusal.pair for refusal in merged.refused if refusal.link is not None}
                left = marginal_links(graph, removed, inside, taken)
                others = [link for link in self.marginals if link not in inside]
                self.marginals = sorted([*others, *left], key=lambda link: link.pair)
                self.standing |= {pair for pair in held if pair[0] in graph.rows}
                self.prune(removed)
        return merged

    def prune(self, removed: set[NodeId]) -> None:
        self.gone |= removed
        for map_id in {node.map for node in removed}:
            hybrid_map = HybridMap(self.maps[map_id].contents())
            for node in removed & hybrid_map.nodes.keys():
                hybrid_map.apply(NodeRetired(node))
            self.maps[map_id] = hybrid_map
            self.touched.add(map_id)
        for pair in [pair for pair in self.links if not removed.isdisjoint(pair)]:
            del self.links[pair]
            self.verdicts.drop(pair)
        self.standing = {pair for pair in self.standing if removed.isdisjoint(pair)}
        self.islands.replace_marginals(self.marginals, self.standing)


def false_links(merged: MergedMap, true: set[Pair]) -> set[Pair]:
    return {link.pair for link in merged.links if not is_marginal(link)} - true


@pytest.mark.parametrize(
    ("seed", "false_share", "days"),
    first_quick([(70, 0.4, 5), (71, 0.4, 12), (72, 0.0, 12), (73, 0.2, 12), (74, 0.5, 12), (75, 0.6, 12)], 1),
)
def test_pruning_joins_nothing_wrongly(seed: int, false_share: float, days: int):
    pruned, whole = Pruned(seed, false_share), Daily(seed, false_share)
    for _ in range(days):
        pruned.day()
        full = whole.live(1)
    merged = pruned.merged()
    assert pruned.gone and len(merged.poses) == len(full.poses) - len(pruned.gone)
    assert len(pruned.marginals) < (LINKS + 1) * len(merged.poses)
    assert false_links(merged, pruned.true) <= false_links(full, pruned.true)
    assert len(merged.components) == len(full.components) == 1, "what is one without pruning is one with it"
    # The optimum of all measurements of all days, with the links that are known to be true.
    measured = [
        RelativePose(edge.a, edge.b, edge.a_from_b)
        for hybrid_map in whole.maps.values()
        for edge in hybrid_map.edges.values()
    ]
    measured += [whole.links[pair].measurement for pair in sorted(pruned.true)]
    graph, node = merged.graphs[0], merged.graphs[0].nodes[0]
    optimum = solve_graph(node, graph.pose(node), measured)
    off = [graph.pose(node).distance(optimum.pose(node)) for node in graph.nodes]
    assert max(off) < 0.03 and np.sqrt(np.mean(np.square(off))) < 0.015, (max(off), np.mean(off))

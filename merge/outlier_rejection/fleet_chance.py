"""What false places are like in a fleet, of which no one robot decides about the links of others.

The share of false places is measured on all pairs of maps that links connect, so that a robot with many wrong
maps raises it for all. Where the others have no false place among themselves, theirs is not raised.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence, Set
from dataclasses import dataclass

import networkx as nx

from mapweave.hybridmap.ids import MapId
from mapweave.merge.outlier_rejection.independent_support import ChanceSupport
from mapweave.merge.outlier_rejection.link_groups import LinkGroup
from mapweave.merge.outlier_rejection.pairwise_consistency import Sorted
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.settings import ConsistencySettings


@dataclass(frozen=True, eq=False)
class FleetChance:
    """Chance support on maps that links connect.

    Attributes:
        every: of all groups of links between pieces that differ.
        contradicted: the groups with false places.
    """

    every: ChanceSupport
    contradicted: Sequence[LinkGroup]

    @staticmethod
    def of(groups: Sequence[LinkGroup]) -> FleetChance:
        """Measure it on groups of links between pieces that differ."""
        return FleetChance(
            _support(groups), [group for group in groups if len(group.sorted.supports[0].others)]
        )

    def beyond(self, sorted_links: Sorted, own: Sequence[LinkGroup], s: ConsistencySettings) -> Sorted:
        """The links between two pieces that are beyond chance, with the reason for each other one.

        Args:
            sorted_links: between two pieces that differ.
            own: groups of links between these two: what chance does is read off all others.
            s: when links are accepted.
        """
        found = sorted_links.beyond_chance(self.every.without(_support(own)), s)
        if found.kept or not sorted_links.kept:
            return found
        ends = {node.agent for link in sorted_links.kept for node in link.pair}
        return sorted_links if self._all_at_one_robot(own, ends) else found

    def _all_at_one_robot(self, own: Sequence[LinkGroup], ends: Set[str]) -> bool:
        """Whether one robot, which is none of the ends, has a map in each pair with false places."""
        robots: set[str] | None = None
        for group in self.contradicted:
            if group not in own:
                at_group = _robots(group)
                robots = (at_group - ends) if robots is None else (robots & at_group)
                if not robots:
                    return False
        return robots is not None


def chance_by_map(groups: Iterable[LinkGroup], standing: Sequence[Link]) -> dict[MapId, FleetChance]:
    """Chance support for each map, measured on all maps that links connect with it, directly or not."""
    ties: nx.Graph = nx.Graph(link.maps for link in standing)
    groups = list(groups)
    ties.add_edges_from((group.first.name.map, group.second.name.map) for group in groups)
    out: dict[MapId, FleetChance] = {}
    for island in nx.connected_components(ties):
        between = [g for g in groups if g.first is not g.second and g.first.name.map in island]
        out |= dict.fromkeys(island, FleetChance.of(between))
    return out


def _support(groups: Iterable[LinkGroup]) -> ChanceSupport:
    return ChanceSupport.of(group.sorted.supports[0] for group in groups)


def _robots(group: LinkGroup) -> set[str]:
    return {which.agent for piece in (group.first, group.second) for which in piece.graph.maps}

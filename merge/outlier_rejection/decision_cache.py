"""What a merge has found out that the next one need not find out again.

Everything kept here depends on nothing but what it is kept with, compared by identity: maps, fragments and
links are never changed, only replaced. So a merge with a cache is the merge without one.
"""

from collections.abc import Mapping, Sequence

from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.merge.outlier_rejection.link_groups import LinkGroup, Verdict
from mapweave.merge.outlier_rejection.pairwise_consistency import group_links
from mapweave.merge.outlier_rejection.segmentation import fragments_of
from mapweave.merge.pose_graph.fragments import Fragment
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.settings import ConsistencySettings

Key = tuple[NodeId, NodeId]
"""Names of two fragments, or two nodes, smaller first."""


class DecisionCache:
    """Fragments by map, and sorted groups of links by fragments. For merges with the same settings."""

    def __init__(self) -> None:
        self._maps: dict[MapId, tuple[HybridMap, list[Fragment]]] = {}
        self._groups: dict[Key, LinkGroup] = {}
        self._weighed: dict[Key, tuple[Link, Link]] = {}

    def forget_others(self, maps: Mapping[MapId, HybridMap]) -> None:
        """Forget the fragments of all maps but these, as they are."""
        self._maps = {which: entry for which, entry in self._maps.items() if maps.get(which) is entry[0]}

    def fragments(self, maps: Mapping[MapId, HybridMap], s: ConsistencySettings) -> list[Fragment]:
        """See `mapweave.merge.outlier_rejection.segmentation.fragments_of`; only maps that have changed are
        cut.
        """
        all_fragments: list[Fragment] = []
        for map_id, hybrid_map in maps.items():
            entry = self._maps.get(map_id)
            if entry is None or entry[0] is not hybrid_map:
                entry = self._maps[map_id] = hybrid_map, fragments_of({map_id: hybrid_map}, s)
            all_fragments += entry[1]
        return sorted(all_fragments, key=lambda fragment: fragment.name)

    def weighed(self, links: Sequence[Link], weighed: Sequence[Link]) -> list[Link]:
        """Links as they were weighed now; one that has the weight it had before is the same object as before.

        Args:
            links: as they were verified.
            weighed: the same by `mapweave.merge.outlier_rejection.distinctness.weigh`, in the same order.
        """
        weighed_links = []
        for link, now in zip(links, weighed, strict=True):
            if now is not link:
                before = self._weighed.get(link.pair)
                if before is None or before[0] is not link or before[1].aliased != now.aliased:
                    before = self._weighed[link.pair] = link, now
                now = before[1]
            weighed_links.append(now)
        return weighed_links

    def groups(
        self,
        links: Sequence[Link],
        by_node: Mapping[NodeId, Fragment],
        s: ConsistencySettings,
        verdict: Verdict,
        exact: bool = True,
    ) -> dict[Key, LinkGroup]:
        """See `LinkGroup.of`; links between two fragments are sorted again only if any of them is new.

        Args:
            links: each once.
            by_node: the fragment of each node.
            s: when links are accepted.
            verdict: on sets with equal support; it depends on the two fragments alone.
            exact: also if either fragment has changed elsewhere.

        Returns:
            By the names of the fragments.
        """
        out = {}
        for (a, b), some in group_links(links, by_node).items():
            first, second = by_node[a], by_node[b]
            entry = self._groups.get((a, b))
            same = entry is not None and entry.first is first and entry.second is second
            if entry is None or not (same or not exact) or not _same(entry.given, some):
                entry = self._groups[a, b] = LinkGroup.of(some, first, second, s, verdict)
            out[a, b] = entry
        return out


def _same(first: Sequence[Link], second: Sequence[Link]) -> bool:
    return len(first) == len(second) and all(a is b for a, b in zip(first, second, strict=True))

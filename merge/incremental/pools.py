"""Links between the components of a large merge, pooled and sorted: which components are joined next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from hybridmap.node import MapId
from merge.belief.agglomeration import best_supported, joined
from merge.belief.consistency import Sorted, sort_links
from merge.belief.groups import LinkGroup
from merge.belief.witnesses import FalseWitnesses
from merge.graph.fragments import Fragment
from merge.incremental.factors import Rows
from merge.incremental.graph import WideGraph
from merge.incremental.sheets import Assembly, MapPair, Sheet
from merge.incremental.waiting import Labels, Waiting
from merge.merging import MergeSettings

MOST_POOLED = 40
"""Links between two components that are sorted together, the best supported ones; the others are tested
against what these join."""


class Pools:
    """Sorts as little as it takes to know what is joined next.

    A set of links that nothing has come to is ranked by what was found of it before, even if the components
    have grown elsewhere; only before it joins them is it sorted once more. A set that others have come to
    weighs no more than its parts together: as long as that is not the most, nobody has to know.
    """

    def __init__(
        self,
        settings: MergeSettings,
        sheets: Mapping[MapId, Sheet],
        groups: Mapping[MapPair, list[LinkGroup]],
        waiting: Waiting,
    ) -> None:
        """Take what waits.

        Args:
            settings: of the merge.
            sheets: of the island.
            groups: sorted links by maps.
            waiting: links.
        """
        self._settings = settings
        self._sheets = sheets
        self._groups = groups
        self._waiting = waiting
        self._found: dict[bytes, Sorted] = {}
        # Of each link, the set that it was sorted in last, and how much that weighs at most.
        self._sets = np.full(len(waiting.links), -1, np.int64)
        self._weights = waiting.weights.astype(np.float64)

    def next(
        self,
        pools: Mapping[Labels, Rows],
        whole: Assembly,
        graphs: dict[int, WideGraph],
        own: Mapping[Labels, Sequence[Sorted]],
        heard: FalseWitnesses,
    ) -> tuple[dict[Labels, Sorted], list[Sorted]]:
        """What is joined in this round, and all that was sorted for it.

        Args:
            pools: numbers of the links between each two components.
            whole: the graph as it is.
            graphs: components by label; those that are made are put there.
            own: sorted groups of the maps by the two components that they are between.
            heard: what false witnesses are like.
        """
        known = {labels: self._found.get(some.tobytes()) for labels, some in pools.items()}
        most = {labels: self._at_most(some) for labels, some in pools.items() if known[labels] is None}
        fresh: dict[Labels, Sorted] = {}
        while True:
            weights = {
                labels: most[labels] if found is None else found.weight
                for labels, found in known.items()
                if found is None or found.kept
            }
            wanted = {labels for labels in best_supported(weights).values() if known[labels] is None}
            if not wanted:
                chosen = joined(weights, known)
                wanted = {labels for labels in chosen if labels not in fresh}
                if not wanted:
                    return {labels: fresh[labels] for labels in chosen}, list(fresh.values())
            for labels in sorted(wanted):
                found = self._sorted(whole, labels, pools[labels], graphs)
                others = heard.without(FalseWitnesses.of(one.supports[0] for one in own.get(labels, ())))
                found = found.beyond_chance(others, self._settings.consistency)
                known[labels] = fresh[labels] = found
                self._keep(pools[labels], found)

    def _keep(self, some: Rows, found: Sorted) -> None:
        self._found[some.tobytes()] = found
        self._sets[some], self._weights[some] = some[0], found.weight

    def _at_most(self, some: Rows) -> float:
        """How much a pool can weigh: the best of it was in the best of the sets that came together."""
        sets = self._sets[some]
        parts = np.unique(sets[sets >= 0], return_index=True)[1]
        before = self._weights[some[sets >= 0]][parts].sum() + self._weights[some[sets < 0]].sum()
        best = np.sort(self._waiting.weights[some])[::-1][:MOST_POOLED].sum()
        return float(min(before, best))

    def _sorted(self, whole: Assembly, labels: Labels, some: Rows, graphs: dict[int, WideGraph]) -> Sorted:
        links = [self._waiting.links[k] for k in some.tolist()]
        links = [link if whole.label(link.a) == labels[0] else link.turned() for link in links]
        pieces = []
        for label, end in zip(labels, links[0].pair, strict=True):
            if label not in graphs:
                graphs[label] = whole.graph(label, self._settings.huber)
            graph = graphs[label]
            own = next((f for f in self._sheets[end.map].fragments if f.name == graph.anchor), None)
            # A piece that nothing is joined to yet knows more of itself.
            alone = own is not None and len(own) == len(graph.nodes)
            pieces.append(own if own is not None and alone else Fragment(graph.anchor, graph, ()))
        first, second = links[0].canonical().pair
        for group in self._groups.get((first.map, second.map), ()):
            if {id(group.first), id(group.second)} == {id(piece) for piece in pieces}:
                return group.sorted
        best = sorted(links, key=lambda link: (-link.weight, link.pair))[:MOST_POOLED]
        return sort_links(best, pieces[0], pieces[1], self._settings.consistency)

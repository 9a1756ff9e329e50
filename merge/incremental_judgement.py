"""One round of believing links in a large merge: within components, and between them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from hybridmap.node import MapId, NodeId
from hybridmap.pose import Pose2
from merge.agglomeration import CONTRADICTION
from merge.candidates import Pair
from merge.consistency import Sorted, group_links, sort_links
from merge.credence import standpoints
from merge.fragments import Fragment, fragment_by_node
from merge.groups import LinkGroup
from merge.incremental_graph import WideGraph
from merge.incremental_memory import Memory
from merge.incremental_sheets import Assembly, MapPair, Sheet
from merge.joining import Solver, misfits
from merge.links import Link
from merge.merging import MergeSettings
from merge.refutation import Refutation
from merge.witnesses import FalseWitnesses

MOST_POOLED = 40
"""Links between two components that are sorted together, the best supported ones; the others are tested
against what these join."""
Join = tuple[NodeId, NodeId, Pose2]
"""A node of one component, a node of another one, and the posture of the second in the first."""


class Judge:
    """Says which links of one step are believed."""

    def __init__(
        self,
        settings: MergeSettings,
        memory: Memory,
        sheets: Mapping[MapId, Sheet],
        groups: dict[MapPair, list[LinkGroup]],
    ) -> None:
        """Take what stands.

        Args:
            settings: of the merge.
            memory: of merges with the same settings.
            sheets: of the island.
            groups: sorted links by maps, as they were judged last; those that are judged now are put there.
        """
        self._settings = settings
        self._memory = memory
        self._sheets = sheets
        self._groups = groups
        self._now: set[MapPair] = set()

    def round(
        self,
        whole: Assembly,
        standing: Mapping[MapPair, tuple[Mapping[Pair, Link], Mapping[Pair, Link]]],
        waiting: Mapping[MapPair, Mapping[Pair, Link]],
        last: bool,
    ) -> tuple[list[Link], list[tuple[Link, str]], list[Join]]:
        """One round.

        Args:
            whole: the graph as it is.
            standing: of maps between which links are to be judged: those believed, and those that wait.
            waiting: all that wait.
            last: whether loops that contradict their map's own way are heard once more.

        Returns:
            Links to believe; links that are not, with reasons; and which components they join how.
        """
        inside: dict[int, list[Link]] = {}
        across: set[tuple[int, int]] = set()
        agreed: set[Pair] = set()
        own: set[Pair] = set()
        reasons: dict[Pair, str] = {}
        loops: set[Pair] = set()
        for maps, (believed, open_) in standing.items():
            self._sort(maps, {**believed, **open_})
        heard = self._heard()
        for maps, (_, open_) in standing.items():
            for group in self._groups.get(maps, ()):
                found = group.sorted
                if group.first is group.second:
                    own |= {link.canonical().pair for link in found.kept}
                    loops |= {link.canonical().pair for link in group.links}
                else:
                    agreed |= {link.canonical().pair for link in self._likely(found, [found], heard).kept}
                reasons |= {r.pair: r.reason for r in group.refused}
            for link in open_.values():
                a, b = whole.label(link.a), whole.label(link.b)
                if a == b:
                    inside.setdefault(a, []).append(link)
                else:
                    across.add((min(a, b), max(a, b)))
        graphs: dict[int, WideGraph] = {}
        kept = [link for links in inside.values() for link in links if link.pair in own]
        refused: list[tuple[Link, str]] = []
        for label, links in inside.items():
            graph = graphs[label] = whole.graph(label, self._settings.huber)
            asked = [link for link in links if link.pair not in own and (last or link.pair not in loops)]
            refused += [(link, reasons.get(link.pair, CONTRADICTION)) for link in links if link not in asked]
            for link, good in zip(asked, self._borne_out(asked, graph, agreed, heard), strict=True):
                if good:
                    kept.append(link)
                else:
                    refused.append((link, reasons.get(link.pair, CONTRADICTION)))
        pools = self._pools(whole, across, waiting)
        between = self._between(whole) if pools else {}
        joins: list[Join] = []
        sorted_pools: dict[tuple[int, int], Sorted] = {}
        for labels, links in pools.items():
            found_pool = self._pooled(whole, labels, links, graphs)
            found_pool = sorted_pools[labels] = self._likely(found_pool, between.get(labels, []), heard)
            refused += [(r.link, reasons.get(r.pair, r.reason)) for r in found_pool.refused if r.link]
        for labels in _best(sorted_pools):
            links = [link.canonical() for link in sorted_pools[labels].kept]
            kept += links
            best = min(links, key=lambda link: (-link.weight, link.pair))
            joins.append((best.a, best.b, best.a_from_b.mean))
        told = {link.pair for link in kept}
        return kept, [(link, reason) for link, reason in refused if link.pair not in told], joins

    def _heard(self) -> FalseWitnesses:
        """What false witnesses are like, see `merge.agglomeration`."""
        found = (group for groups in self._groups.values() for group in groups)
        return FalseWitnesses.of(g.sorted.supports[0] for g in found if g.first is not g.second)

    def _likely(self, found: Sorted, own: Sequence[Sorted], heard: FalseWitnesses) -> Sorted:
        """What chance does is read off all pieces but the two that are judged."""
        others = heard.without(FalseWitnesses.of(one.supports[0] for one in own))
        return found.beyond_chance(others, self._settings.consistency)

    def _between(self, whole: Assembly) -> dict[tuple[int, int], list[Sorted]]:
        """Sorted groups by the two components that they are between."""
        out: dict[tuple[int, int], list[Sorted]] = {}
        for groups in self._groups.values():
            for group in groups:
                if group.first is not group.second:
                    a, b = whole.label(group.first.name), whole.label(group.second.name)
                    out.setdefault((min(a, b), max(a, b)), []).append(group.sorted)
        return out

    def _sort(self, maps: MapPair, links: Mapping[Pair, Link]) -> None:
        """Sort links between two maps by the pieces of these that they join; once a step."""
        if maps in self._now:
            return
        self._now.add(maps)
        s = self._settings
        some = sorted(set(maps))
        pieces = [piece for one in some for piece in self._sheets[one].fragments]
        by_node = fragment_by_node(pieces)
        whole = {one: self._sheets[one].one for one in some}
        refutation = Refutation(whole, Solver(pieces), s.consistency, s.exclusion)
        given = list(links.values())
        self._groups[maps] = [
            self._memory.group(
                group,
                [links[link.canonical().pair] for link in group],
                by_node[first],
                by_node[second],
                s.consistency,
                refutation.verdict,
            )
            for (first, second), group in group_links(given, by_node).items()
        ]

    def _borne_out(
        self, links: Sequence[Link], graph: WideGraph, agreed: set[Pair], heard: FalseWitnesses
    ) -> list[bool]:
        """As `merge.agglomeration` tests links within a piece."""
        if not links:
            return []
        s = self._settings.consistency
        fits = misfits(links, graph, s) < s.gate
        known = standpoints(links, graph, kept=False)
        if not s.cliques:
            return [True for _ in links]
        least = max(0.0, s.least_evidence - heard.log_odds)
        return [
            bool(found.log_factor > least or (good and link.pair in agreed))
            for link, good, found in zip(links, fits, known, strict=True)
        ]

    def _pools(
        self,
        whole: Assembly,
        across: set[tuple[int, int]],
        waiting: Mapping[MapPair, Mapping[Pair, Link]],
    ) -> dict[tuple[int, int], list[Link]]:
        """All links that wait between components, from the smaller label to the greater."""
        pools: dict[tuple[int, int], list[Link]] = {}
        for link in (link for links in waiting.values() for link in links.values()) if across else ():
            a, b = whole.label(link.a), whole.label(link.b)
            labels = min(a, b), max(a, b)
            if labels in across:
                pools.setdefault(labels, []).append(link if a < b else link.turned())
        return pools

    def _pooled(
        self, whole: Assembly, labels: tuple[int, int], links: list[Link], graphs: dict[int, WideGraph]
    ) -> Sorted:
        for label in labels:
            if label not in graphs:
                graphs[label] = whole.graph(label, self._settings.huber)
        pieces = []
        for label, end in zip(labels, (links[0].a, links[0].b), strict=True):
            graph = graphs[label]
            own = next((f for f in self._sheets[end.map].fragments if f.name == graph.anchor), None)
            # A piece that nothing is joined to yet knows more of itself.
            alone = own is not None and len(own) == len(graph.nodes)
            pieces.append(own if own is not None and alone else Fragment(graph.anchor, graph, ()))
        maps = min(links[0].canonical().pair)[:2], max(links[0].canonical().pair)[:2]
        for group in self._groups.get((MapId(*maps[0]), MapId(*maps[1])), ()):
            if {id(group.first), id(group.second)} == {id(piece) for piece in pieces}:
                return group.sorted
        best = sorted(links, key=lambda link: (-link.weight, link.pair))[:MOST_POOLED]
        return sort_links(best, pieces[0], pieces[1], self._settings.consistency)


def _best(pools: Mapping[tuple[int, int], Sorted]) -> list[tuple[int, int]]:
    """Which components are joined in this round: those of which each is the other's best supported one."""
    ranked = [
        labels for labels, found in sorted(pools.items(), key=lambda x: (-x[1].weight, x[0])) if found.kept
    ]
    best: dict[int, tuple[int, int]] = {}
    for labels in ranked:
        for label in labels:
            best.setdefault(label, labels)
    return [labels for labels in ranked if best[labels[0]] == best[labels[1]] == labels]

"""What is made of the links of a large island: each is believed, or waits, or is refused."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Set
from dataclasses import replace

from hybridmap.node import MapId, NodeId
from hybridmap.ruling import Rulings, reason_of
from merge.belief.consistency import ConsistencySettings
from merge.belief.distinctness import weigh
from merge.graph.candidates import Pair
from merge.graph.fragments import fragment_by_node
from merge.graph.links import Link, RefusedLink, refuse
from merge.graph.merged import MergedMap
from merge.incremental.sheets import Bundle, MapPair, Sheet
from merge.incremental.verdicts import Verdicts

PAST = "others stand for a node of it since another day: it is heard again when all is decided again"


class Ledger:
    """Links by the maps that they lie between. A link is believed or waits; why it waits may be told.

    Attributes:
        bundles: the links that are believed.
        waiting: those that are not.
        refused: why not, and pairs that never were links.
    """

    def __init__(self, sheets: Mapping[MapId, Sheet], settings: ConsistencySettings) -> None:
        """No links yet.

        Args:
            sheets: of the island's maps, as they are at present.
            settings: when links are believed.
        """
        self._sheets = sheets
        self._settings = settings
        self.bundles: dict[MapPair, Bundle] = {}
        self.waiting: dict[MapPair, dict[Pair, Link]] = {}
        self.refused: dict[MapPair, dict[Pair, RefusedLink]] = {}
        self._past: Set[NodeId] = frozenset()
        self._labels: Mapping[NodeId, int] = {}
        self._links: dict[Pair, tuple[Link, Link]] = {}
        self._fallen: dict[Pair, tuple[Link, str]] = {}

    @property
    def known(self) -> set[MapPair]:
        """Maps between which there are links."""
        return {*self.bundles, *self.waiting}

    @property
    def fallen(self) -> list[Link]:
        """Links that are refused as long as they are seen as they are."""
        return [link for link, _ in self._fallen.values()]

    def believed(self, maps: MapPair) -> Mapping[Pair, Link]:
        """The links between two maps that are believed."""
        return self.bundles[maps].links if maps in self.bundles else {}

    def begin(self, merged: MergedMap, verdicts: Verdicts) -> None:
        """Take over what was believed otherwise, as far as both maps are there."""
        links: dict[MapPair, dict[Pair, Link]] = {}
        for link in merged.links:
            maps = link.a.map, link.b.map
            given = verdicts.between(maps).get(link.pair)
            if isinstance(given, Link) and maps[0] in self._sheets and maps[1] in self._sheets:
                weighed = replace(given, evidence=link.evidence)
                self._links[link.pair] = given, weighed
                links.setdefault(maps, {})[link.pair] = weighed
        for maps, here in links.items():
            self._believe(maps, here)

    def resume(self, believed: Iterable[Pair], verdicts: Verdicts) -> None:
        """Believe these links, as far as they are verified and both maps are there."""
        links: dict[MapPair, dict[Pair, Link]] = {}
        for pair in sorted(believed):
            maps = pair[0].map, pair[1].map
            given = verdicts.between(maps).get(pair)
            if isinstance(given, Link) and maps[0] in self._sheets and maps[1] in self._sheets:
                self._links[pair] = given, given
                links.setdefault(maps, {})[pair] = given
        for maps, here in links.items():
            self._believe(maps, here)

    def hold(self, past: Set[NodeId], labels: Mapping[NodeId, int]) -> None:
        """Let stand what was decided of links at these nodes, believed or not, within a component.

        Those between components wait all the same: they may be what joins them one day.

        Args:
            past: nodes of another day for which others stand.
            labels: which component each node is in.
        """
        self._past, self._labels = past, labels

    def stands(self, pair: Pair) -> bool:
        """Whether what was decided of a link stands."""
        if self._past.isdisjoint(pair):
            return False
        first, second = (self._labels.get(node) for node in pair)
        return first is not None and first == second

    def forget(self, maps: MapPair) -> None:
        """Maps that are in one island no longer."""
        for known in (self.bundles, self.waiting, self.refused):
            known.pop(maps, None)

    def weigh(self, between: Iterable[MapPair], verdicts: Verdicts) -> None:
        """Find landmarks that there are twice by the links between some maps; what is known already stays."""
        pairs = sorted(between)
        some = sorted({one for pair in pairs for one in pair})
        by_node = fragment_by_node([piece for one in some for piece in self._sheets[one].fragments])
        found = [v for pair in pairs for v in verdicts.between(pair).values() if isinstance(v, Link)]
        found = [link for link in found if link.a in by_node and link.b in by_node]
        whole = {one: self._sheets[one].one for one in some}
        for link, weighed in zip(found, weigh(found, by_node, whole, self._settings), strict=True):
            known = self._links.get(link.pair)
            if known is None or known[0] is not link or known[1].doubles < weighed.doubles:
                self._links[link.pair] = link, weighed

    def review(self, maps: MapPair, verdicts: Verdicts, rulings: Rulings) -> set[Pair]:
        """Which links between two maps may be believed: those that are new wait, those that are gone go.

        Returns:
            Those that were believed and are gone.
        """
        first, second = self._sheets[maps[0]], self._sheets[maps[1]]
        refused: dict[Pair, RefusedLink] = {}
        waiting: dict[Pair, Link] = {}
        before = self.refused.get(maps, {})
        believed = self.believed(maps)
        kept: dict[Pair, Link] = {}
        for pair, verdict in verdicts.between(maps).items():
            if pair[0] not in first.rows or pair[1] not in second.rows:
                continue
            fallen = self._fallen.get(pair)
            ruling = rulings.against(*pair)
            if isinstance(verdict, RefusedLink):
                refused[pair] = verdict
            elif ruling is not None:
                refused[pair] = refuse(verdict, reason_of(ruling))
            elif fallen is not None and fallen[0] is verdict:
                refused[pair] = refuse(verdict, fallen[1])
            elif pair in believed and believed[pair].a_from_b is verdict.a_from_b:
                kept[pair] = self._links[pair][1]
            elif self.stands(pair):
                refused[pair] = before[pair] if pair in before else refuse(verdict, PAST)
            else:
                waiting[pair] = self._links[pair][1]
        lost = set(believed.keys() - kept.keys())
        self._believe(maps, kept)
        told = {pair: known for pair, known in before.items() if pair in waiting}
        self.waiting[maps], self.refused[maps] = waiting, {**told, **refused}
        return lost

    def doubt_all(self) -> set[MapPair]:
        """Forget what was decided, one link after the other: all shall be weighed and reviewed again.

        What is held stands.

        Returns:
            Maps between which anything is doubted.
        """
        known = set(self.waiting)
        if not self._past:
            for one in (self._fallen, self.bundles, self.refused, self._links):
                one.clear()
            return known
        self._fallen = {pair: why for pair, why in self._fallen.items() if self.stands(pair)}
        doubted = set()
        for maps in known:
            links = self.believed(maps)
            stands = {pair: link for pair, link in links.items() if self.stands(pair)}
            told = {pair: why for pair, why in self.refused.get(maps, {}).items() if self.stands(pair)}
            if self.waiting[maps] or len(stands) < len(links) or len(told) < len(self.refused.get(maps, {})):
                doubted.add(maps)
                self._believe(maps, stands)
                self.refused[maps] = told
        return doubted

    def tell(self, refused: Iterable[tuple[Link, str]]) -> None:
        """Take note of why links wait."""
        for link, reason in refused:
            self.refused.setdefault((link.a.map, link.b.map), {})[link.pair] = refuse(link, reason)

    def accept(self, links: Iterable[Link]) -> int:
        """Believe links that wait; how many they are."""
        by_maps: dict[MapPair, list[Pair]] = {}
        for link in links:
            by_maps.setdefault((link.a.map, link.b.map), []).append(link.pair)
        for maps, more in by_maps.items():
            waiting = self.waiting[maps]
            self._believe(maps, {**self.believed(maps), **{pair: waiting[pair] for pair in more}})
            for pair in more:
                waiting.pop(pair, None)
                self.refused[maps].pop(pair, None)
        return sum(map(len, by_maps.values()))

    def disbelieve(self, links: Iterable[Link], reason: str, for_good: bool = False) -> None:
        """Let links that were believed wait, or refuse them as long as they are seen as they are."""
        for link in links:
            maps = link.a.map, link.b.map
            self._believe(maps, {p: one for p, one in self.bundles[maps].links.items() if p != link.pair})
            self.waiting.setdefault(maps, {})[link.pair] = link
            self.refused.setdefault(maps, {})[link.pair] = refuse(link, reason)
            if for_good:
                self._fallen[link.pair] = self._links[link.pair][0], reason

    def _believe(self, maps: MapPair, links: Mapping[Pair, Link]) -> None:
        if links:
            self.bundles[maps] = Bundle.of(links, self._sheets[maps[0]], self._sheets[maps[1]])
        else:
            self.bundles.pop(maps, None)


def ends_of(pairs: Iterable[Pair]) -> set[NodeId]:
    """The nodes of some pairs."""
    return {node for pair in pairs for node in pair}

"""One round of believing links in a large merge: within components, and between them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from hybridmap.node import MapId, NodeId
from hybridmap.pose import Pose2
from merge.belief.agglomeration import CONTRADICTION, borne_out
from merge.belief.consistency import Sorted, group_links
from merge.belief.groups import LinkGroup
from merge.belief.joining import Solver
from merge.belief.memory import Memory
from merge.belief.witnesses import FalseWitnesses
from merge.bodies.refutation import Refutation
from merge.graph.candidates import Pair
from merge.graph.fragments import fragment_by_node
from merge.graph.links import Link
from merge.incremental.factors import Rows
from merge.incremental.graph import WideGraph
from merge.incremental.pools import Pools
from merge.incremental.sheets import Assembly, MapPair, Sheet
from merge.incremental.waiting import Labels, Waiting
from merge.merging import MergeSettings

Join = tuple[NodeId, NodeId, Pose2]
"""A node of one component, a node of another one, and the posture of the second in the first."""


class Judge:
    """Says which links of one step are believed.

    Attributes:
        agreed: links that agree with others of their maps beyond chance: if they are not believed, something
            contradicts them.
    """

    def __init__(
        self,
        settings: MergeSettings,
        memory: Memory,
        sheets: Mapping[MapId, Sheet],
        groups: dict[MapPair, list[LinkGroup]],
        waiting: Waiting,
    ) -> None:
        """Take what stands.

        Args:
            settings: of the merge.
            memory: of merges with the same settings.
            sheets: of the island.
            groups: sorted links by maps, as they were judged last; those that are judged now are put there.
            waiting: links that are not believed yet.
        """
        self.agreed: set[Pair] = set()
        self._settings = settings
        self._memory = memory
        self._sheets = sheets
        self._groups = groups
        self._waiting = waiting
        self._pools = Pools(settings, sheets, groups, waiting)
        self._now: set[MapPair] = set()
        # What is told of groups changes with them, and with what false witnesses are like.
        self._heard: FalseWitnesses | None = None
        self._between: tuple[Rows, Rows, list[Sorted]] = (np.zeros(0, np.int64), np.zeros(0, np.int64), [])
        self._told: dict[MapPair, tuple[set[Pair], set[Pair], set[Pair]]] = {}
        self._reasons: dict[Pair, str] = {}

    def sort(self, maps: MapPair, links: Mapping[Pair, Link]) -> None:
        """Sort links between two maps by the pieces of these that they join."""
        self._now.add(maps)
        self._heard = None
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
        self._reasons |= {r.pair: r.reason for group in self._groups[maps] for r in group.refused}

    def unsorted(self, between: Iterable[MapPair]) -> list[MapPair]:
        """Maps between which links are not sorted in this step yet."""
        return sorted(set(between) - self._now)

    def round(
        self, whole: Assembly, between: set[MapPair], last: bool
    ) -> tuple[list[Link], list[tuple[Link, str]], list[Join]]:
        """One round.

        Args:
            whole: the graph as it is.
            between: maps between which links are to be judged; they are sorted.
            last: whether loops that contradict their map's own way are heard once more.

        Returns:
            Links to believe; links that are not, with reasons; and which components they join how.
        """
        heard = self._listen(whole)
        agreed: set[Pair] = set()
        own: set[Pair] = set()
        loops: set[Pair] = set()
        for maps in between:
            for every, some in zip((agreed, own, loops), self._tell(maps, heard), strict=True):
                every |= some
        self.agreed |= agreed
        inside = self._waiting.inside(between, whole)
        graphs: dict[int, WideGraph] = {}
        kept = [link for links in inside.values() for link in links if link.pair in own]
        refused: list[tuple[Link, str]] = []
        s = self._settings.consistency
        least = max(0.0, s.least_evidence - heard.log_odds)
        for label, links in inside.items():
            asked: list[Link] = []
            passed: list[Link] = []
            for link in links:
                if link.pair not in own:
                    (asked if last or link.pair not in loops else passed).append(link)
            if asked:
                graphs[label] = whole.graph(label, self._settings.huber)
                good = borne_out(asked, graphs[label], agreed, least, s)
                kept += [link for link, yes in zip(asked, good, strict=True) if yes]
                passed += [link for link, yes in zip(asked, good, strict=True) if not yes]
            refused += [(link, self._reasons.get(link.pair, CONTRADICTION)) for link in passed]
        pools = self._waiting.pools(between, whole)
        chosen, found = self._pools.next(pools, whole, graphs, self._groups_between(whole), heard)
        for one in found:
            refused += [(r.link, self._reasons.get(r.pair, r.reason)) for r in one.refused if r.link]
        joins: list[Join] = []
        for one in chosen.values():
            links = [link.canonical() for link in one.kept]
            kept += links
            best = min(links, key=lambda link: (-link.weight, link.pair))
            joins.append((best.a, best.b, best.a_from_b.mean))
        told = {link.pair for link in kept}
        return kept, [(link, reason) for link, reason in refused if link.pair not in told], joins

    def _listen(self, whole: Assembly) -> FalseWitnesses:
        """What false witnesses are like, see `merge.belief.agglomeration`."""
        if self._heard is None:
            groups = [g for some in self._groups.values() for g in some if g.first is not g.second]
            self._heard = FalseWitnesses.of(group.sorted.supports[0] for group in groups)
            # A piece that was sorted may have lost nodes since, or be gone.
            ends = [[whole.one_of(piece.nodes) for piece in (g.first, g.second)] for g in groups]
            here = [k for k, (a, b) in enumerate(ends) if a is not None and b is not None]
            first, second = np.array([ends[k] for k in here], np.int64).reshape(-1, 2).T
            self._between = first, second, [groups[k].sorted for k in here]
            self._told = {}
        return self._heard

    def _tell(self, maps: MapPair, heard: FalseWitnesses) -> tuple[set[Pair], set[Pair], set[Pair]]:
        """Links between two maps that agree with others of theirs; loops that do; and all loops."""
        if maps not in self._told:
            agreed: set[Pair] = set()
            own: set[Pair] = set()
            loops: set[Pair] = set()
            for group in self._groups.get(maps, ()):
                found = group.sorted
                if group.first is group.second:
                    own |= {link.canonical().pair for link in found.kept}
                    loops |= {link.canonical().pair for link in group.links}
                else:
                    others = heard.without(FalseWitnesses.of([found.supports[0]]))
                    likely = found.beyond_chance(others, self._settings.consistency)
                    agreed |= {link.canonical().pair for link in likely.kept}
            self._told[maps] = agreed, own, loops
        return self._told[maps]

    def _groups_between(self, whole: Assembly) -> dict[Labels, Sequence[Sorted]]:
        """Sorted groups by the two components that they are between."""
        out: dict[Labels, list[Sorted]] = {}
        first, second, groups = self._between
        for a, b, found in zip(
            whole.labels[first].tolist(), whole.labels[second].tolist(), groups, strict=True
        ):
            if a != b:
                out.setdefault((min(a, b), max(a, b)), []).append(found)
        return dict(out)

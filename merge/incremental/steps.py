"""A large island merged step by step: what was decided stands until something touches it.

A new node lies where its edges put it. A new link within a component is tested against it, as
`merge.belief.agglomeration` does; between components all links are sorted together, and pieces are joined of
which each is the other's best supported one. Then the neighbourhood of what is new is optimised, further and
further out until nothing moves at the rim. Now and then everything is.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Set
from dataclasses import replace

import numpy as np

from hybridmap.hybrid_map import HybridMap
from hybridmap.node import MapId, NodeId
from hybridmap.pose import Pose2
from hybridmap.ruling import Rulings
from merge.belief.groups import LinkGroup
from merge.belief.memory import Memory
from merge.graph.links import Link, RefusedLink
from merge.graph.merged import MergedMap
from merge.incremental.clashes import falling
from merge.incremental.decided import Decided
from merge.incremental.doubts import Doubts
from merge.incremental.factors import Rows
from merge.incremental.joining import join
from merge.incremental.ledger import Ledger, ends_of
from merge.incremental.outcome import outcome
from merge.incremental.relaxing import RelaxSettings, relax
from merge.incremental.settings import StepSettings
from merge.incremental.sheets import Assembly, MapPair, Sheet
from merge.incremental.verdicts import Verdicts
from merge.merging import MergeSettings
from merge.undoing import undo

ATTEMPTS = 20
"""Times that links are refused after optimisation in one step; what is left waits for the next."""


class Steps:
    """One island. What it hands out is never changed."""

    def __init__(self, settings: MergeSettings, steps: StepSettings, memory: Memory) -> None:
        """Nothing is merged yet.

        Args:
            settings: of the merge.
            steps: when and how it is made in steps.
            memory: of merges with the same settings.
        """
        self._settings = settings
        self._steps = steps
        self._memory = memory
        self._sheets: dict[MapId, Sheet] = {}
        self._ledger = Ledger(self._sheets, settings.consistency)
        self._own: dict[MapId, list[RefusedLink]] = {}
        self._groups: dict[MapPair, list[LinkGroup]] = {}
        self._rough, self._plain = 0, True
        self._doubts = Doubts(steps)
        self._touched: set[NodeId] = set()
        self._ruled: Rulings | None = None
        self._moved: Rows = np.zeros(0, np.int64)
        self._all = Assembly({}, {})

    @property
    def maps(self) -> frozenset[MapId]:
        """Which maps are in it."""
        return frozenset(self._sheets)

    @property
    def stale(self) -> bool:
        """Whether something should be decided again, and no step does it."""
        return self._doubts.due and not self._doubts.within

    def begin(self, merged: MergedMap, some: Set[MapId], verdicts: Verdicts, rulings: Rulings) -> None:
        """Take over what was merged otherwise of some maps: which links are believed, and where nodes are."""
        for map_id in sorted(some & merged.maps.keys()):
            one = merged.maps[map_id]
            # One that was retired until now is nowhere.
            known = {n: merged.pose(n) for n in one.nodes if merged.component_of(n) is not None}
            self._place(map_id, one, rulings, known)
            # What held them where they are may not have come along.
            self._touched |= one.nodes.keys()
        self._ledger.begin(merged, verdicts)

    def resume(
        self, maps: Mapping[MapId, HybridMap], decided: Decided, verdicts: Verdicts, rulings: Rulings
    ) -> None:
        """Take over what another process has decided; all links are heard again, those believed stand."""
        for map_id, one in sorted(maps.items()):
            self._place(
                map_id, one, rulings, {n: decided.places[n] for n in one.nodes.keys() & decided.places}
            )
            self._touched |= one.nodes.keys()
        self._ledger.resume(decided.believed, verdicts)
        self._doubts.since, self._rough, self._doubts.trusted = 0, 0, True

    def step(
        self,
        maps: Mapping[MapId, HybridMap],
        verdicts: Verdicts,
        news: Iterable[MapPair],
        rulings: Rulings,
        past: Set[NodeId] = frozenset(),
    ) -> MergedMap:
        """Merge what has changed.

        Args:
            maps: of the island.
            verdicts: on pairs of their nodes.
            news: between which maps verdicts or rulings have changed since the last step.
            rulings: of people.
            past: nodes of another day for which others stand, see `Doubts`.

        Returns:
            The island's merged map.
        """
        some = maps.keys() - rulings.retired.keys()
        self._leave(self._sheets.keys() - some)
        changed = {one for one in maps if one in some and self._place(one, maps[one], rulings)}
        known, ledger, doubts = self._ledger.known, self._ledger, self._doubts
        ledger.hold(doubts.begin(self._sheets, past, rulings), doubts.labels)
        self._ruled = rulings
        fresh = {pair for pair in news if some.issuperset(pair)}
        ledger.weigh(fresh, verdicts)
        for pair in sorted(fresh | {pair for pair in known if pair[0] in changed or pair[1] in changed}):
            lost = ledger.review(pair, verdicts, rulings)
            doubts.since += len(lost)
            self._touched |= ends_of(lost)
        self._decide(fresh, changed, verdicts, rulings)
        if doubts.doubtful and doubts.small:
            self._decide(fresh, changed, verdicts, rulings)
        return outcome(maps, self._all, ledger, self._own, self._settings.consistency, rulings)

    def _decide(self, fresh: set[MapPair], changed: set[MapId], verdicts: Verdicts, rulings: Rulings) -> None:
        """Judge what is new, or what is to be decided again, and optimise."""
        doubts, ledger = self._doubts, self._ledger
        whole = doubts.due and (doubts.within or not ledger.bundles)
        everything = whole and doubts.everything
        if whole:
            changed, fresh = set(self._sheets), self._doubt_all(verdicts, rulings, everything)
        # All is tried with limited pull first, what is new is tested by what is believed.
        self._plain, self._moved = not whole, np.zeros(0, np.int64)
        self._assemble()
        self._follow(self._touched)
        self._touched = set()
        self._all, more, against = join(
            fresh, self._all, ledger, self._sheets, self._groups, self._settings, self._memory, self._settled
        )
        doubts.since += more
        if not whole and doubts.since - self._rough > self._steps.optimise_share * len(self._all.factors):
            self._rough = doubts.since
            self._relax_all(believed=True)
        self._settle(self._all.nodes_at(self._moved), whole, changed)
        if whole:
            doubts.since = self._rough = 0
        doubts.end(self._sheets, self._all, against, everything)

    def _settle(self, nodes: Iterable[NodeId], whole: bool, changed: set[MapId]) -> None:
        """Optimise until no link strains too much and no robots clash, then with all links at full pull."""
        touched, everything = set(nodes), whole
        for _ in range(ATTEMPTS):
            # Limited pull lets the wrong ones stand out; in a step they were tested before.
            for self._plain in (False, True) if whole else (True,):
                if everything:
                    self._relax_all(self._plain)
                else:
                    self._follow(touched)
                lost = self._strained()
                if lost:
                    break
            lost = lost or self._fall(changed)
            if not lost:
                break
            self._doubts.lost(link.pair for link in lost)
            ends = {node for link in lost for node in link.pair}
            if whole:
                # Of a large map the rest is where it should be.
                everything, touched = self._doubts.small, ends
            touched |= ends
            self._assemble()
        if whole and not everything:
            self._relax_all(believed=True)

    def _leave(self, gone: Iterable[MapId]) -> None:
        """Forget maps that belong to another island now."""
        away = set(gone)
        for pair in [pair for pair in self._ledger.known if away & set(pair)]:
            ends = ends_of(self._ledger.believed(pair))
            self._touched |= {node for node in ends if node.map not in away}
            self._ledger.forget(pair)
            self._groups.pop(pair, None)
        for map_id in away:
            del self._sheets[map_id], self._own[map_id]

    def _place(
        self, map_id: MapId, one: HybridMap, rulings: Rulings, known: Mapping[NodeId, Pose2] | None = None
    ) -> bool:
        """Make the sheet of a map anew if it has changed."""
        s, before = self._settings, self._sheets.get(map_id)
        if before is not None and before.one is one and rulings is self._ruled:
            return False
        undone = undo({map_id: one}, (), rulings)
        gone = [r.edge for r in undone.refused]
        if before is not None and before.one is one and gone == [r.edge for r in before.undone]:
            return False
        pieces = self._memory.fragments(undone.maps, s.consistency, s.strain)
        if known is None:
            known = {} if before is None else before.known()
        after = Sheet.of(one, pieces, known, undone.refused)
        told = after.said() ^ (set() if before is None else before.said())
        self._doubts.since += len(told)
        self._touched |= {node for a, b, _ in told for node in (a, b) if node in after.rows}
        self._sheets[map_id] = after
        self._own[map_id] = [r for piece in pieces for r in piece.refused] + list(undone.refused)
        return True

    def _doubt_all(self, verdicts: Verdicts, rulings: Rulings, everything: bool) -> set[MapPair]:
        """Let all links wait again, or all but those at past nodes: they are decided together."""
        self._ledger.hold(frozenset() if everything else self._doubts.past, self._doubts.labels)
        known = self._ledger.doubt_all()
        if everything:
            for map_id, sheet in self._sheets.items():
                self._sheets[map_id] = Sheet.of(sheet.one, sheet.fragments, {}, sheet.undone)
        self._ledger.weigh(known, verdicts)
        for maps in sorted(known):
            self._ledger.review(maps, verdicts, rulings)
        return known

    def _assemble(self) -> None:
        self._all = Assembly(self._sheets, self._ledger.bundles)
        self._all.in_their_frames()

    def _keep(self) -> None:
        """Let the sheets know where their nodes are now."""
        for map_id, sheet in self._sheets.items():
            means = self._all.means_of(map_id)
            if means is not sheet.means:
                self._sheets[map_id] = replace(sheet, means=means)

    def _follow(self, nodes: Iterable[NodeId], how: RelaxSettings | None = None) -> None:
        """Optimise around nodes, as far as they are still there."""
        there = [node for node in nodes if node.map in self._sheets and node in self._sheets[node.map].rows]
        how = how or replace(self._steps.relax, step=1e-4)  # The last word is exact.
        if how.least >= len(self._all.means):
            how = replace(how, step=self._steps.relax.step)
        self._relax(self._all.rows(sorted(there)), how, self._plain)
        self._keep()

    def _relax_all(self, believed: bool, step: float | None = None) -> None:
        rows, how = np.arange(len(self._all.means)), self._steps.relax
        self._relax(rows, replace(how, least=len(rows), step=step or how.step), believed)
        self._keep()

    def _relax(self, rows: Rows, how: RelaxSettings, believed: bool) -> None:
        huber, one = math.inf if believed else self._settings.huber, self._all
        held = one.anchors()
        if how.least < len(one.means):
            # They move when everything does.
            held = np.union1d(held, one.rows(self._doubts.past))
        one.means, moved = relax(one.factors, one.means, held, rows, huber, how)
        self._moved = np.union1d(self._moved, np.concatenate([moved, rows]))

    def _settled(self, whole: Assembly, nodes: set[NodeId], last: bool) -> Assembly:
        """Optimise between two rounds of joining; exactly, if what was refused is heard once more."""
        self._all = whole
        if self._plain:
            self._follow(nodes)
        else:
            self._relax_all(believed=False, step=None if last else 1e-4)
        return self._all

    def _strained(self) -> list[Link]:
        """Refuse what strains too much where it moved: the worst link; of large islands one by each map."""
        links, index = self._all.believed(self._moved)
        row_of = np.arange(len(self._all.means))
        strains = self._all.factors.take(index, row_of).strains(self._all.means)
        lost: list[Link] = []
        near: set[MapId] = set()
        for k in np.argsort(-strains, kind="stable").tolist():
            if strains[k] <= self._settings.strain or (lost and self._doubts.small):
                break
            if near.isdisjoint(node.map for node in links[k].pair):
                near |= {node.map for node in links[k].pair}
                off = float(strains[k]) ** 0.5
                reason = f"strains the joined map: {off:.1f} standard deviations from where it ended"
                self._ledger.disbelieve([links[k]], reason)
                lost.append(links[k])
        return lost

    def _fall(self, changed: set[MapId]) -> list[Link]:
        """Refuse groups of links under which robots would walk through each other."""
        refuted = [r.link for groups in self._groups.values() for group in groups for r in group.refuted]
        fallen = self._ledger.fallen + [link for link in refuted if link is not None]
        found = falling(self._sheets, self._ledger.bundles, self._all, changed, fallen, self._settings)
        for story, reason in found:
            self._ledger.disbelieve(story, reason, for_good=True)
        return [link for story, _ in found for link in story]

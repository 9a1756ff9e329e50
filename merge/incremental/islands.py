"""The merge as maps grow: only what a change can bear on is merged anew.

Maps that links tie together, directly or by way of others, are an island. Nothing in one island bears on
another, so an island that nothing has touched is kept as it is.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Set
from dataclasses import replace

import networkx as nx

from hybridmap.hybrid_map import HybridMap
from hybridmap.node import MapId, NodeId
from hybridmap.ruling import Rulings
from merge.belief.memory import Memory
from merge.graph.links import Link, RefusedLink
from merge.graph.merged import MergedMap, Postures
from merge.incremental.again import Again
from merge.incremental.decided import Decided
from merge.incremental.settings import StepSettings
from merge.incremental.sheets import MapPair
from merge.incremental.steps import Steps
from merge.incremental.verdicts import Verdict, Verdicts
from merge.merging import MergeSettings, merge_maps
from merge.undoing import undo


class Islands:
    """Merges island by island, and keeps what it has merged."""

    def __init__(self, settings: MergeSettings | None = None, steps: StepSettings | None = None) -> None:
        """Nothing is merged yet.

        Args:
            settings: how.
            steps: when an island is merged step by step.
        """
        self._settings = settings or MergeSettings()
        self._how = steps or StepSettings()
        self._steps: dict[frozenset[MapId], Steps] = {}
        self._memory = Memory()
        self._merged: dict[frozenset[MapId], MergedMap] = {}
        self._abroad: dict[MapId, tuple[HybridMap, frozenset[MapId]]] = {}
        self._rulings = Rulings()
        self._again: Again | None = None
        self._resumed = Decided()

    def decisions(self) -> Decided:
        """What is decided of islands that are merged in steps."""
        large = [merged for island, merged in self._merged.items() if island in self._steps]
        believed = {link.pair for merged in large for link in merged.links}
        return Decided(believed, {node: merged.pose(node) for merged in large for node in merged.postures})

    def resume(self, decided: Decided) -> None:
        """Let large islands, once they are merged, begin from what another process has decided of them."""
        self._resumed = decided

    @property
    def decided(self) -> bool:
        """Whether something was decided again that the next merge takes up."""
        return self._again is not None and self._again.done

    def again(self, maps: Mapping[MapId, HybridMap], verdicts: Verdicts) -> Again | None:
        """What should be decided again, by whoever has the time; None if nothing, or if that is under way.

        Args:
            maps: as they were merged last.
            verdicts: likewise.
        """
        stale = [island for island, steps in self._steps.items() if steps.stale]
        if self._again is not None or not stale:
            return None
        island = max(stale, key=lambda one: (len(one), min(one)))
        inside = {one: maps[one] for one in sorted(island)}
        self._again = Again(self._settings, self._how, inside, verdicts.copy(), self._rulings)
        return self._again

    def give_up(self) -> None:
        """What was to be decided again could not be."""
        self._again = None

    def merge(
        self,
        maps: Mapping[MapId, HybridMap],
        verdicts: Verdicts,
        touched: set[MapId],
        rulings: Rulings,
        past: Set[NodeId] = frozenset(),
    ) -> MergedMap:
        """Merge.

        Args:
            maps: by id. They are never changed, only replaced.
            verdicts: on pairs of their nodes.
            touched: maps that were replaced, or with a node of which the verdicts have changed, since this
                was called last.
            rulings: of people.
            past: nodes of another day for which others stand. Where they are many, what was decided of their
                links stands, see `merge.incremental.doubts`.

        Returns:
            What `merge_maps` makes of all maps.
        """
        news = verdicts.news()
        for ruling in {*rulings.in_force} ^ {*self._rulings.in_force}:
            one, other = (end.map if isinstance(end, NodeId) else end for end in ruling.ends)
            news.add((one, other))
            touched = touched | {one, other}
        self._rulings = rulings
        if self._again is not None:
            self._again.missed(news)
        if self._again is not None and self._again.done:
            steps, missed = self._again.outcome()
            self._again = None
            key = max(self._steps, key=lambda one: len(one & steps.maps), default=None)
            if key is not None and key & steps.maps:
                self._steps[key] = steps
                touched, news = touched | steps.maps, news | missed
        islands = self._ties(maps, verdicts)
        before, self._merged = self._merged, {}
        for island in islands:
            known = before.get(island)
            if known is None or island & touched:
                inside = {one: maps[one] for one in sorted(island)}
                if self._quick(inside, past):
                    self._steps.pop(island, None)
                    known = self._anew(inside, verdicts.among(island))
                else:
                    known = self._step(inside, verdicts, news, before, past)
            self._merged[island] = known
        self._steps = {island: one for island, one in self._steps.items() if island in self._merged}
        self._resumed = Decided()
        island_of = {one: island for island in islands for one in island}
        return _together(list(self._merged.values()), maps, verdicts.across(island_of), rulings)

    def _quick(self, maps: Mapping[MapId, HybridMap], past: Set[NodeId]) -> bool:
        """Whether maps are few enough to be merged anew."""
        nodes = [node for one in maps.values() for node in one.nodes]
        old = sum(node in past for node in nodes)
        return len(nodes) <= self._how.anew_up_to and old <= self._how.past_share * len(nodes)

    def _ties(self, maps: Mapping[MapId, HybridMap], verdicts: Verdicts) -> list[frozenset[MapId]]:
        """Islands: maps that links or drives tie together."""
        ties: nx.Graph = nx.Graph()
        ties.add_nodes_from(maps)
        ties.add_edges_from(verdicts.ties(self._rulings))
        for map_id, one in maps.items():
            known = self._abroad.get(map_id)
            if known is None or known[0] is not one:
                ends = {node[:2] for edge in one.edges.values() for node in (edge.a, edge.b)}
                known = self._abroad[map_id] = one, frozenset(MapId(*end) for end in ends) - {map_id}
            ties.add_edges_from((map_id, other) for other in known[1])
        found = (frozenset(part & maps.keys()) for part in nx.connected_components(ties))
        return sorted((island for island in found if island), key=min)

    def _step(
        self,
        maps: Mapping[MapId, HybridMap],
        verdicts: Verdicts,
        news: set[MapPair],
        before: Mapping[frozenset[MapId], MergedMap],
        past: Set[NodeId],
    ) -> MergedMap:
        """The next step of an island, of which parts may have been merged anew until now."""
        known = [one for one in self._steps.values() if one.maps & maps.keys()]
        steps = max(known, key=lambda one: len(one.maps & maps.keys()), default=None)
        if steps is None:
            steps = Steps(self._settings, self._how, self._memory)
            if any(node in self._resumed.places for one in maps.values() for node in one.nodes):
                steps.resume(maps, self._resumed, verdicts, self._rulings)
                news = news | verdicts.at(maps.keys())
        strange = maps.keys() - steps.maps - self._rulings.retired.keys()
        for island in sorted(before, key=min):
            if island & strange:
                steps.begin(before[island], strange, verdicts, self._rulings)
        merged = steps.step(maps, verdicts, news | verdicts.at(strange), self._rulings, past)
        self._steps[frozenset(maps)] = steps
        return merged

    def _anew(self, maps: Mapping[MapId, HybridMap], verdicts: Iterable[Verdict]) -> MergedMap:
        links, refused = _sorted_out(verdicts)
        undone = undo(maps, links, self._rulings)
        merged = merge_maps(
            undone.maps, undone.links, [*refused, *undone.refused], self._settings, self._memory
        )
        return undone.completed(merged)


def _sorted_out(verdicts: Iterable[Verdict]) -> tuple[list[Link], list[RefusedLink]]:
    links: list[Link] = []
    refused: list[RefusedLink] = []
    for verdict in verdicts:
        if isinstance(verdict, Link):
            links.append(verdict)
        else:
            refused.append(verdict)
    return links, refused


def _together(
    islands: list[MergedMap],
    maps: Mapping[MapId, HybridMap],
    across: Iterable[Verdict],
    rulings: Rulings,
) -> MergedMap:
    """One merged map of islands that have nothing to do with each other."""
    graphs = sorted(
        (
            (graph, component)
            for one in islands
            for graph, component in zip(one.graphs, one.components, strict=True)
        ),
        key=lambda item: (-len(item[0].nodes), item[0].anchor),
    )
    solved = tuple(graph for graph, _ in graphs)
    postures = Postures(solved)
    links = sorted((link for one in islands for link in one.links), key=lambda link: link.pair)
    refused = [refusal for one in islands for refusal in one.refused]
    apart, between = _sorted_out(across)
    undone = undo({}, apart, rulings)
    refused += [r for r in (*between, *undone.refused) if r.a in postures and r.b in postures]
    refused.sort(key=lambda refusal: refusal.pair)
    components = tuple(component for _, component in graphs)
    whole = MergedMap(dict(sorted(maps.items())), tuple(links), tuple(refused), components, postures, solved)
    return replace(whole, rulings=rulings)

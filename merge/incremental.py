"""The merge as maps grow: only what a change can bear on is merged anew.

Maps that links tie together, directly or by way of others, are an island. Nothing in one island bears on
another, so an island that nothing has touched is kept as it is.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import networkx as nx

from hybridmap.hybrid_map import HybridMap
from hybridmap.node import MapId
from hybridmap.ruling import Rulings
from merge.candidates import Pair
from merge.incremental_memory import Memory
from merge.links import Link, RefusedLink
from merge.merged import MergedMap, Postures
from merge.merging import MergeSettings, merge_maps
from merge.undoing import undo

Verdict = Link | RefusedLink
MapPair = tuple[MapId, MapId]
"""Smaller first; twice the same for pairs within a map."""


class Verdicts:
    """What was found of the pairs that are chosen, by their maps."""

    def __init__(self) -> None:
        """None yet."""
        self._between: dict[MapPair, dict[Pair, Verdict]] = {}
        self._partners: dict[MapId, set[MapId]] = {}

    def put(self, pair: Pair, verdict: Verdict) -> None:
        """Take note of what was found of a pair."""
        maps = pair[0].map, pair[1].map
        self._between.setdefault(maps, {})[pair] = verdict
        self._partners.setdefault(maps[0], set()).add(maps[1])

    def drop(self, pair: Pair) -> None:
        """A pair is chosen no longer. One that never was is no error."""
        maps = pair[0].map, pair[1].map
        known = self._between.get(maps, {})
        known.pop(pair, None)
        if not known and maps in self._between:
            del self._between[maps]
            self._partners[maps[0]].discard(maps[1])

    def ties(self, rulings: Rulings) -> Iterable[MapPair]:
        """Maps between which there are links, those that people have ruled out left out."""
        ruled = bool(rulings.in_force)
        for maps, known in self._between.items():
            if maps[0] == maps[1]:
                continue
            found = (v for v in known.values() if isinstance(v, Link))
            if any(not ruled or rulings.against(*link.pair) is None for link in found):
                yield maps

    def among(self, maps: frozenset[MapId]) -> list[Verdict]:
        """Of all pairs with both ends in these maps."""
        return [
            verdict
            for one in sorted(maps)
            for other in sorted(self._partners.get(one, set()) & maps)
            for verdict in self._between[one, other].values()
        ]

    def across(self, island_of: Mapping[MapId, frozenset[MapId]]) -> list[Verdict]:
        """Of all pairs of which the two maps are in different islands."""
        return [
            verdict
            for (one, other), known in self._between.items()
            if island_of[one] is not island_of[other]
            for verdict in known.values()
        ]


class Islands:
    """Merges island by island, and keeps what it has merged."""

    def __init__(self, settings: MergeSettings | None = None) -> None:
        """Nothing is merged yet.

        Args:
            settings: how.
        """
        self._settings = settings or MergeSettings()
        self._memory = Memory()
        self._merged: dict[frozenset[MapId], MergedMap] = {}
        self._abroad: dict[MapId, tuple[HybridMap, frozenset[MapId]]] = {}
        self._rulings = Rulings()

    def merge(
        self,
        maps: Mapping[MapId, HybridMap],
        verdicts: Verdicts,
        touched: set[MapId],
        rulings: Rulings,
    ) -> MergedMap:
        """Merge.

        Args:
            maps: by id. They are never changed, only replaced.
            verdicts: on pairs of their nodes.
            touched: maps that were replaced, or with a node of which the verdicts have changed, since this
                was called last.
            rulings: of people.

        Returns:
            What `merge_maps` makes of all maps.
        """
        if rulings.in_force != self._rulings.in_force:
            # What people rule may tie maps and part them; it is rare enough to begin anew.
            self._merged = {}
        self._rulings = rulings
        self._memory.forget({one for island in self._merged for one in island} - set(maps))
        islands = self._ties(maps, verdicts)
        before, self._merged = self._merged, {}
        for island in islands:
            known = before.get(island)
            if known is None or island & touched:
                known = self._island({one: maps[one] for one in sorted(island)}, verdicts.among(island))
            self._merged[island] = known
        island_of = {one: island for island in islands for one in island}
        return _together(list(self._merged.values()), maps, verdicts.across(island_of), rulings)

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

    def _island(self, maps: Mapping[MapId, HybridMap], verdicts: Iterable[Verdict]) -> MergedMap:
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

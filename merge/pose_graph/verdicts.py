"""Verdicts: what was found of pairs of nodes, by their maps."""

from collections.abc import Iterable, Mapping, Set

from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.manual_constraint import ManualConstraints
from mapweave.merge.pose_graph.candidates import Pair
from mapweave.merge.pose_graph.links import Link, RefusedLink

MapPair = tuple[MapId, MapId]
"""Smaller first; twice the same for links within a map."""
Verdict = Link | RefusedLink


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
        verdicts = self._between.get(maps, {})
        verdicts.pop(pair, None)
        if not verdicts and maps in self._between:
            del self._between[maps]
            self._partners[maps[0]].discard(maps[1])

    def between(self, maps: MapPair) -> Mapping[Pair, Verdict]:
        """Verdicts on the pairs between two maps."""
        return self._between.get(maps, {})

    def at(self, maps: Set[MapId]) -> set[MapPair]:
        """Between which maps there is anything, if one of them is among these."""
        return {pair for pair in self._between if pair[0] in maps or pair[1] in maps} if maps else set()

    def ties(self, constraints: ManualConstraints) -> Iterable[MapPair]:
        """Maps between which there are links, without those that manual constraints exclude."""
        constrained = bool(constraints.in_force)
        for maps, verdicts in self._between.items():
            if maps[0] == maps[1]:
                continue
            links = (v for v in verdicts.values() if isinstance(v, Link))
            if any(not constrained or constraints.against(*link.pair) is None for link in links):
                yield maps

    def among(self, maps: frozenset[MapId]) -> list[Verdict]:
        """Verdicts on all pairs with both ends in these maps."""
        return [
            verdict
            for first in sorted(maps)
            for second in sorted(self._partners.get(first, set()) & maps)
            for verdict in self._between[first, second].values()
        ]

    def across(self, island_of: Mapping[MapId, frozenset[MapId]]) -> list[Verdict]:
        """Verdicts on pairs of maps in different islands; maps that are in none are left out."""
        return [
            verdict
            for (first, second), verdicts in self._between.items()
            if first in island_of and second in island_of and island_of[first] is not island_of[second]
            for verdict in verdicts.values()
        ]

"""The merge as maps grow: only islands that a change affects are merged again.

Maps that links tie together, directly or by way of others, are an island. Nothing in one island bears on
another, so an island that nothing has touched is kept as it is.

What some of the maps are without the others says a second merge, of these alone: see `Islands.links_among`.

Two sorts of manual constraints need a second merge of their islands: which nodes lie in a retired area says
the merge without retired areas, and whether a link by hand is contradicted the merge without links by hand.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import replace

import networkx as nx
import numpy as np

from mapweave.hybridmap.constraint_subject import Linked, RetiredArea
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.merge.manual_constraints import CutMaps, apply_constraints
from mapweave.merge.merging import MergeCache, decide
from mapweave.merge.outlier_rejection.loop_closures import distance2_of
from mapweave.merge.pose_graph.candidates import Pair
from mapweave.merge.pose_graph.links import Link, RefusedLink, refuse
from mapweave.merge.pose_graph.marginalization import fused, is_marginal
from mapweave.merge.pose_graph.merged_map import MergedMap, NodePoses
from mapweave.merge.pose_graph.verdicts import Verdict, Verdicts
from mapweave.merge.retired_nodes import retired_nodes
from mapweave.merge.settings import MergeSettings
from mapweave.merge.standing_decisions import StandingDecisions

EXACT = 600
"""Islands of as many nodes are decided as a whole whenever they change: that is soon done, and the outcome
depends on what there is alone, not on the order in which it came."""
CHANGED = 0.25
"""Larger ones when links have come or gone that are this share of those that were decided together."""
CONTRADICTION = "contradicts what nodes measured that have left the map since"
"""Reason of a refusal."""


class Islands:
    """Merges island by island, and keeps what it has merged."""

    def __init__(
        self,
        settings: MergeSettings | None = None,
        exact: int = EXACT,
        pause: Callable[[], None] = lambda: None,
    ) -> None:
        """Nothing is merged yet.

        Args:
            settings: how.
            exact: nodes up to which an island is decided as a whole whenever it changes.
            pause: called between two islands.
        """
        self._pause = pause
        self._settings = settings or MergeSettings()
        self._exact = exact
        self._cache = MergeCache()
        self._merged_islands: dict[frozenset[MapId], tuple[MergedMap, StandingDecisions]] = {}
        self._abroad: dict[MapId, tuple[HybridMap, frozenset[MapId]]] = {}
        self._constraints = ManualConstraints()
        self._cut_maps = CutMaps()
        self._without_areas: Islands | None = None
        self._without_hand: Islands | None = None
        self._some: Islands | None = None
        self._asked, self._untold = False, set[MapId]()
        self._is_reference = False
        self._marginals: Sequence[Link] = ()
        self._standing: Set[Pair] = frozenset()
        self._fused: dict[Pair, tuple[Link, Link, Link | None]] = {}

    def replace_marginals(self, marginals: Sequence[Link], standing: Set[Pair]) -> None:
        """Nodes were removed: these links are left of them, and of those that were removed before.

        They join what they are about before all other links, and never fall: nodes are removed long after
        their links were decided. So it is with verified links that were decided by what is gone.

        Args:
            marginals: all that count from now on, see `mapweave.merge.pose_graph.marginalization`.
            standing: verified links that are not decided again, by their nodes.
        """
        self._marginals, self._standing = marginals, standing
        pairs = {link.pair for link in marginals}
        self._fused = {pair: entry for pair, entry in self._fused.items() if pair in pairs}
        # Much of what is remembered is about nodes that are gone.
        self._cache, self._abroad, self._cut_maps = MergeCache(), {}, CutMaps()
        self._without_areas = self._without_hand = self._some = None

    def merge(
        self,
        maps: Mapping[MapId, HybridMap],
        verdicts: Verdicts,
        touched: set[MapId],
        constraints: ManualConstraints,
    ) -> MergedMap:
        """Merge.

        Args:
            maps: by id. They are never changed, only replaced.
            verdicts: on pairs of their nodes.
            touched: maps that were replaced, or with a node of which the verdicts have changed, since this
                was called last.
            constraints: manual constraints.

        Returns:
            What `merge_maps` makes of all maps; of large islands nearly so.
        """
        constraints = constraints.with_nodes(self._retired_nodes(maps, verdicts, touched, constraints))
        touched = touched | _touched_by(self._constraints, constraints)
        if not self._asked:
            self._some = None
        self._asked, self._untold = False, self._untold | touched
        islands = self._ties(maps, verdicts, constraints)
        merged_islands: dict[frozenset[MapId], tuple[MergedMap, StandingDecisions]] = {}
        before = {one: island for island in self._merged_islands for one in island}
        for island in islands:
            if island in self._merged_islands and not island & touched:
                merged_islands[island] = self._merged_islands[island]
                continue
            inside = {one: maps[one] for one in sorted(island)}
            overlapping = {before[one] for one in island if one in before}
            earlier = [self._merged_islands[one][1] for one in sorted(overlapping, key=min)]
            merged_islands[island] = self._decided(inside, verdicts.among(island), constraints, earlier)
            self._pause()
        self._merged_islands, self._constraints = merged_islands, constraints
        island_of = {one: island for island in islands for one in island}
        whole = _together(
            [merged for merged, _ in merged_islands.values()], maps, verdicts.across(island_of), constraints
        )
        contradicted = self._contradicted(_around(maps, islands, constraints), verdicts, touched, constraints)
        return replace(whole, contradicted={**contradicted, **whole.contradicted}) if contradicted else whole

    def links_among(self, maps: Mapping[MapId, HybridMap], verdicts: Verdicts) -> set[Pair]:
        """The links, by their nodes, that a merge of some maps alone accepts, with the same constraints.

        Args:
            maps: some of those that were merged last.
            verdicts: the same as then.
        """
        if self._some is None:
            self._some = self._reference()
        touched, self._untold, self._asked = self._untold, set(), True
        return {link.key for link in self._some.merge(maps, verdicts, touched, self._constraints).links}

    def _decided(
        self,
        maps: Mapping[MapId, HybridMap],
        verdicts: Iterable[Verdict],
        constraints: ManualConstraints,
        earlier: Sequence[StandingDecisions],
    ) -> tuple[MergedMap, StandingDecisions]:
        links, refused = self._with_marginals(maps, *_sorted_out(verdicts))
        undone = apply_constraints(maps, links, constraints, self._cut_maps)
        decided = {link.key for link in undone.links if is_marginal(link) or link.key in self._standing}
        others = [link for link in undone.links if link.key not in decided]
        certain = [*undone.certain, *(link for link in undone.links if link.key in decided)]
        everything = undone.maps, others, [*refused, *undone.refused], self._settings, self._cache
        small = sum(len(hybrid_map.nodes) for hybrid_map in maps.values()) <= self._exact
        before = None if small or not earlier else StandingDecisions.union(earlier)
        merged, stands = decide(*everything, before, certain)
        if stands.changed > CHANGED * stands.size:
            merged, stands = decide(*everything, None, certain)
        by_hand = {link.pair for link in undone.certain}
        contradicted = {pair: words for pair, words in merged.contradicted.items() if pair in by_hand}
        return undone.completed(replace(merged, contradicted=contradicted)), stands

    def _with_marginals(
        self, maps: Mapping[MapId, HybridMap], links: list[Link], refused: list[RefusedLink]
    ) -> tuple[list[Link], list[RefusedLink]]:
        """Links and refusals with the marginal links of these maps: of two nodes there is one link."""
        inside = {
            link.pair: link
            for link in self._marginals
            if all(end.map in maps and end in maps[end.map].nodes for end in link.pair)
        }
        if not inside:
            return links, refused
        verified = {link.key: link for link in links}
        out = [link for link in links if link.key not in inside]
        against = [refusal for refusal in refused if refusal.pair not in inside]
        for pair, marginal in inside.items():
            link = verified.get(pair)
            # What is not decided for good must not become certain by what is weakly known already.
            if link is None or pair not in self._standing:
                out.append(marginal)
                continue
            known = self._fused.get(pair)
            # A link is known by its identity: what was decided of it holds as long as it is the same.
            if known is None or known[0] is not marginal or known[1] is not link:
                known = self._fused[pair] = marginal, link, fused(marginal, link)
            if known[2] is None:
                against.append(refuse(link, CONTRADICTION))
            out.append(known[2] or marginal)
        return out, against

    def _retired_nodes(
        self,
        maps: Mapping[MapId, HybridMap],
        verdicts: Verdicts,
        touched: set[MapId],
        constraints: ManualConstraints,
    ) -> dict[NodeId, ManualConstraint]:
        """Where a retired area lies the merge without retired areas says, so that it does not say itself."""
        if self._is_reference:
            return dict(constraints.nodes)
        if not any(isinstance(c.about, RetiredArea) for c in constraints.in_force):
            self._without_areas = None
            return retired_nodes(maps, constraints, ())
        self._without_areas = self._without_areas or self._reference()
        others = constraints.without(RetiredArea)
        others = others.with_nodes(retired_nodes(maps, others, ()))
        inside = _around(maps, self._ties(maps, verdicts, others), constraints)
        merged = self._without_areas.merge(inside, verdicts, touched, others)
        return retired_nodes(maps, constraints, merged.graphs)

    def _contradicted(
        self,
        maps: Mapping[MapId, HybridMap],
        verdicts: Verdicts,
        touched: set[MapId],
        constraints: ManualConstraints,
    ) -> dict[Pair, str]:
        """Links by hand that what robots have measured contradicts, and how."""
        links = constraints.links
        if self._is_reference or not links:
            self._without_hand = None
            return {}
        self._without_hand = self._without_hand or self._reference()
        others = constraints.without(Linked).with_nodes(constraints.nodes)
        merged = self._without_hand.merge(maps, verdicts, touched, others)
        out, s = {}, self._settings.consistency
        for pair, linked in links.items():
            measured = merged.relative(*pair)
            distance2 = 0.0 if measured is None else distance2_of(linked.a_from_b, measured)
            if measured is not None and distance2 >= s.gate:
                off = (linked.a_from_b.mean.inverse() @ measured.mean).vector
                out[pair] = (
                    f"without it robots' measurements put {linked.b} {np.hypot(off[0], off[1]):.2f} m and "
                    f"{abs(np.degrees(off[2])):.1f} deg from there: {np.sqrt(distance2):.1f} standard "
                    "deviations"
                )
        return out

    def _reference(self) -> Islands:
        """A merge that this one is compared with."""
        reference = Islands(self._settings, self._exact)
        reference._is_reference = True
        reference.replace_marginals(self._marginals, self._standing)
        return reference

    def _ties(
        self, maps: Mapping[MapId, HybridMap], verdicts: Verdicts, constraints: ManualConstraints
    ) -> list[frozenset[MapId]]:
        """Islands: maps that links or drives tie together."""
        ties: nx.Graph = nx.Graph()
        ties.add_nodes_from(maps)
        ties.add_edges_from(verdicts.ties(constraints))
        by_hand = ((a.map, b.map) for a, b in (*constraints.links, *(m.pair for m in self._marginals)))
        ties.add_edges_from(pair for pair in by_hand if pair[0] in maps and pair[1] in maps)
        for map_id, hybrid_map in maps.items():
            entry = self._abroad.get(map_id)
            if entry is None or entry[0] is not hybrid_map:
                ends = {node[:2] for edge in hybrid_map.edges.values() for node in (edge.a, edge.b)}
                entry = self._abroad[map_id] = hybrid_map, frozenset(MapId(*end) for end in ends) - {map_id}
            ties.add_edges_from((map_id, neighbour) for neighbour in entry[1])
        parts = (frozenset(part & maps.keys()) for part in nx.connected_components(ties))
        return sorted((island for island in parts if island), key=min)


def _around(
    maps: Mapping[MapId, HybridMap], islands: Iterable[frozenset[MapId]], constraints: ManualConstraints
) -> dict[MapId, HybridMap]:
    """Maps of the islands with links by hand or with anchors of retired areas: no others bear on these."""
    ends = {
        which
        for constraint in constraints.in_force
        if isinstance(constraint.about, Linked | RetiredArea)
        for which in constraint.about.maps
    }
    return {one: maps[one] for island in islands if island & ends for one in sorted(island)}


def _touched_by(before: ManualConstraints, now: ManualConstraints) -> set[MapId]:
    """Maps of which constraints have changed."""
    maps = {which for c in {*before.in_force} ^ {*now.in_force} for which in c.about.maps}
    retired = before.nodes.keys() | now.nodes.keys()
    maps |= {node.map for node in retired if before.nodes.get(node) is not now.nodes.get(node)}
    labelled = before.floors.keys() | now.floors.keys()
    return maps | {which for which in labelled if before.floors.get(which) != now.floors.get(which)}


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
    constraints: ManualConstraints,
) -> MergedMap:
    """One merged map of islands that have nothing to do with each other."""
    graphs = sorted(
        (
            (graph, component)
            for merged in islands
            for graph, component in zip(merged.graphs, merged.components, strict=True)
        ),
        key=lambda item: (-len(item[0].nodes), item[0].anchor),
    )
    solved = tuple(graph for graph, _ in graphs)
    poses = NodePoses(solved)
    links = sorted((link for merged in islands for link in merged.links), key=lambda link: link.pair)
    refused = [refusal for merged in islands for refusal in merged.refused]
    apart, between = _sorted_out(across)
    undone = apply_constraints({}, apart, constraints)
    refused += [r for r in (*between, *undone.refused) if r.a in poses and r.b in poses]
    refused.sort(key=lambda refusal: refusal.pair)
    components = tuple(component for _, component in graphs)
    whole = MergedMap(dict(sorted(maps.items())), tuple(links), tuple(refused), components, poses, solved)
    contradicted = {pair: words for merged in islands for pair, words in merged.contradicted.items()}
    return replace(whole, constraints=constraints, contradicted=contradicted)

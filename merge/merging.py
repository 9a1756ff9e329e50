"""Maps and verified links become a merged map: the whole of the merge after verification, as one function.

1. Maps are cut into pieces that their own edges connect; loop closures must agree with the robot's drive.
2. The links between each two pieces, and the loops within one, are sorted by consistency.
3. Pieces are joined, best supported first, and the links between the larger pieces are sorted again. Links
   within one piece must agree with it.
4. Each component is optimised.
5. Where two robots would have been at the same place at the same time, the links that cause this are
   refuted, and the merge continues at 2 with the rest.
6. Drives of a robot among others' nodes are checked against the result.

Where links show that all lengths of a map are too long by one factor, that is undone before 2 (see
mapweave.merge.pose_graph.map_scales); maps and links are passed on as they were measured.

Links by hand join pieces before all others, and never fall. What contradicts them is reported.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace

from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.merge.mutual_exclusion.refutation import Refutation
from mapweave.merge.mutual_exclusion.trajectories import TrajectoryCache
from mapweave.merge.outlier_rejection.agglomerative_joining import agglomerate
from mapweave.merge.outlier_rejection.decision_cache import DecisionCache
from mapweave.merge.outlier_rejection.distinctness import weigh
from mapweave.merge.outlier_rejection.driven_edges import refuse_drives
from mapweave.merge.outlier_rejection.link_groups import LinkGroup
from mapweave.merge.pose_graph.candidates import Pair
from mapweave.merge.pose_graph.component_solver import ComponentSolver
from mapweave.merge.pose_graph.fragments import Fragment
from mapweave.merge.pose_graph.links import Link, RefusedLink, refuse_edge
from mapweave.merge.pose_graph.map_scales import MapScales
from mapweave.merge.pose_graph.marginalization import is_marginal
from mapweave.merge.pose_graph.merged_map import MergedMap, NodePoses
from mapweave.merge.pose_graph.solved_graph import PoseGraph
from mapweave.merge.settings import MergeSettings
from mapweave.merge.standing_decisions import StandingDecisions


@dataclass(frozen=True, eq=False)
class MergeCache:
    """What a merge found out that the next one with the same settings need not find out again.

    Attributes:
        decisions: fragments of maps, and links between them, sorted.
        corrected: fragments of maps without factors of their lengths.
        scales: factors of lengths.
        trajectories: of the robots.
    """

    decisions: DecisionCache = field(default_factory=DecisionCache)
    corrected: DecisionCache = field(default_factory=DecisionCache)
    scales: MapScales = field(default_factory=MapScales)
    trajectories: TrajectoryCache = field(default_factory=TrajectoryCache)


def merge_maps(
    maps: Mapping[MapId, HybridMap],
    links: Iterable[Link],
    refused: Iterable[RefusedLink] = (),
) -> MergedMap:
    """Merge with the settings that are the default.

    Args:
        maps: by id; they are not changed.
        links: verified, at most one a pair of nodes; those at nodes that are not there are left out.
        refused: pairs that were refused before, to be kept with their reasons.

    Returns:
        The merged map. It does not depend on the order of maps, links or nodes.
    """
    return decide(maps, links, refused, MergeSettings(), MergeCache())[0]


def decide(
    maps: Mapping[MapId, HybridMap],
    links: Iterable[Link],
    refused: Iterable[RefusedLink],
    settings: MergeSettings,
    cache: MergeCache,
    before: StandingDecisions | None = None,
    certain: Iterable[Link] = (),
) -> tuple[MergedMap, StandingDecisions]:
    """Merge, and return the decisions, so that the next merge can begin from them.

    Args:
        maps: by id; they are not changed.
        links: verified, see `merge_maps`.
        refused: pairs that were refused before, to be kept with their reasons.
        settings: how.
        cache: of merges with the same settings.
        before: standing decisions on the same maps. A link keeps its decision until links between the same
            two maps come or go; None: all are decided.
        certain: links by hand, the smaller id first; none of `links` is between the same two nodes.

    Returns:
        The merged map, and the standing decisions.
    """
    s, exact, standing = settings, before is None, before or StandingDecisions()
    links, certain = list(links), list(certain)
    measured = _Measured(maps, {link.pair: link for link in (*links, *certain)})
    maps, fragments, links, certain = _corrected(maps, links, certain, s, cache, exact)
    solver = ComponentSolver(fragments)
    now = _Links.of(links, certain, solver.by_node, standing)
    weighed = _weighed(now, standing, solver.by_node, maps, cache.decisions, s) | now.by_hand

    # What has been decided and still holds.
    held = [weighed[pair] for pair in weighed if pair in standing.believed and pair in now.unchanged]
    refuted = standing.refuted & now.unchanged
    closed = {
        pair
        for pair in standing.refused.keys() & now.unchanged
        if weighed[pair].maps not in now.fresh and standing.together(*pair)
    }
    contradicted = {pair: words for pair, words in standing.contradicted.items() if pair in now.unchanged}
    if not exact:
        removed = [standing.weighed[pair] for pair in standing.believed - now.unchanged]
        solver.resume(standing.graphs, standing.fragments, held, removed)
    held += [link for pair, link in now.by_hand.items() if pair not in now.unchanged]

    # Sorted by consistency, joined, optimised, and tested for robots that cannot have been in one place.
    refutation = Refutation(maps, fragments, s.exclusion, cache.trajectories)
    open_ = [weighed[pair] for pair in now.given if pair not in now.by_hand and pair not in refuted]
    groups = cache.decisions.groups(open_, solver.by_node, s.consistency, refutation.verdict, exact)
    joined = _joined(solver, groups, held, closed, refutation, now.by_hand, s, exact)
    contradicted |= joined.against_hand

    refutations = {r.pair: r for group in groups.values() for r in group.refuted}
    because = {pair: standing.refused[pair] for pair in closed | refuted}
    because |= {r.pair: r for r in joined.unjoined} | refutations
    refusals = [
        *(r for r in refused if {r.a, r.b} <= solver.by_node.keys() and r.pair not in now.by_hand),
        *because.values(),
        *(r for fragment in fragments for r in fragment.refused),
        *refuse_drives(maps, joined.solved, s.consistency),
    ]
    merged = measured.merged_map(joined.solved, joined.kept, refusals, contradicted)
    return merged, StandingDecisions(
        now.given,
        weighed,
        frozenset(link.pair for link in merged.links),
        because,
        frozenset(refuted | refutations.keys()),
        merged.graphs,
        tuple(fragments),
        contradicted,
        len(now.given) if exact else standing.size,
        0 if exact else standing.changed + now.news,
    )


@dataclass(frozen=True, eq=False)
class _Links:
    """The links of a merge by their pairs, and what is new of them.

    Attributes:
        given: all at nodes that are there.
        by_hand: those of them that a person has made.
        unchanged: pairs of which the last merge had the same link.
        fresh: maps between which links have come or gone.
        news: how many have.
    """

    given: Mapping[Pair, Link]
    by_hand: dict[Pair, Link]
    unchanged: Set[Pair]
    fresh: Set[tuple[MapId, MapId]]
    news: int

    @staticmethod
    def of(
        links: Iterable[Link], certain: Iterable[Link], nodes: Container[NodeId], standing: StandingDecisions
    ) -> _Links:
        by_hand = {link.pair: link for link in certain if link.a in nodes and link.b in nodes}
        given = {link.pair: link for link in links if link.a in nodes and link.b in nodes} | by_hand
        unchanged = {pair for pair, link in given.items() if standing.given.get(pair) is link}
        news = (given.keys() - unchanged) | (standing.given.keys() - unchanged)
        fresh = {(given.get(pair) or standing.given[pair]).maps for pair in news}
        return _Links(given, by_hand, unchanged, fresh, len(news))


@dataclass(frozen=True, eq=False)
class _Joined:
    """Components, the links that are kept, those that are not, and what contradicts links by hand."""

    solved: list[PoseGraph]
    kept: list[Link]
    unjoined: list[RefusedLink]
    against_hand: Mapping[Pair, str]


def _joined(
    solver: ComponentSolver,
    groups: dict[Pair, LinkGroup],
    held: Sequence[Link],
    closed: Set[Pair],
    refutation: Refutation,
    by_hand: Mapping[Pair, Link],
    s: MergeSettings,
    exact: bool,
) -> _Joined:
    """Join and optimise until no two robots were at the same place at the same time.

    Groups with refuted links are replaced in `groups`.
    """
    against_hand: dict[Pair, str] = {}
    # Each round refutes a link at least, so there is a last one.
    while True:
        kept, unjoined = agglomerate(solver, groups, s.consistency, held, closed)
        solved = solver.solve(kept, whole=exact)
        changed = None if exact else solver.changed
        impossible, contradictions = refutation.impossible(solved, kept, changed, by_hand)
        against_hand |= contradictions
        if not impossible:
            return _Joined(solved, kept, unjoined, against_hand)
        for key, reason in impossible.items():
            contradicting = [link for link in kept if refutation.key_of(link) == key]
            groups[key] = groups[key].without(contradicting, reason, s.consistency, refutation.verdict)
        fallen = {r.pair for group in groups.values() for r in group.refuted}
        held = [link for link in held if link.pair not in fallen]


def _corrected(
    maps: Mapping[MapId, HybridMap],
    links: Sequence[Link],
    certain: Sequence[Link],
    s: MergeSettings,
    cache: MergeCache,
    exact: bool,
) -> tuple[Mapping[MapId, HybridMap], list[Fragment], list[Link], list[Link]]:
    """Maps, their pieces, and links without the factors by which maps' lengths are too long.

    What a person says has no factor. Nor have marginal links: they were made of corrected maps.
    """
    pieces = cache.decisions.fragments(maps, s.consistency)
    scales = cache.scales.of(maps, pieces, links, exact)
    logs = {which: scale.undone for which, scale in scales.items() if scale.undone}
    changed = cache.scales.corrected_maps(maps, logs)
    if not logs:
        return maps, pieces, [*links], [*certain]
    pieces = [piece for piece in pieces if piece.name.map not in logs]
    pieces += cache.corrected.fragments(changed, s.consistency)

    def corrected(link: Link) -> Link:
        ends = logs.get(link.a.map, 0.0), logs.get(link.b.map, 0.0)
        there = all(end.map in maps and end in maps[end.map].nodes for end in link.pair)
        return cache.scales.corrected_link(link, maps, ends) if any(ends) and there else link

    return (
        {**maps, **changed},
        sorted(pieces, key=lambda piece: piece.name),
        [corrected(link) for link in links],
        [link if is_marginal(link) or not len(link.shared) else corrected(link) for link in certain],
    )


@dataclass(frozen=True, eq=False)
class _Measured:
    """Maps and links as they were measured: a merge says of these what it has decided of corrected ones."""

    maps: Mapping[MapId, HybridMap]
    links: Mapping[Pair, Link]

    def merged_map(
        self,
        solved: Sequence[PoseGraph],
        kept: Iterable[Link],
        refusals: Iterable[RefusedLink],
        contradicted: Mapping[Pair, str],
    ) -> MergedMap:
        return MergedMap(
            dict(sorted(self.maps.items())),
            tuple(sorted((self._link(link).canonical() for link in kept), key=lambda link: link.pair)),
            tuple(sorted(map(self._refusal, refusals), key=lambda refusal: refusal.pair)),
            tuple(frozenset(graph.nodes) for graph in solved),
            NodePoses(solved),
            tuple(solved),
            contradicted=contradicted,
        )

    def _link(self, link: Link) -> Link:
        """A link as it was verified, weighed as it is."""
        verified = self.links.get(link.pair)
        if verified is None or verified.a_from_b is link.a_from_b:
            return link
        return verified if verified.evidence == link.evidence else replace(verified, evidence=link.evidence)

    def _refusal(self, refusal: RefusedLink) -> RefusedLink:
        """A refusal of the link, or of the edge, as it was measured."""
        if refusal.link is None:
            return refusal
        if refusal.edge is not None:
            edge = self.maps[refusal.edge.map].edges.get(refusal.edge)  # none: a person keeps its nodes apart
            same = edge is None or edge.a_from_b.mean == refusal.link.a_from_b.mean
            return refusal if edge is None or same else refuse_edge(edge, refusal.reason)
        link = self._link(refusal.link)
        return refusal if link is refusal.link else replace(refusal, link=link)


def _weighed(
    now: _Links,
    standing: StandingDecisions,
    by_node: Mapping[NodeId, Fragment],
    maps: Mapping[MapId, HybridMap],
    cache: DecisionCache,
    s: MergeSettings,
) -> dict[Pair, Link]:
    """Links with their aliased landmarks, searched among links between maps with new links."""
    given = {pair: link for pair, link in now.given.items() if pair not in now.by_hand}
    out = {pair: standing.weighed[pair] for pair in given if pair in now.unchanged}
    some = [link for link in given.values() if link.maps in now.fresh]
    involved = {map_id: maps[map_id] for pair in now.fresh for map_id in pair if map_id in maps}
    for link, weighed_link in zip(
        some, cache.weighed(some, weigh(some, by_node, involved, s.consistency)), strict=True
    ):
        # Known aliased landmarks stay aliased.
        if link.key not in out or out[link.key].aliased < weighed_link.aliased:
            out[link.key] = weighed_link
    return out

"""Maps and verified links become a merged map: the whole of the merge after verification, as one function.

1. Maps are cut into pieces that their own edges connect; a robot's own claims must agree with its way.
2. The links between each two pieces, and the loops within one, are sorted by consistency.
3. Pieces are joined, best supported first, and the links between what is larger now are sorted anew. Links
   that would join what is joined already must agree with it.
4. Each component is optimised. Where few links are refused, each is tried once more by solving with it.
5. Where two robots would have been at the same place at the same time, the links that make them so are
   refuted, and it goes on at 2 with the rest.
6. Drives of a robot among others' nodes are checked against the outcome.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field

from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.node import MapId, NodeId
from mapweave.merge.mutual_exclusion.refutation import Refutation
from mapweave.merge.mutual_exclusion.trajectories import TrajectoryCache
from mapweave.merge.outlier_rejection.agglomerative_joining import agglomerate
from mapweave.merge.outlier_rejection.decision_cache import DecisionCache
from mapweave.merge.outlier_rejection.distinctness import weigh
from mapweave.merge.outlier_rejection.driven_edges import refuse_drives
from mapweave.merge.outlier_rejection.link_groups import LinkGroup
from mapweave.merge.outlier_rejection.readmission import readmitted
from mapweave.merge.pose_graph.candidates import Pair
from mapweave.merge.pose_graph.component_solver import ComponentSolver
from mapweave.merge.pose_graph.fragments import Fragment
from mapweave.merge.pose_graph.links import Link, RefusedLink
from mapweave.merge.pose_graph.merged_map import MergedMap, Poses
from mapweave.merge.pose_graph.solved_graph import PoseGraph
from mapweave.merge.settings import MergeSettings
from mapweave.merge.standing_decisions import StandingDecisions


@dataclass(frozen=True, eq=False)
class MergeCache:
    """What a merge found out that the next one with the same settings need not find out again.

    Attributes:
        decisions: fragments of maps, and links between them, sorted.
        trajectories: of the robots.
    """

    decisions: DecisionCache = field(default_factory=DecisionCache)
    trajectories: TrajectoryCache = field(default_factory=TrajectoryCache)


def merge_maps(
    maps: Mapping[MapId, HybridMap],
    links: Iterable[Link],
    refused: Iterable[RefusedLink] = (),
    settings: MergeSettings | None = None,
) -> MergedMap:
    """Merge.

    Args:
        maps: by id; they are not changed.
        links: verified, at most one a pair of nodes; those at nodes that are not there are left out.
        refused: pairs that were refused before, to be kept with their reasons.
        settings: how.

    Returns:
        The merged map. It does not depend on the order of maps, links or nodes.
    """
    return decide(maps, links, refused, settings or MergeSettings(), MergeCache())[0]


def decide(
    maps: Mapping[MapId, HybridMap],
    links: Iterable[Link],
    refused: Iterable[RefusedLink],
    settings: MergeSettings,
    cache: MergeCache,
    before: StandingDecisions | None = None,
) -> tuple[MergedMap, StandingDecisions]:
    """Merge, and tell what was decided, so that the next merge can begin from it.

    Args:
        maps: by id; they are not changed.
        links: verified, see `merge_maps`.
        refused: pairs that were refused before, to be kept with their reasons.
        settings: how.
        cache: of merges with the same settings.
        before: what stands of the same maps, as far as it is still true. A link keeps its decision until
            links between the same two maps come or go; None: all are decided.

    Returns:
        The merged map, and what stands now.
    """
    s = settings
    fragments = cache.decisions.fragments(maps, s.consistency)
    solver = ComponentSolver(fragments)
    by_node = solver.by_node
    given = {link.pair: link for link in links if link.a in by_node and link.b in by_node}
    standing = before or StandingDecisions()
    known = {pair for pair, link in given.items() if standing.given.get(pair) is link}
    news = (given.keys() - known) | (standing.given.keys() - known)
    fresh = {(given.get(pair) or standing.given[pair]).maps for pair in news}
    weighed = _weighed(given, standing, known, fresh, by_node, maps, cache.decisions, s)
    held = [link for pair, link in weighed.items() if pair in standing.believed and pair in known]
    refuted = standing.refuted & known
    closed = {
        pair
        for pair in standing.refused.keys() & known
        if weighed[pair].maps not in fresh and standing.together(*pair)
    }
    if before is not None:
        gone = [standing.weighed[pair] for pair in standing.believed - known]
        solver.resume(standing.graphs, standing.fragments, held, gone)
    refutation = Refutation(maps, fragments, s.exclusion, cache.trajectories)
    open_ = [link for pair, link in weighed.items() if pair not in refuted]
    groups = cache.decisions.groups(open_, by_node, s.consistency, refutation.verdict, exact=before is None)
    # Each round refutes a link at least, so there is a last one.
    while True:
        solved, kept, unjoined = _joined(solver, groups, held, closed, s, whole=before is None)
        impossible = refutation.impossible(solved, kept, None if before is None else solver.changed)
        if not impossible:
            break
        for key, reason in impossible.items():
            story = [link for link in kept if refutation.key_of(link) == key]
            groups[key] = groups[key].without(story, reason, s.consistency, refutation.verdict)
        fallen = {r.pair for group in groups.values() for r in group.refuted}
        held = [link for link in held if link.pair not in fallen]
    refutations = {r.pair: r for group in groups.values() for r in group.refuted}
    because = {pair: standing.refused[pair] for pair in closed | refuted}
    because |= {r.pair: r for r in unjoined} | refutations
    refusals = [r for r in refused if r.a in by_node and r.b in by_node] + list(because.values())
    refusals += [r for fragment in fragments for r in fragment.refused]
    refusals += refuse_drives(maps, solved, s.consistency)
    merged = MergedMap(
        dict(sorted(maps.items())),
        tuple(sorted((link.canonical() for link in kept), key=lambda link: link.pair)),
        tuple(sorted(refusals, key=lambda r: r.pair)),
        tuple(frozenset(graph.nodes) for graph in solved),
        Poses(solved),
        tuple(solved),
    )
    return merged, StandingDecisions(
        given,
        weighed,
        frozenset(link.pair for link in merged.links),
        because,
        frozenset(refuted | refutations.keys()),
        merged.graphs,
        tuple(fragments),
        len(given) if before is None else standing.size,
        0 if before is None else standing.changed + len(news),
    )


def _joined(
    solver: ComponentSolver,
    groups: Mapping[Pair, LinkGroup],
    held: Sequence[Link],
    closed: Set[Pair],
    s: MergeSettings,
    whole: bool,
) -> tuple[list[PoseGraph], list[Link], list[RefusedLink]]:
    """Join and optimise: the components, the links that are kept, and those that are not."""
    kept, unjoined = agglomerate(solver, groups, s.consistency, held, closed)
    solver.solve(kept, whole=whole)
    tried = [r.link for r in unjoined if r.link is not None]
    kept += readmitted(solver, kept, tried, s.consistency)
    told = {link.key for link in kept}
    return solver.solve(kept), kept, [r for r in unjoined if r.pair not in told]


def _weighed(
    given: Mapping[Pair, Link],
    standing: StandingDecisions,
    known: Set[Pair],
    fresh: Set[tuple[MapId, MapId]],
    by_node: Mapping[NodeId, Fragment],
    maps: Mapping[MapId, HybridMap],
    cache: DecisionCache,
    s: MergeSettings,
) -> dict[Pair, Link]:
    """Links with their doubles, which are looked for among those between maps of which links are new."""
    out = {pair: standing.weighed[pair] for pair in given if pair in known}
    some = [link for link in given.values() if link.maps in fresh]
    involved = {one: maps[one] for pair in fresh for one in pair if one in maps}
    for link, found in zip(
        some, cache.weighed(some, weigh(some, by_node, involved, s.consistency)), strict=True
    ):
        # What is known to be elsewhere too stays so, whoever is looked at.
        if link.key not in out or out[link.key].doubles < found.doubles:
            out[link.key] = found
    return out

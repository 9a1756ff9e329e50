"""Maps and verified links become a merged map: the whole of the merge after verification, as one function.

1. Maps are cut into pieces that their own edges connect; a robot's own claims must agree with its way.
2. The links between each two pieces, and the loops within one, are sorted by consistency.
3. Pieces are joined, best supported first, and the links between what is larger now are sorted anew. Links
   that would join what is joined already must agree with it.
4. Each component is optimised; a link that then strains more than it should is refused, worst first. Where
   few are refused, each is tried once more by solving with it.
5. Where two robots would have been at the same place at the same time, the links that make them so are
   refuted, and it goes on at 2 with the rest.
6. Drives of a robot among others' nodes are checked against the outcome.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from hybridmap.hybrid_map import HybridMap
from hybridmap.node import MapId
from merge.belief.agglomeration import agglomerate
from merge.belief.consistency import ConsistencySettings, group_links
from merge.belief.distinctness import weigh
from merge.belief.drives import refuse_drives
from merge.belief.joining import Outliers, Solver, optimise
from merge.belief.memory import Memory
from merge.belief.readmission import readmitted
from merge.bodies.refutation import Refutation
from merge.bodies.settings import ExclusionSettings
from merge.graph.links import Link, RefusedLink
from merge.graph.merged import MergedMap, Postures
from merge.graph.posegraph import HUBER


@dataclass(frozen=True)
class MergeSettings:
    """How maps are merged.

    Attributes:
        consistency: when links are believed.
        exclusion: when two robots would have been in one place.
        outliers: how links are found that the joined map does not bear out.
        strain: chi-square with 3 degrees of freedom above which an optimised link is refused.
    """

    consistency: ConsistencySettings = field(default_factory=ConsistencySettings)
    exclusion: ExclusionSettings = field(default_factory=ExclusionSettings)
    outliers: Outliers = Outliers.WORST_FIRST
    strain: float = 25.0

    @property
    def huber(self) -> float:
        """Normalised residual from which a link pulls no harder.

        Where the wrong ones are found out before the solution counts, none has to be held back.
        """
        return HUBER if self.outliers is Outliers.WORST_FIRST else math.inf


def merge_maps(
    maps: Mapping[MapId, HybridMap],
    links: Iterable[Link],
    refused: Iterable[RefusedLink] = (),
    settings: MergeSettings | None = None,
    memory: Memory | None = None,
) -> MergedMap:
    """Merge.

    Args:
        maps: by id; they are not changed.
        links: verified, at most one a pair of nodes; those at nodes that are not there are left out.
        refused: pairs that were refused before, to be kept with their reasons.
        settings: how.
        memory: of merges before with the same settings; what they have found out is not found out again.

    Returns:
        The merged map. It does not depend on the order of maps, links or nodes.
    """
    s = settings or MergeSettings()
    memory = memory or Memory()
    fragments = memory.fragments(maps, s.consistency, s.strain)
    solver = Solver(fragments, s.huber)
    by_node = solver.by_node
    refutation = Refutation(maps, solver, s.consistency, s.exclusion)
    present = [link for link in links if link.a in by_node and link.b in by_node]
    present = memory.weighed(present, weigh(present, by_node, maps, s.consistency))
    refusals = [r for r in refused if r.a in by_node and r.b in by_node]
    refusals += [r for fragment in fragments for r in fragment.refused]
    given = {link.canonical().pair: link for link in present}
    groups = {
        (first, second): memory.group(
            group,
            [given[link.canonical().pair] for link in group],
            by_node[first],
            by_node[second],
            s.consistency,
            refutation.verdict,
        )
        for (first, second), group in group_links(present, by_node).items()
    }
    # Each round refutes a link at least, so there is a last one.
    while True:
        kept, unjoined = agglomerate(solver, groups, s.consistency)
        solved, kept, strained = optimise(solver, kept, s.strain, s.outliers)
        if s.outliers is Outliers.WORST_FIRST:
            tried = [r.link for r in (*unjoined, *strained) if r.link is not None]
            if back := readmitted(solver, kept, tried, s.consistency):
                kept = [*kept, *back]
                solved = solver.solve(kept, believed=True)
                told = {link.canonical().pair for link in back}
                unjoined, strained = (
                    [r for r in some if r.pair not in told] for some in (unjoined, strained)
                )
        refuted = {key for key, group in groups.items() if group.refuted}
        impossible = refutation.impossible(solved, kept, refuted)
        if not impossible:
            break
        for key, reason in impossible.items():
            story = [link for link in kept if refutation.key_of(link) == key]
            groups[key] = groups[key].without(story, reason, s.consistency, refutation.verdict)
    refusals += [r for group in groups.values() for r in group.refuted] + unjoined + strained
    refusals += refuse_drives(maps, solved, s.consistency)
    return MergedMap(
        dict(sorted(maps.items())),
        tuple(sorted((link.canonical() for link in kept), key=lambda link: link.pair)),
        tuple(sorted(refusals, key=lambda r: r.pair)),
        tuple(frozenset(graph.nodes) for graph in solved),
        Postures(solved),
        tuple(solved),
    )

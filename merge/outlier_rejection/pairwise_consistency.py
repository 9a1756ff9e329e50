"""Which links agree: pairwise consistency, and the best supported consistent set.

Two links between the same two pieces of map close a loop: along one link, through one piece, back along the
other link, through the other piece. If both are right the loop comes back to where it began, within its
uncertainty (pairwise consistent measurement set maximisation, Mangelson et al., ICRA 2018). A false link, or
a set of links into a room that only looks the same, closes no loop with the true ones. The set that is kept
is the clique with the most landmarks, and it has to be clearly better than any that contradicts it. Links
between the same two places are not independent and count for less (see independent_support.py).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Array
from mapweave.merge.outlier_rejection.bent_maps import nearly_there
from mapweave.merge.outlier_rejection.independent_support import (
    NOTHING,
    ChanceSupport,
    Support,
    chances,
    crowds,
    neighbours,
    support_of,
)
from mapweave.merge.outlier_rejection.max_clique import best_clique, independent_links
from mapweave.merge.pose_graph.factors import LOOP_FLOOR
from mapweave.merge.pose_graph.fragments import Fragment
from mapweave.merge.pose_graph.links import Link, RefusedLink, place_distinct, refuse
from mapweave.merge.settings import ConsistencySettings
from mapweave.registration.pose_arrays import PoseGaussians

ALIASED = "is found at other places too"
"""Words of the reason why links with aliased landmarks are refused."""
CHANCE = 0.01
"""So many false sets at most may be expected between two pieces that are as good as the one that is
kept."""
EXACT = 40
"""Up to as many links the best clique is searched exhaustively, beyond greedily."""
LEAST_EVIDENCE = 4.6
"""Natural logarithm of the odds from which a link that is too little alone, or was contradicted, is
believed where others join its two ends: how many independent links are true for one that is false, times
Bayes' factor (see mapweave.merge.outlier_rejection.link_probability), which must speak for it."""


HUNDREDTHS = 100.0
"""Cliques are weighed in whole hundredths of a landmark."""


@dataclass(frozen=True, eq=False)
class Sorted:
    """Links between two pieces of map, sorted into kept and refused.

    Attributes:
        kept: mutually consistent and enough, or nothing.
        refused: the others, with reasons.
        rivals: two contradicting sets with equal support, if that is why nothing is kept.
        weight: landmarks behind the best set; links of one place count by the root of their number.
        sets: the best set, kept or not, and the best of those that contradict it.
        supports: behind these two.
    """

    kept: tuple[Link, ...]
    refused: tuple[RefusedLink, ...]
    rivals: tuple[tuple[Link, ...], ...] = ()
    weight: float = 0.0
    sets: tuple[tuple[Link, ...], tuple[Link, ...]] = ((), ())
    supports: tuple[Support, Support] = (NOTHING, NOTHING)

    def beyond_chance(self, false: ChanceSupport, s: ConsistencySettings) -> Sorted:
        """The same between two pieces that differ, knowing what false links are like.

        What is no more than chance makes is not kept, and contradicts nothing.

        Args:
            false: statistics of false places.
            s: when links are accepted.
        """
        real = [k for k in (0, 1) if self.supports[k].by_chance(false) < CHANCE]
        if len(real) == 2 or (self.kept and 0 in real):
            return self
        accepted = self.sets[real[0]] if real and not _too_little(self.sets[real[0]], s) else ()
        if not self.kept and not accepted:
            return self
        reason = (
            f"contradicts {len(accepted)} links, and agrees with no more than by chance"
            if accepted
            else f"as many agree by chance where {100.0 * false.share:.0f} % of the links are false"
        )
        keys = {link.key for link in accepted}
        every = [*self.kept, *(r.link for r in self.refused if r.link is not None)]
        refused = [refuse(link, reason) for link in every if link.key not in keys]
        refused.sort(key=lambda refusal: refusal.pair)
        return replace(self, kept=accepted, refused=tuple(refused), rivals=())


def loop_distances2(links: Sequence[Link], first: Fragment, second: Fragment) -> Array:
    """(N, N) squared normalised misclosures of the loops through each two links, 3 degrees of freedom.

    Args:
        links: each from a node of `first` (its a) to a node of `second` (its b).
        first: piece of map.
        second: piece of map; may be the same, then the links are loops within it.
    """
    return _loops(links, first, second)[0]


def _loops(links: Sequence[Link], first: Fragment, second: Fragment) -> tuple[Array, Array]:
    """(N, N) see `loop_distances2`; (N, N) m^2 rad, square roots of the determinants of their covariances."""
    n = len(links)
    i, j = np.triu_indices(n, 1)
    out, spreads = np.zeros((n, n)), np.ones((n, n))
    if len(i) == 0:
        return out, spreads
    across = PoseGaussians(
        np.stack([link.a_from_b.mean.vector for link in links]),
        np.stack([link.a_from_b.covariance for link in links]),
    )
    a = first.graph.index([link.a for link in links])
    b = second.graph.index([link.b for link in links])
    through_second = second.graph.relative_rows(b[i], b[j])
    through_first = first.graph.relative_rows(a[j], a[i])
    loop = across.take(i) @ through_second @ across.take(j).inverse() @ through_first
    loop = PoseGaussians(loop.means, loop.covariances + LOOP_FLOOR)
    out[i, j] = out[j, i] = loop.distances2()
    spreads[i, j] = spreads[j, i] = np.sqrt(np.linalg.det(loop.covariances))
    return out, spreads


DOMINANCE = 1.5
"""By how many times a set of links must surpass the best one that contradicts it. Without, 9 of 100 pairs of
robots with as many links to a similar place are joined falsely, with it none (docs/figures.md)."""
PLACE = 2.0
"""Nodes of a map that are nearer to each other see the same landmarks, m."""


def sort_links(
    links: Sequence[Link],
    first: Fragment,
    second: Fragment,
    settings: ConsistencySettings | None = None,
    dominance: float = DOMINANCE,
) -> Sorted:
    """Keep the best supported consistent set of the links between two pieces of map.

    Args:
        links: from nodes of `first` to nodes of `second`.
        first: piece of map.
        second: piece of map; may be the same.
        settings: when links are accepted.
        dominance: how many times the landmarks of a contradicting set the kept set must have, and how many
            times its independent places if that set would be believed without it.

    Returns:
        Kept and refused links, in the order of their nodes.
    """
    s = settings or ConsistencySettings()
    links = sorted(links, key=lambda link: link.pair)
    refused: list[RefusedLink] = []
    if first is second:
        links, refused = _against_odometry(links, first, s)
    if not links:
        return Sorted((), tuple(refused))
    distances2, spreads = _loops(links, first, second)
    agree, neighbouring = distances2 < s.gate, neighbours(links, first, second, PLACE)
    landmarks = np.array([link.weight for link in links])
    # Dependent links count by the root of their number.
    weights = landmarks / np.sqrt(crowds(agree, neighbouring))
    hundredths = np.maximum(np.rint(HUNDREDTHS * weights), 1).astype(np.int64)
    best = best_clique(agree, hundredths, EXACT)
    kept = [links[k] for k in best]
    reason = _too_little(kept, s)
    rival = _rival(agree, hundredths, best)
    support, against_it = int(landmarks[best].sum()), int(landmarks[rival].sum())
    weight, against = float(weights[best].sum()), float(weights[rival].sum())
    sets = tuple(kept), tuple(links[k] for k in rival)
    chance = chances(distances2, spreads, first, second)
    telling = np.array([link.telling for link in links])
    nearly = nearly_there(links, first, second)
    best_support, rival_support = (
        support_of(some, telling, agree, neighbouring, chance, nearly) for some in (best, rival)
    )
    rivals: tuple[tuple[Link, ...], ...] = ()
    # In number and in places: a single place may bring many links however false they are.
    if not reason and (against_it * dominance > support or against * dominance > weight):
        reason = f"ambiguous: {support} landmarks support one way of joining, {against_it} another"
        rivals = sets
    # Of two sets that would each be accepted alone one is false: landmarks and links do not show which.
    elif (
        not reason and not _too_little(sets[1], s) and best_support.places < dominance * rival_support.places
    ):
        places = f"{best_support.places:.1f} and {rival_support.places:.1f} independent places"
        reason = f"ambiguous: two ways of joining contradict each other, with {places} behind"
        rivals = sets
    for k, link in enumerate(links):
        if k not in best:
            contradicts = f"contradicts {len(best)} links with {support} landmarks between the same maps"
            refused.append(refuse(link, reason or contradicts))
        elif reason:
            refused.append(refuse(link, reason))
    return Sorted(
        () if reason else tuple(kept),
        tuple(sorted(refused, key=lambda refusal: refusal.pair)),
        rivals,
        weight,
        sets,
        (best_support, rival_support),
    )


def _against_odometry(
    links: Sequence[Link], fragment: Fragment, s: ConsistencySettings
) -> tuple[list[Link], list[RefusedLink]]:
    """A loop within a map must also agree with the map's own drive between the two nodes."""
    if not links:
        return [], []
    own = fragment.graph.relative([link.b for link in links], [link.a for link in links])
    measured = PoseGaussians(
        np.stack([link.a_from_b.mean.vector for link in links]),
        np.stack([link.a_from_b.covariance + LOOP_FLOOR for link in links]),
    )
    fits = (measured @ own).distances2() < s.gate
    refusals = [
        refuse(link, "contradicts the map's own way between its nodes")
        for link, good in zip(links, fits, strict=True)
        if not good
    ]
    return [link for link, good in zip(links, fits, strict=True) if good], refusals


def _rival(agree: NDArray[np.bool_], weights: NDArray[np.int64], best: list[int]) -> list[int]:
    """The best set among the links that agree with less than half of the kept ones."""
    rest = np.setdiff1d(np.arange(len(weights)), best)
    rest = rest[agree[rest][:, best].mean(axis=1) < 0.5] if best else rest
    clique = best_clique(agree[np.ix_(rest, rest)], weights[rest], EXACT)
    return [int(k) for k in rest[clique]]


OVERWHELMING_INLIERS = 45
"""A single link with as many landmarks ..."""
OVERWHELMING_SHARE = 0.7
"""... and this share of its matches joins them alone."""


def _too_little(kept: Sequence[Link], s: ConsistencySettings) -> str:
    """Why a consistent set does not suffice; empty if it does."""
    if not kept:
        return "no links"
    if not _identify(kept) and not any(_identify(rest) for rest in _without_each_robot(kept)):
        agree = "the link shows" if len(kept) == 1 else f"the {len(kept)} links that agree show"
        return f"most of what {agree} {ALIASED}"
    telling = [link for link in kept if link.telling]
    independent = independent_links(telling, s.least_links)
    if independent >= s.least_links:
        return ""
    for link in telling:
        share = link.evidence.get("share", 0.0)
        if link.weight >= OVERWHELMING_INLIERS and share >= OVERWHELMING_SHARE:
            return ""
    return f"no {s.least_links} links that share no node agree with each other, as they must"


def _identify(links: Sequence[Link]) -> bool:
    """Whether links that agree identify a place."""
    return any(link.telling for link in links) and place_distinct(links)


def _without_each_robot(links: Sequence[Link]) -> list[list[Link]]:
    """The links without those of one robot, for each robot. Of links between two robots nothing is left.

    What one robot alone shows at two places takes nothing from the links between others.
    """
    robots = sorted({node.agent for link in links for node in link.pair})
    return [[link for link in links if robot not in (link.a.agent, link.b.agent)] for robot in robots]


def group_links(
    links: Sequence[Link], by_node: Mapping[NodeId, Fragment]
) -> dict[tuple[NodeId, NodeId], list[Link]]:
    """Links by the names of the two pieces of map, smaller first; each link turned to that direction."""
    groups: dict[tuple[NodeId, NodeId], list[Link]] = {}
    for link in sorted(links, key=lambda link: link.pair):
        first, second = by_node[link.a].name, by_node[link.b].name
        if second < first:
            link = link.turned()
            first, second = second, first
        groups.setdefault((first, second), []).append(link)
    return groups

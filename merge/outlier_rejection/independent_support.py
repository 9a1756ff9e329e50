"""Independent support: on how many places a consistent set of links rests, and how likely that is by chance.

Links that agree are not independent. Where one place looks like another, all nodes near the first seem to be
near the second, and their links agree with each other although all are false: neighbours see the same
landmarks. So links whose ends are neighbours at both ends count as one place together. Agreement of distant
places on the relative pose of two maps is evidence, the stronger the more precise the maps are: the share of
all poses on the floor by which a loop would close as well is the probability that two unrelated links agree.
Of n aliased places any m may be those that agree. The share of false places, and how many links a false one
has, are measured on the fleet itself.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Array
from mapweave.merge.pose_graph.fragments import Fragment
from mapweave.merge.pose_graph.links import Link

LEAST_AREA = 4.0
"""What is mapped is never smaller than this, m^2: a single full turn."""
TRUST = 10.0
"""Prior count of true places: a few contradictions are no statistics."""
MOST = 32
"""Largest number of links of one place that is distinguished."""
Crowds = NDArray[np.int64]
"""(N,) how many links of a place agree with each, itself included: each counts as 1/n of a place."""


@dataclass(frozen=True, eq=False)
class Support:
    """What is behind a set of links between two pieces of map.

    Attributes:
        crowds: of the set.
        others: of all other links between the two that place them elsewhere.
        coincidence: how probable it is that two false links agree as well as the set's do.
    """

    crowds: Crowds
    others: Crowds
    coincidence: float = 1.0

    @property
    def places(self) -> float:
        """How many independent ones the set is."""
        return float((1.0 / self.crowds).sum())

    def by_chance(self, false: ChanceSupport) -> float:
        """Expected number of sets between the two that are as good and false.

        Either by how many places agree by chance and how many links these have in all, or by how many links
        a single one has.

        Args:
            false: statistics of false places.
        """
        if not len(self.crowds) or false.share <= 0.0:
            return 0.0
        m = max(self.places, 1.0)
        n = m + float((1.0 / self.others).sum())
        crowded = n * false.share * false.crowded(int(self.crowds.max()))
        sets = math.lgamma(n + 1.0) - math.lgamma(m + 1.0) - math.lgamma(n - m + 1.0)
        agreeing = sets + m * math.log(false.share) + (m - 1.0) * math.log(self.coincidence)
        agreeing += math.log(false.at_least_links(math.ceil(m - 1e-9), len(self.crowds)))
        return min(crowded, math.exp(min(agreeing, 700.0)))


NOTHING = Support(np.zeros(0, np.int64), np.zeros(0, np.int64))
"""Behind no link."""


@dataclass(frozen=True, eq=False)
class ChanceSupport:
    """Statistics of false places: those that the best sets between pieces leave out, since most are false.

    Attributes:
        true: how many are in the best sets.
        counts: (K,) how many are left out that bring 1, 2, ... K or more links.
    """

    true: float
    counts: Array

    @staticmethod
    def of(supports: Iterable[Support]) -> ChanceSupport:
        """Read them off what is behind the best set between each two pieces."""
        all_supports = list(supports)
        crowds = np.concatenate([np.zeros(0, np.int64), *(support.others for support in all_supports)])
        counts: Array = np.bincount(np.minimum(crowds, MOST) - 1, 1.0 / crowds, MOST).astype(np.float64)
        return ChanceSupport(sum(support.places for support in all_supports), counts)

    def without(self, own: ChanceSupport) -> ChanceSupport:
        """The statistics of all others: a pair is not judged by itself."""
        return ChanceSupport(max(self.true - own.true, 0.0), np.maximum(self.counts - own.counts, 0.0))

    @property
    def count(self) -> float:
        """How many."""
        return float(self.counts.sum())

    @property
    def share(self) -> float:
        """Share of false places."""
        return self.count / (self.true + self.count + TRUST)

    @property
    def log_odds(self) -> float:
        """Natural logarithm of how many are true for one that is false (Jeffreys' prior)."""
        return math.log((self.true + 0.5) / (self.count + 0.5))

    def crowded(self, links: int) -> float:
        """The share of them that bring as many links, or more.

        With one more place as a prior, for which each further link is as likely as none.
        """
        as_many = float(self.counts[min(links, MOST) - 1 :].sum())
        return (as_many + 0.5 ** (links - 1)) / (self.count + 1.0)

    def at_least_links(self, places: int, links: int) -> float:
        """The chance that so many of them bring as many links in all, or more."""
        if links <= places or places > MOST:
            # Where so many agree, their number is enough.
            return 1.0
        tails = np.array([self.crowded(k) for k in range(1, links + 2)])
        distribution = tails[:-1] - tails[1:]
        # Distribution of the links beyond the first of each place.
        fewer = np.ones(1)
        for _ in range(places):
            fewer = np.convolve(fewer, distribution)[: links - places]
        return max(1.0 - float(fewer.sum()), 1e-300)


def neighbours(links: Sequence[Link], first: Fragment, second: Fragment, place: float) -> NDArray[np.bool_]:
    """(N, N) whether two links are of the same place at either end, themselves included.

    Args:
        links: from nodes of `first` to nodes of `second`.
        first: piece of map.
        second: piece of map.
        place: nodes so near to each other are at one place, m.
    """
    both_near = _near([link.a for link in links], first, place) & _near(
        [link.b for link in links], second, place
    )
    out: NDArray[np.bool_] = both_near
    return out


def _near(nodes: Sequence[NodeId], piece: Fragment, place: float) -> NDArray[np.bool_]:
    at = piece.graph.means[piece.graph.index(nodes), :2]
    out: NDArray[np.bool_] = ((at[:, None] - at) ** 2).sum(axis=2) <= place**2
    return out


def crowds(agree: NDArray[np.bool_], neighbouring: NDArray[np.bool_]) -> Crowds:
    """(N,) how many links of a place agree with each, itself included.

    Args:
        agree: (N, N) symmetric; the diagonal does not matter.
        neighbouring: (N, N), see `neighbours`.
    """
    out: Crowds = (neighbouring & (agree | np.eye(len(neighbouring), dtype=bool))).sum(axis=1)
    return out


def chances(distances2: Array, spreads: Array, first: Fragment, second: Fragment) -> Array:
    """(N, N) how probable it is that two links which have nothing to do with each other agree as well.

    Args:
        distances2: (N, N) of loops, chi-square with 3 degrees of freedom.
        spreads: (N, N) square roots of the determinants of the covariances of loops, m^2 rad.
        first: piece of map.
        second: piece of map.
    """
    floor = max(LEAST_AREA, *(float(np.prod(np.ptp(f.graph.means[:, :2], axis=0))) for f in (first, second)))
    # Closer than one standard deviation is luck and counts no more.
    ellipsoids = 4.0 / 3.0 * math.pi * np.maximum(distances2, 1.0) ** 1.5 * spreads
    out: Array = np.minimum(ellipsoids / (floor * 2.0 * math.pi), 1.0)
    return out


def support_of(
    some: Sequence[int],
    telling: NDArray[np.bool_],
    agree: NDArray[np.bool_],
    neighbouring: NDArray[np.bool_],
    chance: Array,
    nearly: NDArray[np.bool_],
) -> Support:
    """The support of some of the links. Those without distinct landmarks do not count.

    Links outside the set that place the two maps nearly as it does are no false places: they show the same
    places, and the geometry of one map is wrong. No place that only looks like another is so near to it.

    Args:
        some: which.
        telling: (N,) see `Link.telling`.
        agree: (N, N) symmetric.
        neighbouring: (N, N), see `neighbours`.
        chance: (N, N), see `chances`.
        nearly: (N, N), see mapweave.merge.outlier_rejection.bent_maps.nearly_there.
    """
    outside = np.setdiff1d(np.flatnonzero(telling & ~nearly[some].any(axis=0)), some)
    some = [k for k in some if telling[k]]
    inside = np.ix_(some, some)
    apart = np.triu(~neighbouring[inside], 1)
    logarithms = np.log(chance[inside][apart])
    rest = np.ix_(outside, outside)
    return Support(
        crowds(agree[inside], neighbouring[inside]),
        crowds(agree[rest], neighbouring[rest]),
        math.exp(float(logarithms.mean())) if len(logarithms) else 1.0,
    )

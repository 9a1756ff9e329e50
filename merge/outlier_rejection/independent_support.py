"""Witnesses: how many independent ones a set of links is that agree, and how easily chance makes as many.

Links that agree are not each a witness. Where one place looks like another, all nodes near the one seem to
stand near the other, and their links agree with each other however false they are: neighbours see the same
landmarks. So links whose ends are neighbours at both ends are one witness together. That places which lie
apart agree on how two maps stand to each other is evidence, the more the better the maps themselves are
known: the share of all poses on the floor by which a loop would close as well is how probable it is that
two links which have nothing to do with each other agree. Of n places that look alike, any m may be those
that do. How many are false, and how many links a false one brings, is read off the fleet itself.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.node import NodeId
from mapweave.hybridmap.pose import Array
from mapweave.merge.pose_graph.fragments import Fragment
from mapweave.merge.pose_graph.links import Link

LEAST_AREA = 4.0
"""What is mapped is never smaller than this, m^2: a single look around."""
TRUST = 10.0
"""As if so many witnesses had been true before any was heard: a few that contradict are no rule."""
MOST = 32
"""Links of one place that are told apart by number; more are as many."""
Crowds = NDArray[np.int64]
"""(N,) how many links of a place agree with each, itself included: each is so small a part of a witness."""


@dataclass(frozen=True, eq=False)
class Support:
    """What is behind a set of links between two pieces of map.

    Attributes:
        crowds: of the set.
        others: of all other links between the two.
        coincidence: how probable it is that two false links agree as well as the set's do.
    """

    crowds: Crowds
    others: Crowds
    coincidence: float = 1.0

    @property
    def witnesses(self) -> float:
        """How many independent ones the set is."""
        return float((1.0 / self.crowds).sum())

    def by_chance(self, false: ChanceSupport) -> float:
        """Expected number of sets between the two that are as good and false.

        Either by how many witnesses agree by chance and how many links these bring in all, or by how many
        links a single one brings.

        Args:
            false: what false witnesses are like.
        """
        if not len(self.crowds) or false.share <= 0.0:
            return 0.0
        m = max(self.witnesses, 1.0)
        n = m + float((1.0 / self.others).sum())
        crowded = n * false.share * false.crowded(int(self.crowds.max()))
        sets = math.lgamma(n + 1.0) - math.lgamma(m + 1.0) - math.lgamma(n - m + 1.0)
        agreeing = sets + m * math.log(false.share) + (m - 1.0) * math.log(self.coincidence)
        agreeing += math.log(false.bringing(math.ceil(m - 1e-9), len(self.crowds)))
        return min(crowded, math.exp(min(agreeing, 700.0)))


NOTHING = Support(np.zeros(0, np.int64), np.zeros(0, np.int64))
"""Behind no link."""


@dataclass(frozen=True, eq=False)
class ChanceSupport:
    """What false witnesses are like: those that the best sets between pieces leave out, for most are false.

    Attributes:
        true: how many are in the best sets.
        counts: (K,) how many are left out that bring 1, 2, ... K or more links.
    """

    true: float
    counts: Array

    @staticmethod
    def of(supports: Iterable[Support]) -> ChanceSupport:
        """Read them off what is behind the best set between each two pieces."""
        found = list(supports)
        crowds = np.concatenate([np.zeros(0, np.int64), *(one.others for one in found)])
        counts: Array = np.bincount(np.minimum(crowds, MOST) - 1, 1.0 / crowds, MOST).astype(np.float64)
        return ChanceSupport(sum(one.witnesses for one in found), counts)

    def without(self, own: ChanceSupport) -> ChanceSupport:
        """What all others say: whoever is judged shall not be the measure of it."""
        return ChanceSupport(max(self.true - own.true, 0.0), np.maximum(self.counts - own.counts, 0.0))

    @property
    def count(self) -> float:
        """How many."""
        return float(self.counts.sum())

    @property
    def share(self) -> float:
        """Of all witnesses."""
        return self.count / (self.true + self.count + TRUST)

    @property
    def log_odds(self) -> float:
        """Natural logarithm of how many are true for one that is false (Jeffreys' prior)."""
        return math.log((self.true + 0.5) / (self.count + 0.5))

    def crowded(self, links: int) -> float:
        """The share of them that bring as many links, or more.

        As if one more had been heard of which nobody knows but that each further link is as likely as none.
        """
        as_many = float(self.counts[min(links, MOST) - 1 :].sum())
        return (as_many + 0.5 ** (links - 1)) / (self.count + 1.0)

    def bringing(self, witnesses: int, links: int) -> float:
        """The chance that so many of them bring as many links in all, or more."""
        if links <= witnesses or witnesses > MOST:
            # Where so many agree, their number tells enough.
            return 1.0
        tails = np.array([self.crowded(k) for k in range(1, links + 2)])
        one = tails[:-1] - tails[1:]
        # So many links beyond the one that each brings at least, and how probable that is.
        fewer = np.ones(1)
        for _ in range(witnesses):
            fewer = np.convolve(fewer, one)[: links - witnesses]
        return max(1.0 - float(fewer.sum()), 1e-300)


def neighbours(links: Sequence[Link], first: Fragment, second: Fragment, place: float) -> NDArray[np.bool_]:
    """(N, N) whether two links are of the same place at either end, themselves included.

    Args:
        links: from nodes of `first` to nodes of `second`.
        first: piece of map.
        second: piece of map.
        place: nodes so near to each other are at one place, m.
    """
    near = _near([link.a for link in links], first, place) & _near([link.b for link in links], second, place)
    out: NDArray[np.bool_] = near
    return out


def _near(nodes: Sequence[NodeId], piece: Fragment, place: float) -> NDArray[np.bool_]:
    at = piece.graph.means[piece.graph.index(nodes), :2]
    out: NDArray[np.bool_] = ((at[:, None] - at) ** 2).sum(axis=2) <= place**2
    return out


def crowds(agree: NDArray[np.bool_], near: NDArray[np.bool_]) -> Crowds:
    """(N,) how many links of a place agree with each, itself included.

    Args:
        agree: (N, N) symmetric; what the diagonal says does not matter.
        near: (N, N), see `neighbours`.
    """
    out: Crowds = (near & (agree | np.eye(len(near), dtype=bool))).sum(axis=1)
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
    # Nobody is nearer than by luck: from one standard deviation on nearer says no more.
    ellipsoids = 4.0 / 3.0 * math.pi * np.maximum(distances2, 1.0) ** 1.5 * spreads
    out: Array = np.minimum(ellipsoids / (floor * 2.0 * math.pi), 1.0)
    return out


def support_of(
    some: Sequence[int],
    telling: NDArray[np.bool_],
    agree: NDArray[np.bool_],
    near: NDArray[np.bool_],
    chance: Array,
) -> Support:
    """What is behind some of the links. Those that tell no place are no witnesses, neither true nor false.

    Args:
        some: which.
        telling: (N,) see `Link.telling`.
        agree: (N, N) symmetric.
        near: (N, N), see `neighbours`.
        chance: (N, N), see `chances`.
    """
    others = np.setdiff1d(np.flatnonzero(telling), some)
    some = [k for k in some if telling[k]]
    inside = np.ix_(some, some)
    apart = np.triu(~near[inside], 1)
    logarithms = np.log(chance[inside][apart])
    rest = np.ix_(others, others)
    return Support(
        crowds(agree[inside], near[inside]),
        crowds(agree[rest], near[rest]),
        math.exp(float(logarithms.mean())) if len(logarithms) else 1.0,
    )

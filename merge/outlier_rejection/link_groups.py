"""Groups: all links between two pieces of map, and what has become of them so far."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapweave.merge.outlier_rejection.pairwise_consistency import Sorted, loop_distances2, sort_links
from mapweave.merge.pose_graph.fragments import Fragment
from mapweave.merge.pose_graph.links import Link, RefusedLink, refuse
from mapweave.merge.settings import ConsistencySettings

Verdict = Callable[[Sequence[Link]], str]
"""Why a set of links that agree cannot be true, in words; empty if it can."""


@dataclass(frozen=True, eq=False)
class LinkGroup:
    """The links between two pieces of map.

    Attributes:
        first: piece of map.
        second: piece of map; the same for loops within it.
        links: that may be true, from `first` to `second`.
        sorted: what consistency makes of them.
        given: all that there were at first.
        refuted: those that cannot be true.
    """

    first: Fragment
    second: Fragment
    links: tuple[Link, ...]
    sorted: Sorted
    given: tuple[Link, ...] = ()
    refuted: tuple[RefusedLink, ...] = ()

    @staticmethod
    def of(
        links: Sequence[Link], first: Fragment, second: Fragment, s: ConsistencySettings, verdict: Verdict
    ) -> LinkGroup:
        """Sort links; where two sets contradict each other and neither prevails, one may be impossible."""
        sorted_links = sort_links(links, first, second, s)
        return LinkGroup(first, second, tuple(links), sorted_links, tuple(links))._settled(s, verdict)

    @property
    def refused(self) -> tuple[RefusedLink, ...]:
        """All links that are not kept."""
        return self.sorted.refused + self.refuted

    def without(
        self, refuted: Sequence[Link], reason: str, s: ConsistencySettings, verdict: Verdict
    ) -> LinkGroup:
        """The rest get their chance when a set of links is refuted.

        Args:
            refuted: links that agree and cannot be true; those that agree with most of them are refuted too.
            reason: in words.
            s: when links are accepted.
            verdict: on sets that now have equal support.
        """
        return self._without(refuted, reason, s)._settled(s, verdict)

    def _without(self, refuted: Sequence[Link], reason: str, s: ConsistencySettings) -> LinkGroup:
        keys = {link.key for link in refuted}
        in_set = np.array([link.key in keys for link in self.links])
        agree = loop_distances2(self.links, self.first, self.second) < s.gate
        falls = in_set | (agree[:, in_set].mean(axis=1) > 0.5)
        left = tuple(link for link, fallen in zip(self.links, falls, strict=True) if not fallen)
        fallen = tuple(refuse(link, reason) for link, fallen in zip(self.links, falls, strict=True) if fallen)
        sorted_links = sort_links(left, self.first, self.second, s)
        return replace(self, links=left, sorted=sorted_links, refuted=self.refuted + fallen)

    def _settled(self, s: ConsistencySettings, verdict: Verdict) -> LinkGroup:
        group = self
        while group.sorted.rivals:
            reasons = [(links, verdict(links)) for links in group.sorted.rivals]
            impossible = [(links, reason) for links, reason in reasons if reason]
            if not impossible:
                break
            group = group._without(*impossible[0], s)
        return group

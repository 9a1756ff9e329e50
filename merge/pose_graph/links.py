"""Links: two nodes that show the same place, found by looking, and what became of them."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.explanation import ALIASED
from mapweave.hybridmap.ids import MERGE_AUTHOR, EdgeId, MapId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind
from mapweave.hybridmap.pose import PoseGaussian
from mapweave.merge.pose_graph.factors import RelativePose

LEAST_DISTINCT = 10
"""A link with aliased and fewer other landmarks identifies no place: a recognition needs as many."""
AGAINST = 2
"""Of links that agree, an aliased landmark counts against them as much as so many distinct landmarks count
for them. In warehouses most landmarks of a false link are aliased (some 60 %), and few of a true one (some 15
%): log(0.60 / 0.15) is about twice log(0.85 / 0.40)."""


@dataclass(frozen=True, eq=False)
class Link:
    """Two nodes, of two maps or of one, that were recognised to see the same landmarks.

    Attributes:
        a: the smaller id.
        b: the greater id.
        a_from_b: pose of b's robot frame in a's.
        shared: (K, 2) int64, landmark indices in a and in b.
        evidence: of mapweave.registration.recognition.
    """

    a: NodeId
    b: NodeId
    a_from_b: PoseGaussian
    shared: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    evidence: dict[str, float] = field(default_factory=dict)

    @cached_property
    def pair(self) -> tuple[NodeId, NodeId]:
        """(a, b)."""
        return self.a, self.b

    @cached_property
    def key(self) -> tuple[NodeId, NodeId]:
        """The two nodes, smaller id first: there is at most one link between two nodes."""
        return (self.a, self.b) if self.a <= self.b else (self.b, self.a)

    @cached_property
    def maps(self) -> tuple[MapId, MapId]:
        """The maps of the two nodes, smaller first; twice the same for a loop."""
        return self.key[0].map, self.key[1].map

    @property
    def within(self) -> bool:
        """Whether both nodes belong to one map: a loop."""
        return self.a.map == self.b.map

    @property
    def aliased(self) -> int:
        """Landmarks that agree and are known to be found at other places too."""
        return int(self.evidence.get(ALIASED, 0.0))

    @property
    def weight(self) -> int:
        """How much counts for it: landmarks that agree and are not aliased, at least 1."""
        return max(int(self.evidence.get("inliers", 1.0)) - self.aliased, 1)

    @property
    def telling(self) -> bool:
        """Whether its landmarks identify a place."""
        return self.aliased == 0 or self.weight >= LEAST_DISTINCT

    def turned(self) -> Link:
        """The same link seen from its other end; turned twice it is itself."""
        return self._turned

    @cached_property
    def _turned(self) -> Link:
        reversed_link = Link(self.b, self.a, self.a_from_b.inverse(), self.shared[:, ::-1], self.evidence)
        reversed_link.__dict__["_turned"] = self
        return reversed_link

    @cached_property
    def measurement(self) -> RelativePose:
        """Its relative pose of the two nodes; it may be wrong."""
        return RelativePose(self.a, self.b, self.a_from_b, robust=True)

    def canonical(self) -> Link:
        """The same link with the smaller id first."""
        return self if self.a <= self.b else self.turned()

    def edge(self) -> Edge:
        """The same as an edge of the merged map; its id depends on the two nodes alone."""
        digest = hashlib.blake2b(f"{self.a} {self.b}".encode(), digest_size=6).digest()
        edge_id = EdgeId(MERGE_AUTHOR, 0, int.from_bytes(digest, "big"))
        kind = EdgeKind.LOOP if self.within else EdgeKind.MERGED
        return Edge(edge_id, self.a, self.b, self.a_from_b, kind, self.shared, dict(self.evidence))


@dataclass(frozen=True, eq=False)
class RefusedLink:
    """Two similar nodes that were not joined.

    Attributes:
        a: the smaller id.
        b: the greater id.
        reason: in words.
        link: the geometry that was found, or None if not even that.
        edge: the robot's own edge, if the robot joined them.
    """

    a: NodeId
    b: NodeId
    reason: str
    link: Link | None = None
    edge: EdgeId | None = None

    @property
    def pair(self) -> tuple[NodeId, NodeId]:
        """(a, b)."""
        return self.a, self.b


def link_of(edge: Edge) -> Link:
    """An edge as a link, the smaller id first."""
    return Link(edge.a, edge.b, edge.a_from_b, edge.shared, edge.evidence).canonical()


def refuse(link: Link, reason: str) -> RefusedLink:
    """Refuse a link whose geometry was found."""
    link = link.canonical()
    return RefusedLink(link.a, link.b, reason, link)


def refuse_edge(edge: Edge, reason: str) -> RefusedLink:
    """Refuse a robot's own edge."""
    return replace(refuse(link_of(edge), reason), edge=edge.id)


def thinned(links: Sequence[Link], most: int) -> list[Link]:
    """Keep so many links at most, evenly by id: the order in which they were found has no effect."""
    ordered = sorted(links, key=lambda link: link.key)
    chosen = np.unique(np.linspace(0, len(ordered) - 1, most).round().astype(np.int64))
    return [ordered[k] for k in chosen.tolist()]


def place_distinct(links: Sequence[Link]) -> bool:
    """Whether links that agree identify a place together."""
    aliased = sum(link.aliased for link in links)
    return aliased == 0 or sum(link.weight for link in links) - AGAINST * aliased >= LEAST_DISTINCT

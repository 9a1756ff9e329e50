"""Results of comparing nodes: their overlaps, and the verdicts on pairs.

All of it depends on two nodes alone. So it outlives its process, as long as both nodes are unchanged; that is
tested by fingerprints of all that a comparison uses.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping, Set
from dataclasses import dataclass, field
from typing import Annotated

from msgspec import Meta

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.merge.pose_graph.candidates import Pair
from mapweave.merge.pose_graph.verdicts import Verdict

Overlap = Annotated[float, Meta(gt=0.0)]
PRINT_BYTES = 16
"""Of a digest: two of a million nodes have the same with a chance below 1e-26."""


@dataclass(frozen=True, eq=False)
class VerificationCache:
    """Results of verifying pairs of some nodes.

    Attributes:
        prints: of the nodes that were compared with all others that there were.
        overlaps: between them; pairs that are left out share too little.
        verdicts: on pairs of them.
    """

    prints: Mapping[NodeId, bytes] = field(default_factory=dict)
    overlaps: Mapping[Pair, float] = field(default_factory=dict)
    verdicts: Mapping[Pair, Verdict] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.verdicts)

    def joined(self, later: VerificationCache) -> VerificationCache:
        """These results and later ones, which count where both have any."""
        known = self.extended(RecentComparisons(later.prints, later.prints.keys(), later.overlaps))
        return VerificationCache(known.prints, known.overlaps, {**known.verdicts, **later.verdicts})

    def besides(self, earlier: VerificationCache) -> VerificationCache:
        """What of these results is not in earlier ones just so; both together are these."""
        overlaps = {pair: v for pair, v in self.overlaps.items() if earlier.overlaps.get(pair) != v}
        verdicts = {pair: v for pair, v in self.verdicts.items() if earlier.verdicts.get(pair) is not v}
        nodes = {node for node, print_ in self.prints.items() if earlier.prints.get(node) != print_}
        nodes |= {node for pair in (*overlaps, *verdicts) for node in pair}
        return VerificationCache({n: self.prints[n] for n in nodes & self.prints.keys()}, overlaps, verdicts)

    def extended(self, recent: RecentComparisons) -> VerificationCache:
        """These results and later ones. What was found of nodes that were others since is left out."""
        prints = {n: p for n, p in self.prints.items() if recent.prints.get(n, p) == p}
        others = self.prints.keys() - prints.keys()
        overlaps = {pair: value for pair, value in self.overlaps.items() if others.isdisjoint(pair)}
        verdicts = {pair: verdict for pair, verdict in self.verdicts.items() if others.isdisjoint(pair)}
        prints |= {node: recent.prints[node] for node in recent.compared}
        return VerificationCache(prints, overlaps | dict(recent.overlaps), verdicts)


@dataclass(frozen=True)
class RecentComparisons:
    """What was compared since a verification cache was saved; it is little.

    Attributes:
        prints: of all nodes.
        compared: nodes of these that were compared with all others that there were.
        overlaps: of these with others; pairs that are left out share too little.
    """

    prints: Mapping[NodeId, bytes] = field(default_factory=dict)
    compared: Set[NodeId] = frozenset()
    overlaps: Mapping[Pair, Overlap] = field(default_factory=dict)


class CachedVerifications:
    """Results of another process, for nodes that are unchanged."""

    def __init__(self, findings: VerificationCache) -> None:
        self._findings = findings
        self._overlaps: dict[NodeId, dict[NodeId, float]] = {}
        for (a, b), value in findings.overlaps.items():
            self._overlaps.setdefault(a, {})[b] = value
            self._overlaps.setdefault(b, {})[a] = value
        self._compared: dict[NodeId, list[NodeId]] = {}
        for a, b in findings.verdicts:
            self._compared.setdefault(a, []).append(b)
            self._compared.setdefault(b, []).append(a)
        self._checked: dict[NodeId, tuple[Node, bool]] = {}

    def knows(self, node: Node) -> bool:
        """Whether this very node was compared."""
        entry = self._checked.get(node.id)
        if entry is None or entry[0] is not node:
            before = self._findings.prints.get(node.id)
            entry = self._checked[node.id] = node, before is not None and before == fingerprint_of(node)
        return entry[1]

    def overlaps(self, node: Node, node_of: Callable[[NodeId], Node | None]) -> dict[NodeId, float]:
        """Overlaps of a node that it knows, with others that it knows."""
        out = {}
        for candidate_id, value in self._overlaps.get(node.id, {}).items():
            candidate = node_of(candidate_id)
            if candidate is not None and self.knows(candidate):
                out[candidate_id] = value
        return out

    def pairs_of(self, node_id: NodeId) -> list[Pair]:
        """The pairs of a node, as it was then, that were compared; those that share enough if none was."""
        others = self._compared.get(node_id) or [*self._overlaps.get(node_id, {})]
        return [(node_id, other) for other in others]

    def verdicts(self, node_of: Callable[[NodeId], Node | None]) -> Iterable[tuple[Pair, Verdict]]:
        """Verdicts on pairs of nodes that it knows."""
        for pair, verdict in self._findings.verdicts.items():
            a, b = node_of(pair[0]), node_of(pair[1])
            if a is not None and b is not None and self.knows(a) and self.knows(b):
                yield pair, verdict


def fingerprint_of(node: Node) -> bytes:
    """A checksum of all that a comparison uses."""
    landmarks = node.landmarks
    digest = hashlib.blake2b(f"{node.id} {node.camera}".encode(), digest_size=PRINT_BYTES)
    for column in (landmarks.pixels, landmarks.codes, landmarks.depths, landmarks.depth_sigmas):
        digest.update(column.tobytes())
    return digest.digest()

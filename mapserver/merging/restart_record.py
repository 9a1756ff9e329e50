"""What a restarted server goes on from besides the verification cache: what the last merge had superseded.

Which nodes are superseded depends on the order in which changes came, and a restarted server gets all at
once. It holds for the nodes as they were, which is tested by fingerprints: of others nothing is used.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Set
from dataclasses import dataclass, field

from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.superseded import Superseded
from mapweave.mapserver.merging.verification_cache import RecentComparisons
from mapweave.merge.map_maintenance.node_superseding import Superseding
from mapweave.merge.map_maintenance.superseding_log import SupersedingLog
from mapweave.merge.pose_graph.candidates import Pair


@dataclass(frozen=True)
class RestartRecord:
    """What a server needs to take up one merge after a restart.

    Attributes:
        recent: what was compared since the verification cache was saved, with the fingerprints of all nodes.
        judged: nodes of these that were in the merged map.
        superseded: nodes, and why.
        linked: pairs of nodes with a link.
        unsure: maps that may not be right.
        log: what the last merges changed; it may name nodes that are gone.
    """

    recent: RecentComparisons = field(default_factory=RecentComparisons)
    judged: Set[NodeId] = frozenset()
    superseded: Mapping[NodeId, Superseded] = field(default_factory=dict)
    linked: Set[Pair] = frozenset()
    unsure: Set[MapId] = frozenset()
    log: SupersedingLog = field(default_factory=SupersedingLog)

    @staticmethod
    def of(superseding: Superseding, recent: RecentComparisons) -> RestartRecord:
        """What is kept of a merge."""
        judged = frozenset(superseding.judged.keys() & recent.prints.keys())
        superseded = {n: s for n, s in superseding.superseded.items() if n in judged and s.by in judged}
        linked = frozenset(pair for pair in superseding.linked if judged.issuperset(pair))
        return RestartRecord(recent, judged, superseded, linked, superseding.unsure, superseding.log)

    def unchanged(self, prints: Mapping[NodeId, bytes]) -> Set[NodeId]:
        """The nodes that were there and are just as they were.

        Args:
            prints: fingerprints of the nodes as they are.
        """
        return {node for node, one in self.recent.prints.items() if prints.get(node) == one}

    def superseding(self, unchanged: Set[NodeId], node_of: Callable[[NodeId], Node | None]) -> Superseding:
        """What a superseder goes on from.

        Args:
            unchanged: nodes that are just as they were; others are judged again.
            node_of: gives a node as it is.
        """
        nodes = ((node_id, node_of(node_id)) for node_id in self.judged & unchanged)
        judged = {node_id: node for node_id, node in nodes if node is not None}
        superseded = {n: s for n, s in self.superseded.items() if n in judged and s.by in judged}
        return Superseding(superseded, judged, self.linked, self.unsure, self.log)

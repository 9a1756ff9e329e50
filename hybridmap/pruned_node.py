"""Pruned nodes: superseded ones that have left the map for good, with what is left of each."""

from collections.abc import Container, Mapping
from dataclasses import dataclass, field

from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.limits import Stamp
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.wall_time import utc_words


@dataclass(frozen=True, slots=True)
class PrunedNode:
    """What is left of a node.

    Attributes:
        by: the node that superseded it; it may have left the map since.
        by_from_node: its pose there, by the map as it was then.
        stamp_ns: when it left the map, wall time since 1970.
    """

    by: NodeId
    by_from_node: Pose2
    stamp_ns: Stamp


@dataclass(frozen=True)
class PrunedNodes:
    """All of a fleet. A node that its robot has sent again since is in the map like any other.

    Attributes:
        nodes: by id.
    """

    nodes: Mapping[NodeId, PrunedNode] = field(default_factory=dict)
    maps: frozenset[MapId] = field(init=False)

    def __post_init__(self) -> None:
        """Note of which maps there are any."""
        maps = {node[:2] for node in self.nodes}
        object.__setattr__(self, "maps", frozenset(MapId(*one) for one in maps))

    def __contains__(self, node: object) -> bool:
        """Whether a node was pruned once."""
        return node in self.nodes

    def __len__(self) -> int:
        return len(self.nodes)

    def successor(self, node: NodeId, present: Container[NodeId]) -> tuple[NodeId, Pose2] | None:
        """The node of the map that replaces a pruned one, and the pruned node's pose there.

        Returns:
            The node itself if it is present; None if nothing is left of it.
        """
        successor_from_node, passed = Pose2(), set[NodeId]()
        while node not in present:
            left = self.nodes.get(node)
            # A node that was sent again, and pruned again, may have replaced its own successor.
            if left is None or node in passed:
                return None
            passed.add(node)
            node, successor_from_node = left.by, left.by_from_node @ successor_from_node
        return node, successor_from_node

    def words(self, node: NodeId, present: Container[NodeId]) -> str:
        """In words: `r0.1.5 left the map on 2026-03-01 14:00 UTC: r0.9.3 replaces it`."""
        stands = self.successor(node, present)
        now = "nothing is left of its place" if stands is None else f"{stands[0]} replaces it"
        return f"{node} left the map on {utc_words(self.nodes[node].stamp_ns)}: {now}"

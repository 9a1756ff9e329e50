"""Changes: a map is the replay of its log."""

from dataclasses import dataclass

from mapweave.hybridmap.ids import EdgeId, MapId, NodeId
from mapweave.hybridmap.node import Edge, Node


@dataclass(frozen=True)
class NodePut:
    """A node is new, or known better."""

    node: Node


@dataclass(frozen=True)
class NodeRetired:
    """A node, and every edge at it, is no longer part of the map."""

    id: NodeId


@dataclass(frozen=True)
class EdgePut:
    """An edge is new, or known better."""

    edge: Edge


@dataclass(frozen=True)
class EdgeRetired:
    """An edge is no longer part of the map."""

    id: EdgeId


ChangeBody = NodePut | NodeRetired | EdgePut | EdgeRetired


@dataclass(frozen=True)
class Change:
    """One entry of a map's log.

    Attributes:
        map: whose log.
        sequence: 1, 2, 3 ... without gaps.
        stamp_ns: when the agent made it.
        body: what changed.
    """

    map: MapId
    sequence: int
    stamp_ns: int
    body: ChangeBody

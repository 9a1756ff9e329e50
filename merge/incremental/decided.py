"""What a merge in steps has decided, so that another process can go on from it."""

from __future__ import annotations

from collections.abc import Mapping, Set
from dataclasses import dataclass, field

from hybridmap.node import NodeId
from hybridmap.pose import Pose2
from merge.graph.candidates import Pair


@dataclass(frozen=True, eq=False)
class Decided:
    """Of islands that are merged in steps.

    Attributes:
        believed: pairs of nodes whose links are.
        places: where nodes are, in their component's frame.
    """

    believed: Set[Pair] = frozenset()
    places: Mapping[NodeId, Pose2] = field(default_factory=dict)

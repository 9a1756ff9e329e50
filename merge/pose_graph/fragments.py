"""Fragments: pieces of map that hold together by themselves."""

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property

from mapweave.hybridmap.ids import NodeId
from mapweave.merge.pose_graph.factors import Factors, RelativePose
from mapweave.merge.pose_graph.links import RefusedLink
from mapweave.merge.pose_graph.solved_graph import PoseGraph


@dataclass(frozen=True, eq=False)
class Fragment:
    """Nodes of one map that its own edges connect, with the poses that these edges give.

    Attributes:
        name: the smallest id in it.
        graph: solved poses; the smallest id is held at its own pose.
        measurements: the accepted edges.
        refused: loops of the robot's own that are not.
    """

    name: NodeId
    graph: PoseGraph
    measurements: tuple[RelativePose, ...]
    refused: tuple[RefusedLink, ...] = ()

    @property
    def nodes(self) -> tuple[NodeId, ...]:
        """The nodes in the order of ids."""
        return self.graph.nodes

    @cached_property
    def factors(self) -> Factors:
        """Its measurements between the rows of its nodes."""
        row = self.graph.rows
        a, b = [row[m.a] for m in self.measurements], [row[m.b] for m in self.measurements]
        return Factors.of(self.measurements, a, b)

    def __len__(self) -> int:
        return len(self.graph.nodes)


def fragment_by_node(fragments: Collection[Fragment]) -> dict[NodeId, Fragment]:
    """Which fragment each node belongs to."""
    return {node: fragment for fragment in fragments for node in fragment.nodes}

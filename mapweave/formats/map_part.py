"""A part of a merged map that is one, as others' tools want it: numbered places and measurements."""

from dataclasses import dataclass
from functools import cached_property

from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import EdgeId, NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Pose2
from mapweave.merge.manual_constraints import apply_constraints
from mapweave.merge.outlier_rejection.link_probability import link_probabilities
from mapweave.merge.outlier_rejection.segmentation import fragments_of
from mapweave.merge.pose_graph.factors import RelativePose
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.refusals import check_component

IDENTITY = Pose2()


@dataclass(frozen=True, eq=False)
class MapPart:
    """One component of a merged map.

    Attributes:
        merged: the whole map.
        component: its number, 0 is the largest.
        frame_from_merged: takes coordinates of the component to those that are written.
    """

    merged: MergedMap
    component: int = 0
    frame_from_merged: Pose2 = IDENTITY

    def __post_init__(self) -> None:
        """Refuse a component that is not there (Refused)."""
        check_component(self.component, len(self.merged.components))

    @cached_property
    def nodes(self) -> tuple[NodeId, ...]:
        """The nodes in the order of ids."""
        return tuple(sorted(self.merged.components[self.component]))

    @cached_property
    def numbers(self) -> dict[NodeId, int]:
        """0, 1, 2 ... by node: others' tools know no ids like ours."""
        return {node: k for k, node in enumerate(self.nodes)}

    @cached_property
    def graph(self) -> HybridMap:
        """Nodes and edges of the part, links among them; what is refused is not there."""
        whole = self.merged.union()
        for node in [node for node in whole.nodes if node not in self.numbers]:
            del whole.nodes[node]
        for edge in list(whole.edges.values()):
            if edge.a not in self.numbers or edge.b not in self.numbers:
                del whole.edges[edge.id]
        return whole

    @cached_property
    def links(self) -> frozenset[EdgeId]:
        """Which edges are links, found by looking."""
        return frozenset(link.edge().id for link in self.merged.links)

    @cached_property
    def probabilities(self) -> dict[tuple[NodeId, NodeId], float]:
        """The probabilities of the links."""
        return link_probabilities(self.merged)

    @property
    def measurements(self) -> list[RelativePose]:
        """Those whose optimum the poses are."""
        left = apply_constraints(self.merged.maps, (), self.merged.constraints).maps
        own = [m for fragment in fragments_of(left) for m in fragment.measurements]
        links = [RelativePose(*link.pair, link.a_from_b, robust=True) for link in self.merged.links]
        return [m for m in (*own, *links) if m.a in self.numbers]

    def node(self, node: NodeId) -> Node:
        """A node."""
        return self.merged.maps[node.map].nodes[node]

    def pose(self, node: NodeId) -> Pose2:
        """Pose in the frame that is written."""
        return self.frame_from_merged @ self.merged.pose(node)

"""The merged map: the union of the maps, the links that join them, and one pose a node."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.change import EdgePut
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraints, reason_of
from mapweave.hybridmap.pin import Pin
from mapweave.hybridmap.pose import Pose2, PoseGaussian, nearest_covariance
from mapweave.hybridmap.pruned_node import PrunedNodes
from mapweave.hybridmap.superseded import Superseded
from mapweave.merge.pose_graph.links import Link, RefusedLink

if TYPE_CHECKING:
    from mapweave.merge.pose_graph.solved_graph import PoseGraph

MOST_NAMES = 20
"""Maps that are named where one is mistyped."""
NEAREST = 4
"""Nodes that are named where one is mistyped: their numbers have gaps."""


class Placement(NamedTuple):
    """Where a node is in the merged map.

    Attributes:
        component: number of the component, 0 is the largest.
        merged_from_robot: pose in the component's frame, which is the map frame of the component's
            smallest node id, unless a pin holds it (mapweave.merge.pose_graph.pinned_frames).
    """

    component: int
    merged_from_robot: PoseGaussian


class NodePoses(Mapping[NodeId, Placement]):
    """The poses of all nodes of some solved components, worked out when they are asked for."""

    def __init__(self, graphs: Sequence[PoseGraph]) -> None:
        self._graphs = tuple(graphs)
        self._numbers: dict[tuple[str, int], list[int]] = {}
        for number, graph in enumerate(self._graphs):
            for map_id in graph.maps:
                self._numbers.setdefault(map_id, []).append(number)

    def number(self, node: NodeId) -> int | None:
        """The number of the node's component; None if it is not there."""
        for number in self._numbers.get(node[:2], ()):
            if node in self._graphs[number].rows:
                return number
        return None

    def pose(self, node: NodeId) -> Pose2:
        """Where a node is, without covariance, which costs more than all the rest.

        Raises:
            KeyError: it is not there.
        """
        number = self.number(node)
        if number is None:
            raise KeyError(node)
        return self._graphs[number].pose(node)

    def __getitem__(self, node: NodeId) -> Placement:
        """Component and pose of a node."""
        number = self.number(node)
        if number is None:
            raise KeyError(node)
        return Placement(number, self._graphs[number].pose_gaussian(node))

    def all(self) -> dict[NodeId, Placement]:
        """Those of all nodes: in a large map much quicker than one by one, not to the last bit the same."""
        return {
            node: Placement(number, pose)
            for number, graph in enumerate(self._graphs)
            for node, pose in graph.poses().items()
        }

    def __contains__(self, node: object) -> bool:
        return isinstance(node, NodeId) and self.number(node) is not None

    def __iter__(self) -> Iterator[NodeId]:
        """All nodes, component by component."""
        return (node for graph in self._graphs for node in graph.nodes)

    def __len__(self) -> int:
        return sum(len(graph.nodes) for graph in self._graphs)


class WrongGeometry(NamedTuple):
    """A map that contradicts others, see mapweave.merge.outlier_rejection.wrong_geometry.

    Attributes:
        which: the map.
        agreeing: maps that agree with each other and not with it, at least two.
    """

    which: MapId
    agreeing: tuple[MapId, ...]

    @property
    def reason(self) -> str:
        """In words: `map r3.1 contradicts r0.1 and r1.1, which agree: its geometry is wrong`."""
        *most, last = map(str, self.agreeing)
        return (
            f"map {self.which} contradicts {', '.join(most)} and {last}, which agree: its geometry is wrong"
        )


@dataclass(frozen=True, eq=False)
class MergedMap:
    """A merge of maps. It keeps the maps as they are, for explanations and for merging again without a link.

    Attributes:
        maps: the maps, by id.
        links: that join nodes, in the order of their ids.
        refused: similar pairs that were not joined, with reasons.
        components: nodes that belong together, largest first.
        poses: of all nodes.
        graphs: the solved graph of each component, for covariances between nodes.
        constraints: manual constraints; the refused pairs say which of them took effect.
        superseded: nodes that newer ones of the same place replace, see
            mapweave.merge.map_maintenance.node_superseding. They still constrain poses; answers use the other
            nodes.
        faded: (N,) of nodes, which of their landmarks have faded, see
            mapweave.merge.map_maintenance.landmark_removal. Nodes without faded landmarks are left out.
        set_apart: maps that are not among these, because the merge fails with them or they are copies, and
            why.
        copies: those of them that are copies of other maps, which a person may link all the same.
        implausible: maps in which is what no robot can have measured, and what; see
            mapweave.mapserver.plausibility.
        wrong: maps with wrong geometry. Their links to other maps are refused for this reason.
        contradicted: links by hand that the rest of the map contradicts, by their nodes, and how.
        pins: people's pins of components' frames, oldest first.
        refused_changes: maps of which a server refused a change, and why. Their links to other maps are
            refused, unless a person links the two.
        disbelieved: maps of which something that was said is not believed, and why; they are implausible.
        pruned: superseded nodes that have left the maps. What they measured is in marginal links, see
            mapweave.merge.pose_graph.marginalization.
    """

    maps: Mapping[MapId, HybridMap]
    links: tuple[Link, ...]
    refused: tuple[RefusedLink, ...]
    components: tuple[frozenset[NodeId], ...]
    poses: Mapping[NodeId, Placement]
    graphs: tuple[PoseGraph, ...] = ()
    constraints: ManualConstraints = field(default_factory=ManualConstraints)
    superseded: Mapping[NodeId, Superseded] = field(default_factory=dict)
    faded: Mapping[NodeId, NDArray[np.bool_]] = field(default_factory=dict)
    set_apart: Mapping[MapId, str] = field(default_factory=dict)
    copies: Mapping[MapId, HybridMap] = field(default_factory=dict)
    implausible: Mapping[MapId, str] = field(default_factory=dict)
    wrong: Mapping[MapId, WrongGeometry] = field(default_factory=dict)
    contradicted: Mapping[tuple[NodeId, NodeId], str] = field(default_factory=dict)
    pins: tuple[Pin, ...] = ()
    refused_changes: Mapping[MapId, str] = field(default_factory=dict)
    disbelieved: Mapping[MapId, str] = field(default_factory=dict)
    pruned: PrunedNodes = field(default_factory=PrunedNodes)

    @staticmethod
    def empty() -> MergedMap:
        """No maps."""
        return MergedMap({}, (), (), (), {})

    def pose(self, node: NodeId) -> Pose2:
        """Where a node is in its component's frame, without covariance: quick also in a large map."""
        if isinstance(self.poses, NodePoses):
            return self.poses.pose(node)
        return self.poses[node].merged_from_robot.mean

    def component_of(self, node: NodeId) -> int | None:
        """Number of the node's component."""
        if isinstance(self.poses, NodePoses):
            return self.poses.number(node)
        placement = self.poses.get(node)
        return None if placement is None else placement.component

    def relative(self, a: NodeId, b: NodeId) -> PoseGaussian | None:
        """Pose `a_from_b` through the whole merged map; None if nothing joins them."""
        component = self.component_of(a)
        if component is None or component != self.component_of(b):
            return None
        poses = self.graphs[component].relative([a], [b])
        return PoseGaussian(Pose2.from_vector(poses.means[0]), nearest_covariance(poses.covariances[0]))

    def check(self, end: NodeId | MapId) -> None:
        """Refuse a node or a map that is not there.

        Raises:
            InvalidValue: the message lists what there is.
        """
        which = MapId(*end[:2])
        hybrid_map = self.maps.get(which)
        if isinstance(end, NodeId) and end in self.pruned and end not in self.poses:
            raise InvalidValue(self.pruned.words(end, self.poses))
        if hybrid_map is None and which in self.pruned.maps:
            raise InvalidValue(f"map {which} has left the map: newer nodes have superseded all of its nodes")
        if which in self.set_apart:
            raise InvalidValue(f"map {which} is set apart: {self.set_apart[which]}")
        if hybrid_map is None:
            names = [str(name) for name in self.maps]
            some = ", ".join(names[:MOST_NAMES]) or "none"
            more = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
            raise InvalidValue(f"there is no map {which}; known are: {some}{more}")
        if isinstance(end, NodeId) and end not in hybrid_map.nodes:
            numbers = sorted(node.number for node in hybrid_map.nodes)
            nearest = sorted(sorted(numbers, key=lambda number: abs(number - end.number))[:NEAREST])
            some = f"of its {len(numbers)} nodes the nearest are {', '.join(map(str, nearest))}"
            span = some if numbers else "it has none"
            raise InvalidValue(f"map {which} has no node {end.number}; {span}")

    def why_left_out(self, node: NodeId) -> str:
        """Why a node has no merged pose: what retires it, or sets its map apart; empty if neither does."""
        retired, apart = self.constraints.retires(node), self.set_apart.get(node.map)
        if retired is not None:
            return reason_of(retired)
        return f"map {node.map} is set apart: {apart}" if apart is not None else ""

    def accusations(self) -> dict[MapId, str]:
        """What is held against maps, in a few words each."""
        wrong = {which: verdict.reason for which, verdict in self.wrong.items()}
        implausible = {
            which: f"map {which} is implausible: {reason}" for which, reason in self.implausible.items()
        }
        apart = {which: f"map {which} is set apart: {reason}" for which, reason in self.set_apart.items()}
        return implausible | wrong | apart

    def joined(self, first: MapId, second: MapId) -> bool:
        """Whether any node of one map is in one component with any of the other."""
        return any(
            any(node.map == first for node in component) and any(node.map == second for node in component)
            for component in self.components
        )

    def union(self) -> HybridMap:
        """All nodes and edges of all maps in one graph, with the links as edges.

        A robot's own loop closures and drives that were refused are left out.
        """
        whole = HybridMap()
        false = {refusal.edge for refusal in self.refused}
        for map_id in sorted(self.maps):
            for change in self.maps[map_id].contents():
                if not (isinstance(change, EdgePut) and change.edge.id in false):
                    whole.apply(change)
        for link in self.links:
            whole.apply(EdgePut(link.edge()))
        return whole

    def explain(self, a: NodeId, b: NodeId) -> str:
        """Why two nodes are linked, or are not, in one sentence."""
        pair = (a, b) if a <= b else (b, a)
        for link in self.links:
            if link.pair == pair:
                numbers = ", ".join(f"{key} {value:.3g}" for key, value in sorted(link.evidence.items()))
                return f"{link.a} and {link.b} are linked: {numbers}"
        for refusal in self.refused:
            if refusal.pair == pair:
                return f"{refusal.a} and {refusal.b} are not linked: {refusal.reason}"
        return f"{a} and {b} were not compared: they share too few similar features"

    def counts(self) -> dict[str, int]:
        """How many of what there is, by name; links are between maps, loops within one."""
        loops = sum(link.within for link in self.links)
        return {
            "nodes": len(self.poses),
            "superseded": len(self.superseded),
            "maps": len(self.maps),
            "components": len(self.components),
            "links": len(self.links) - loops,
            "loops": loops,
            "refused": sum(refusal.link is not None for refusal in self.refused),
            "constraints": len(self.constraints.in_force),
            "set_apart": len(self.set_apart),
        }

    def summary(self) -> str:
        """In one line: `17 nodes, 3 maps, 2 components, 5 links, 1 loop, 2 refused, 4 superseded`.

        Links are between maps, loops within one; superseded nodes and retired maps count as nodes and maps;
        retired nodes count as no nodes.
        """
        counts = self.counts()
        named = [
            (counts[name], name)
            for name in ("nodes", "maps", "components", "links", "loops")
            if name != "loops" or counts[name]
        ]
        words = [f"{count} {name[:-1] if count == 1 else name}" for count, name in named]
        nodes = len(self.constraints.nodes)
        more = (
            (counts["superseded"], "superseded"),
            (len(self.constraints.retired), "retired"),
            (nodes, "retired node" if nodes == 1 else "retired nodes"),
            (counts["set_apart"], "set apart"),
        )
        words += [f"{counts['refused']} refused", *(f"{count} {word}" for count, word in more if count)]
        return ", ".join(words)

"""Moves the components of a merged map as a whole, so that pinned nodes have their poses.

Without a pin, the smallest node of a component is where its own robot has it: when two components join, one
of them gets the other's frame. A pin holds the frame of its component instead, and if several are in one
component, the oldest of them does.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pin import Pin
from mapweave.hybridmap.pose import Pose2
from mapweave.merge.pose_graph.component import Component
from mapweave.merge.pose_graph.merged_map import MergedMap, NodePoses
from mapweave.merge.pose_graph.solved_graph import PoseGraph
from mapweave.registration.pose_arrays import compose_poses


class FrameChange(NamedTuple):
    """A pin that does not hold its component's frame.

    Attributes:
        pinned: its node.
        holding: the node of the older pin that does; None: the pinned node is not in the merged map.
        now_from_pinned: takes coordinates in the frame of the pin to those in the component's frame now.
    """

    pinned: NodeId
    holding: NodeId | None
    now_from_pinned: Pose2


class PinnedFrames:
    """Keeps what it has moved: a component that did not change is the same object the next time."""

    def __init__(self) -> None:
        self._moved: dict[int, tuple[PoseGraph, Pin, PoseGraph]] = {}

    def moved(self, merged: MergedMap, pins: Sequence[Pin]) -> MergedMap:
        """A merged map with its components where pins hold them.

        Args:
            merged: with components in their own frames.
            pins: oldest first; those of nodes that are not there do nothing.
        """
        holding = holding_pins(merged, pins)
        graphs = tuple(
            self._graph(graph, holding[number]) if number in holding else graph
            for number, graph in enumerate(merged.graphs)
        )
        kept = {id(graph) for graph in merged.graphs}
        self._moved = {key: entry for key, entry in self._moved.items() if key in kept}
        if not pins:
            return merged
        return replace(
            merged, graphs=graphs, poses=NodePoses(graphs) if holding else merged.poses, pins=tuple(pins)
        )

    def _graph(self, graph: PoseGraph, pin: Pin) -> PoseGraph:
        known = self._moved.get(id(graph))
        if known is not None and known[1] == pin:
            return known[2]
        assert isinstance(graph, Component), "the solver's"
        motion = pin.merged_from_node @ graph.pose(pin.node).inverse()
        means = compose_poses(motion.vector[None], graph.means)
        # The pin is exact, also where the sum of the headings is not.
        means[graph.rows[pin.node]] = pin.merged_from_node.vector
        out = Component(pin.node, graph.nodes, means, graph.factors, graph.unsettled)
        self._moved[id(graph)] = graph, pin, out
        return out


def holding_pins(merged: MergedMap, pins: Sequence[Pin]) -> dict[int, Pin]:
    """The pin that holds the frame of each component that has one.

    Args:
        merged: the map.
        pins: oldest first.
    """
    out: dict[int, Pin] = {}
    for pin in pins:
        number = merged.component_of(pin.node)
        if number is not None:
            out.setdefault(number, pin)
    return out


def frame_changes(merged: MergedMap) -> tuple[FrameChange, ...]:
    """Pins of a merged map that do not hold a frame, oldest first."""
    holding = holding_pins(merged, merged.pins)
    out = []
    for pin in merged.pins:
        number = merged.component_of(pin.node)
        if number is None:
            out.append(FrameChange(pin.node, None, Pose2()))
        elif holding[number].node != pin.node:
            change = merged.pose(pin.node) @ pin.merged_from_node.inverse()
            out.append(FrameChange(pin.node, holding[number].node, change))
    return tuple(out)

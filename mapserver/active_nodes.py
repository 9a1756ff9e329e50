"""The active nodes, from which questions are answered."""

from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import replace
from typing import Protocol

import numpy as np

from mapweave.hybridmap.constraint_subject import RetiredWindow
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.query import View
from mapweave.mapserver.plausibility import LEAST_NODES, fragments, unreliable_robots
from mapweave.mapserver.retrieval.compared_landmarks import bounded
from mapweave.mapserver.retrieval.ranking import Ranked
from mapweave.mapserver.wire_limits import FARTHEST
from mapweave.merge.pose_graph.merged_map import MergedMap


class NodeRetrieval(Protocol):
    """Finds nodes, but for some; for example mapweave.mapserver.retrieval.place_database.PlaceDatabase."""

    def query(self, view: View, k: int = 5, exclude: Collection[NodeId] = ()) -> Ranked:
        """At most k nodes with how much they look like a view, best first."""


class ActiveNodes:
    """The place database without superseded and misplaced nodes, without nodes and maps retired or set
    apart, and nodes without what has faded.

    It belongs to one merged map; make another for the next. New nodes are compared with all of the database.
    """

    def __init__(
        self,
        places: NodeRetrieval,
        node_of: Callable[[NodeId], Node | None],
        merged: MergedMap,
        set_apart: Iterable[NodeId] = (),
    ) -> None:
        """Take a merged map and the index.

        Args:
            places: all nodes, also those not in the merged map yet.
            node_of: gives a node by its id as its robot sent it.
            merged: with the superseded, retired, set apart and faded.
            set_apart: the nodes of maps that are set apart.
        """
        self._places, self._node_of, self._merged = places, node_of, merged
        self._left_out = frozenset((*merged.constraints.retired, *merged.set_apart))
        left_out = (
            node for map_id in self._left_out if map_id in merged.maps for node in merged.maps[map_id].nodes
        )
        retired = merged.constraints.nodes
        self._inactive = frozenset(
            (*left_out, *retired, *set_apart, *_misplaced(merged), *_adrift(merged), *_out_of_range(merged))
        )
        windows = (constraint.about for constraint in merged.constraints.in_force)
        self._windows = tuple(about for about in windows if isinstance(about, RetiredWindow))
        # What an inactive node has replaced is still needed.
        replaced = (node for node, one in merged.superseded.items() if one.by not in self._inactive)
        self._hidden = self._inactive.union(replaced)

    def query(self, view: View, k: int = 5) -> Ranked:
        """At most k active nodes with their similarity to a view, best first."""
        ranked = self._places.query(view, k, exclude=self._hidden)
        # A retired map's robot may have mapped on.
        kept = ((node, score) for node, score in ranked if node.map not in self._left_out)
        return Ranked(kept, ranked.missing)

    def node(self, node_id: NodeId) -> Node | None:
        """A node without its faded landmarks; None if it is inactive or unknown."""
        if node_id in self._inactive or node_id.map in self._left_out:
            return None
        found_node = self._node_of(node_id)
        # A robot may have mapped on in a time window that is retired.
        if found_node is None or any(window.holds(found_node) for window in self._windows):
            return None
        return bounded(without_faded(found_node, self._merged))


def doubted(merged: MergedMap) -> list[NodeId]:
    """Nodes of implausible maps, of maps with wrong geometry, and of robots that have little else.

    They are no second place where a robot could be: where other maps give a certain answer without them, they
    make it neither ambiguous nor another one. Where no other map does they answer.
    """
    maps = {map_id: one for map_id, one in merged.maps.items() if map_id not in merged.constraints.retired}
    odd = merged.wrong.keys() | merged.implausible.keys()
    unreliable = unreliable_robots(maps, odd, merged.pruned.maps)
    return [
        node
        for map_id, one in maps.items()
        if map_id in odd or map_id.agent in unreliable
        for node in one.nodes
    ]


def _misplaced(merged: MergedMap) -> Iterator[NodeId]:
    """Nodes of maps with wrong geometry, of implausible maps and of fragments that show places of other maps.

    Each is at the same place as the node that it is linked to, seen by a robot whose map has it elsewhere: it
    is no second place where a robot could be. Unlinked nodes of such a map are still used.
    """
    maps = {map_id: one for map_id, one in merged.maps.items() if map_id not in merged.constraints.retired}
    wrong = {*merged.wrong, *merged.implausible, *fragments(maps, merged.pruned.maps)}
    for refusal in merged.refused if wrong else ():
        if refusal.link is not None and not refusal.link.within:
            ends = [node for node in refusal.pair if node.map in wrong]
            if len(ends) == 1:
                yield ends[0]


def _adrift(merged: MergedMap) -> Iterator[NodeId]:
    """Nodes of fragments, and of small pieces of implausible maps, that nothing joins with a larger map.

    An answer from there would be of no use.
    """
    small, odd = set(fragments(merged.maps, merged.pruned.maps)), merged.implausible.keys()
    for graph in merged.graphs if small or odd else ():
        if graph.maps <= small or (graph.maps <= odd and len(graph.nodes) < LEAST_NODES):
            yield from graph.nodes


def _out_of_range(merged: MergedMap) -> Iterator[NodeId]:
    """Nodes further away than robots drive. A frame's origin is arbitrary, so distances decide."""
    for graph in merged.graphs:
        # Written so that NaN is out of range. Most components are smaller than that, which is soon seen.
        positions = graph.means[:, :2]
        if (np.ptp(positions, axis=0) <= FARTHEST).all():
            continue
        away = np.abs(positions - np.median(positions, axis=0))
        inside = (away <= FARTHEST).all(axis=1)
        yield from (graph.nodes[k] for k in np.flatnonzero(~inside).tolist())


def without_faded(node: Node, merged: MergedMap) -> Node:
    """A node without its faded landmarks: the same object if there are none."""
    faded = merged.faded.get(node.id)
    # A node that was written again since then is taken as it is.
    if faded is None or len(faded) != len(node.landmarks):
        return node
    return replace(node, landmarks=node.landmarks.take(~faded))

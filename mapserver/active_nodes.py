"""The living places: what questions are answered from, of all that the server knows."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import replace
from typing import Protocol

import numpy as np

from mapweave.hybridmap.node import Node, NodeId
from mapweave.hybridmap.query import View
from mapweave.mapserver.retrieval.compared_landmarks import bounded
from mapweave.mapserver.wire_limits import FARTHEST
from mapweave.merge.pose_graph.merged_map import MergedMap


class Places(Protocol):
    """Finds nodes, but for some; for example mapweave.mapserver.retrieval.place_database.PlaceDatabase."""

    def query(self, view: View, k: int = 5, exclude: Collection[NodeId] = ()) -> list[tuple[NodeId, float]]:
        """At most k nodes with how much they look like a view, best first."""
        ...


class ActiveNodes:
    """The place database without superseded and misplaced nodes and maps retired or set apart, and nodes
    without what has faded.

    It stands for one merged map; make another for the next. New nodes are compared with all of the database.
    """

    def __init__(
        self,
        places: Places,
        node_of: Callable[[NodeId], Node | None],
        merged: MergedMap,
        set_apart: Iterable[NodeId] = (),
    ) -> None:
        """Take what is known.

        Args:
            places: all nodes, also such as are not in the merged map yet.
            node_of: gives a node by its id as its robot told it.
            merged: says what is superseded, retired, set apart or faded.
            set_apart: the nodes of maps that are set apart.
        """
        self._places, self._node_of, self._merged = places, node_of, merged
        self._left_out = frozenset((*merged.rulings.retired, *merged.set_apart))
        left_out = (node for one in self._left_out if one in merged.maps for node in merged.maps[one].nodes)
        self._gone = frozenset((*left_out, *set_apart, *_misplaced(merged), *_out_of_range(merged)))
        self._hidden = self._gone.union(merged.superseded)

    def query(self, view: View, k: int = 5) -> list[tuple[NodeId, float]]:
        """At most k living nodes with how much they look like a view, best first."""
        ranked = self._places.query(view, k, exclude=self._hidden)
        # A retired map's robot may have mapped on.
        return [(node, score) for node, score in ranked if node.map not in self._left_out]

    def node(self, node_id: NodeId) -> Node | None:
        """A node with the landmarks that are thought to be there; None if it is gone, or nothing is told of
        it.
        """
        if node_id in self._gone or node_id.map in self._left_out:
            return None
        known = self._node_of(node_id)
        return None if known is None else bounded(without_faded(known, self._merged))


def _misplaced(merged: MergedMap) -> Iterator[NodeId]:
    """Nodes of maps with wrong geometry that show places of other maps.

    Each is the same place as the node that it is linked to, seen by a robot that has it elsewhere: no second
    place that a robot could be at. What such a map knows alone is told as before.
    """
    for refusal in merged.refused if merged.wrong else ():
        if refusal.link is not None and not refusal.link.within:
            ends = [node for node in refusal.pair if node.map in merged.wrong]
            if len(ends) == 1:
                yield ends[0]


def _out_of_range(merged: MergedMap) -> Iterator[NodeId]:
    """Nodes that lie where no robot can be. Where the origin of a frame is says nothing; distances do."""
    for graph in merged.graphs:
        # Written so that NaN is out of range.
        away = np.abs(graph.means[:, :2] - np.median(graph.means[:, :2], axis=0))
        inside = (away <= FARTHEST).all(axis=1)
        yield from (graph.nodes[k] for k in np.flatnonzero(~inside).tolist())


def without_faded(node: Node, merged: MergedMap) -> Node:
    """A node with the landmarks that are thought to be there: the very same one if all are."""
    faded = merged.faded.get(node.id)
    # A node that has been put anew since then is taken as it is.
    if faded is None or len(faded) != len(node.landmarks):
        return node
    return replace(node, landmarks=node.landmarks.take(~faded))

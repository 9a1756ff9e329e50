"""Sheets: what a large merge keeps of each map, and the one graph that all of them make."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from hybridmap.hybrid_map import HybridMap
from hybridmap.node import MapId, NodeId
from hybridmap.pose import Array, Pose2
from hybridmap.recognising.pose_arrays import compose_poses
from merge.graph.candidates import Pair
from merge.graph.fragments import Fragment
from merge.graph.links import Link, RefusedLink
from merge.graph.posegraph import Measurement
from merge.incremental.factors import Factors, Rows
from merge.incremental.graph import WideGraph

MapPair = tuple[MapId, MapId]
"""Smaller first; twice the same for links within a map."""


@dataclass(frozen=True, eq=False)
class Sheet:
    """One map in a large merge.

    Attributes:
        one: the map.
        fragments: pieces of it.
        nodes: in the order of ids.
        rows: of the nodes.
        factors: its own measurements that are believed.
        means: (N, 3) m, m, rad, where the nodes are in the merged map.
        undone: claims of it that people have ruled out.
        clocked: whether any of its nodes has a clock that others may share.
    """

    one: HybridMap
    fragments: tuple[Fragment, ...]
    nodes: tuple[NodeId, ...]
    rows: Mapping[NodeId, int]
    factors: Factors
    means: Array
    undone: tuple[RefusedLink, ...] = ()
    clocked: bool = False

    @staticmethod
    def of(
        one: HybridMap,
        fragments: Iterable[Fragment],
        known: Mapping[NodeId, Pose2],
        undone: Iterable[RefusedLink] = (),
    ) -> Sheet:
        """Place a map's nodes: where they were, else beside the nearest that was there, else as it says.

        Args:
            one: the map.
            fragments: pieces of it.
            known: where nodes were in the merged map.
            undone: claims of it that people have ruled out.
        """
        pieces = tuple(fragments)
        nodes = tuple(sorted(one.nodes))
        rows = {node: k for k, node in enumerate(nodes)}
        measurements = [m for piece in pieces for m in piece.measurements]
        factors = Factors.of(
            measurements, [rows[m.a] for m in measurements], [rows[m.b] for m in measurements]
        )
        means = np.zeros((len(nodes), 3))
        for piece in pieces:
            there = [node for node in piece.nodes if node in known]
            numbers = np.array([node.number for node in there])
            for node in piece.nodes:
                pose = known.get(node)
                if pose is None and there:
                    near = there[int(np.abs(numbers - node.number).argmin())]
                    pose = known[near] @ (piece.graph.pose(near).inverse() @ piece.graph.pose(node))
                means[rows[node]] = (pose or piece.graph.pose(node)).vector
        clocked = any(node.clock for node in one.nodes.values())
        return Sheet(one, pieces, nodes, rows, factors, means, tuple(undone), clocked)

    def said(self) -> set[tuple[NodeId, NodeId, Pose2]]:
        """Its own measurements."""
        return {(m.a, m.b, m.a_from_b.mean) for piece in self.fragments for m in piece.measurements}

    def known(self) -> dict[NodeId, Pose2]:
        """Where its nodes are."""
        return {node: Pose2.from_vector(mean) for node, mean in zip(self.nodes, self.means, strict=True)}


@dataclass(frozen=True, eq=False)
class Bundle:
    """Links that are believed between two maps, or within one, and the same in columns."""

    links: dict[Pair, Link]
    factors: Factors

    @staticmethod
    def of(links: Mapping[Pair, Link], first: Sheet, second: Sheet) -> Bundle:
        """Of links from nodes of the one map to nodes of the other."""
        measured = [Measurement(link.a, link.b, link.a_from_b, robust=True) for link in links.values()]
        a, b = [first.rows[pair[0]] for pair in links], [second.rows[pair[1]] for pair in links]
        return Bundle(dict(links), Factors.of(measured, a, b))


class Assembly:
    """All sheets and bundles as one graph, with rows for all nodes."""

    def __init__(self, sheets: Mapping[MapId, Sheet], bundles: Mapping[MapPair, Bundle]) -> None:
        """Put them together."""
        self._maps = sorted(sheets)
        self._sheets = sheets
        counts = [len(sheets[one].nodes) for one in self._maps]
        self._starts = np.concatenate([[0], np.cumsum(counts)])
        self._start = dict(zip(self._maps, self._starts.tolist(), strict=False))
        own = [sheets[one].factors for one in self._maps]
        self._own = sum(map(len, own))
        self._pairs = sorted(bundles)
        self._bundles = bundles
        between = [bundles[pair].factors for pair in self._pairs]
        self._bundle_starts = self._own + np.concatenate([[0], np.cumsum([len(f) for f in between])])
        starts = [(self._start[one], self._start[one]) for one in self._maps]
        starts += [(self._start[pair[0]], self._start[pair[1]]) for pair in self._pairs]
        self.factors = Factors.together([*own, *between], starts)
        self.means: Array = np.concatenate([np.zeros((0, 3)), *(sheets[one].means for one in self._maps)])
        n = len(self.means)
        ties = sparse.coo_matrix(
            (np.ones(len(self.factors), np.int8), (self.factors.a, self.factors.b)), shape=(n, n)
        )
        self.labels: Rows = connected_components(ties, directed=False)[1].astype(np.int64)

    def row(self, node: NodeId) -> int:
        """Of a node."""
        return int(self._start[node.map]) + self._sheets[node.map].rows[node]

    def rows(self, nodes: Iterable[NodeId]) -> Rows:
        """(K,) of nodes."""
        return np.array([self.row(node) for node in nodes], np.int64)

    def one_of(self, nodes: Iterable[NodeId]) -> int | None:
        """The row of the first of some nodes that is there; None if none is."""
        there = (n for n in nodes if n.map in self._start and n in self._sheets[n.map].rows)
        node = next(there, None)
        return None if node is None else self.row(node)

    def label(self, node: NodeId) -> int:
        """Of the component of a node."""
        return int(self.labels[self.row(node)])

    def label_of(self) -> dict[NodeId, int]:
        """Of the component of each node."""
        nodes = (node for one in self._maps for node in self._sheets[one].nodes)
        return dict(zip(nodes, self.labels.tolist(), strict=True))

    def anchors(self) -> Rows:
        """The row of the smallest node of each component: rows are in the order of ids."""
        out: Rows = np.unique(self.labels, return_index=True)[1]
        return out

    def believed(self, rows: Rows) -> tuple[list[Link], Rows]:
        """Believed links at some rows, and their measurements."""
        index = self.factors.at(rows)
        index = index[index >= self._own]
        seats = np.searchsorted(self._bundle_starts, index, side="right") - 1
        lists: dict[int, list[Link]] = {}
        links = []
        for k, seat in zip(index.tolist(), seats.tolist(), strict=True):
            if seat not in lists:
                lists[seat] = list(self._bundles[self._pairs[seat]].links.values())
            links.append(lists[seat][k - int(self._bundle_starts[seat])])
        return links, index

    def means_of(self, one: MapId) -> Array:
        """(N, 3) where the nodes of a map are."""
        start = self._start[one]
        return self.means[start : start + len(self._sheets[one].nodes)]

    def nodes_at(self, rows: NDArray[np.int64]) -> Sequence[NodeId]:
        """Nodes of ascending rows."""
        seats = np.searchsorted(self._starts, rows, side="right") - 1
        local = (rows - self._starts[seats]).tolist()
        names = [self._sheets[one].nodes for one in self._maps]
        return [names[seat][k] for seat, k in zip(seats.tolist(), local, strict=True)]

    def lay_together(self, before: Assembly, joins: Iterable[tuple[NodeId, NodeId, Pose2]]) -> None:
        """Lay components beside each other: of two the smaller one is moved.

        Args:
            before: the graph in which they are apart.
            joins: a node of one component, a node of another, and how the second stands to the first.
        """
        labels = before.labels.copy()
        for first, second, first_from_second in joins:
            a, b = self.row(first), self.row(second)
            some, others = labels == labels[a], labels == labels[b]
            if some.sum() < others.sum():
                a, b, some, others = b, a, others, some
                first_from_second = first_from_second.inverse()
            self._carry(others, b, Pose2.from_vector(self.means[a]) @ first_from_second)
            labels[others] = labels[a]

    def in_their_frames(self) -> None:
        """Lay each component so that its smallest node is where its own map has it."""
        for row, node in zip(self.anchors().tolist(), self.nodes_at(self.anchors()), strict=True):
            wanted = self._sheets[node.map].one.nodes[node].map_from_robot.mean
            if Pose2.from_vector(self.means[row]) != wanted:
                self._carry(self.labels == self.labels[row], row, wanted)

    def _carry(self, some: NDArray[np.bool_], row: int, wanted: Pose2) -> None:
        """Move some nodes as one, so that one of them is where it is wanted."""
        motion = wanted @ Pose2.from_vector(self.means[row]).inverse()
        self.means = self.means.copy()
        self.means[some] = compose_poses(motion.vector[None], self.means[some])
        self.means[row] = wanted.vector

    def graph(self, label: int, huber: float) -> WideGraph:
        """A component by itself."""
        rows, index = self._parts[label]
        row_of = np.zeros(len(self.labels), np.int64)
        row_of[rows] = np.arange(len(rows))
        nodes = tuple(self.nodes_at(rows))
        return WideGraph(nodes[0], nodes, self.means[rows], self.factors.take(index, row_of), huber)

    @cached_property
    def _parts(self) -> list[tuple[Rows, Rows]]:
        """Rows of each component, and its measurements, both ascending."""
        count = int(self.labels.max(initial=-1)) + 1
        parts = []
        for labels in (self.labels, self.labels[self.factors.a]):
            order = np.argsort(labels, kind="stable")
            parts.append(np.split(order, np.cumsum(np.bincount(labels, minlength=count))[:-1]))
        return list(zip(*parts, strict=True))

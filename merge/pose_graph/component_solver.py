"""Optimises the components that links make of pieces of map, each time from where the nodes were before.

What no change touches is kept as it is, object by object. Where few measurements of a large component have
come or gone, only the nodes around them are moved, further out until those at the rim stay where they are.
"""

from collections.abc import Iterable, Sequence

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.merge.pose_graph.component import Component, pieces
from mapweave.merge.pose_graph.factors import Factors, Rows
from mapweave.merge.pose_graph.fragments import Fragment, fragment_by_node
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.optimization import optimized
from mapweave.merge.pose_graph.solved_graph import PoseGraph
from mapweave.registration.pose_arrays import compose_poses, inverse_poses

WHOLE = 1000
"""Components of as many nodes are always optimised as a whole."""
UNSETTLED = 0.02
"""Larger ones when this share of their measurements has come or gone: what is left of strain adds up."""
LEAST = 400
"""Nodes that are moved at first around a change."""
RIM_XY, RIM_HEADING = 3e-4, 1e-4
"""Moves of nodes at the rim that do not matter, m and rad: a link is good to centimetres."""
Pair = tuple[NodeId, NodeId]


class ComponentSolver:
    """Pieces of map, and the links between them that hold at present."""

    def __init__(self, fragments: Sequence[Fragment]) -> None:
        """Nothing joins the pieces yet."""
        self.fragments = fragments
        self.by_node = fragment_by_node(fragments)
        self._nodes = sorted(self.by_node)
        self._row = {node: k for k, node in enumerate(self._nodes)}
        rows = [self._rows(fragment.nodes) for fragment in fragments]
        own = (f.factors.take(np.arange(len(f.factors)), at) for f, at in zip(fragments, rows, strict=True))
        self._own = Factors.together([Factors.of([], [], []), *own])
        self._means, self._labels = np.zeros((len(self._nodes), 3)), np.zeros(len(self._nodes), np.int64)
        for k, (fragment, at) in enumerate(zip(fragments, rows, strict=True)):
            self._means[at], self._labels[at] = fragment.graph.means, k
        self._graphs: dict[int, PoseGraph] = {k: piece.graph for k, piece in enumerate(fragments)}
        self._table = Factors.of([], [], [])
        self._seats: dict[Pair, int] = {}
        self._links: list[Link] = []
        self._active = np.zeros(0, np.int64)
        self._touched, self._ever = np.zeros((2, len(self._nodes)), np.bool_)
        self._settled = True

    @property
    def changed(self) -> set[NodeId]:
        """Names of the pieces at which measurements have come or gone since it was resumed."""
        return {self.by_node[self._nodes[row]].name for row in np.flatnonzero(self._ever).tolist()}

    def resume(
        self,
        graphs: Sequence[PoseGraph],
        fragments: Iterable[Fragment],
        links: Sequence[Link],
        removed: Iterable[Link],
    ) -> None:
        """Go on from an earlier solution.

        Args:
            graphs: its components.
            fragments: the pieces that they were made of.
            links: of its links, those that still hold.
            removed: the others.
        """
        seats = {node: (k, row) for k, graph in enumerate(graphs) for row, node in enumerate(graph.nodes)}
        self._graphs = {len(graphs) + k: piece.graph for k, piece in enumerate(self.fragments)}
        for number, fragment in enumerate(self.fragments, len(graphs)):
            self._place(fragment, graphs, seats, number)
        self._graphs = {**self._graphs, **dict(enumerate(graphs))}
        self._active = np.sort(self._index(links))
        before, now = set(fragments), set(self.fragments)
        measurements = [
            {(m.a, m.b, m.a_from_b.mean) for fragment in some for m in fragment.measurements}
            for some in (before - now, now - before)
        ]
        ends = {node for a, b, _ in measurements[0] ^ measurements[1] for node in (a, b)}
        ends |= {node for link in removed for node in link.pair}
        self._touched[self._rows(node for node in ends if node in self._row)] = True
        self._settled = False

    def _place(
        self,
        fragment: Fragment,
        graphs: Sequence[PoseGraph],
        seats: dict[NodeId, tuple[int, int]],
        number: int,
    ) -> None:
        """Put a piece where it was, and new nodes next to their nearest earlier node."""
        at = self._rows(fragment.nodes)
        placed = [seats.get(node, (-1, -1)) for node in fragment.nodes]
        labels = np.array([label for label, _ in placed])
        if (labels < 0).all():
            self._labels[at] = number
            return
        label = int(np.bincount(labels[labels >= 0]).argmax())
        self._labels[at] = label
        members = np.flatnonzero(labels == label)
        self._means[at[members]] = graphs[label].means[[placed[k][1] for k in members.tolist()]]
        new = np.flatnonzero(labels != label)
        if len(new):
            numbers = np.array([node.number for node in fragment.nodes])
            nearest = members[np.abs(numbers[new][:, None] - numbers[members]).argmin(axis=1)]
            own = fragment.graph.means
            step = compose_poses(inverse_poses(own[nearest]), own[new])
            self._means[at[new]] = compose_poses(self._means[at[nearest]], step)

    def solve(self, links: Sequence[Link], *, whole: bool = False) -> list[PoseGraph]:
        """Each component that some links make, largest first, then by name.

        Args:
            links: at most one between two nodes.
            whole: whether large components are optimised as a whole if anything of them is not settled.
        """
        self._move_on(np.sort(self._index(links)), whole)
        return sorted(self._graphs.values(), key=lambda graph: (-len(graph.nodes), graph.anchor))

    def graph_of(self, node: NodeId) -> PoseGraph:
        """The component of a node, as it was solved last."""
        return self._graphs[int(self._labels[self._row[node]])]

    def _rows(self, nodes: Iterable[NodeId]) -> Rows:
        return np.array([self._row[node] for node in nodes], np.int64)

    def _index(self, links: Sequence[Link]) -> Rows:
        """(N,) seats of links; those that were never asked for get one."""
        seats = [self._seats.get(link.key, -1) for link in links]
        if -1 in seats:
            new = [link.canonical() for link, seat in zip(links, seats, strict=True) if seat < 0]
            # The numbers do not depend on the order of links.
            new.sort(key=lambda link: link.key)
            self._seats |= {link.key: len(self._links) + k for k, link in enumerate(new)}
            self._links += new
            a, b = ([self._row[link.key[end]] for link in new] for end in (0, 1))
            more = Factors.of([link.measurement for link in new], a, b)
            self._table = Factors.together([self._table, more])
            seats = [self._seats[link.key] for link in links]
        return np.array(seats, np.int64)

    def _move_on(self, index: Rows, whole: bool) -> None:
        """Let other links hold, and optimise what that changes."""
        difference = np.setxor1d(index, self._active, assume_unique=True)
        settled = not len(difference) and self._settled
        if settled and not (whole and any(map(_unsettled, self._graphs.values()))):
            return
        factors = Factors.together([self._own, self._table.take(index)])
        self._touched[self._table.a[difference]] = self._touched[self._table.b[difference]] = True
        self._ever |= self._touched
        labels = pieces(factors, len(self._nodes))
        self._lay_together(index)
        graphs: dict[int, PoseGraph] = {}
        for label, (rows, inside) in enumerate(_parts(labels, factors)):
            before = self._graphs.get(int(self._labels[rows[0]]))
            touched = self._touched[rows].any()
            if touched or not self._same(before, rows) or (whole and _unsettled(before)):
                graphs[label] = self._solved(rows, factors.take(inside), whole)
            else:
                assert before is not None
                graphs[label] = before
        self._graphs, self._labels, self._active = graphs, labels, index
        self._touched[:], self._settled = False, True

    def _same(self, graph: PoseGraph | None, rows: Rows) -> bool:
        """Whether an earlier component has just these nodes."""
        same = graph is not None and len(graph.nodes) == len(rows)
        return same and graph.nodes == tuple(self._nodes[k] for k in rows.tolist())  # type: ignore[union-attr]

    def _lay_together(self, index: Rows) -> None:
        """Move components that links join: a smaller one to a larger, by the best link between them."""
        between = self._labels[self._table.a[index]] != self._labels[self._table.b[index]]
        tied: nx.Graph = nx.Graph()
        for k in index[between].tolist():
            ends = int(self._labels[self._table.a[k]]), int(self._labels[self._table.b[k]])
            edge, weight = tied.get_edge_data(*ends), self._links[k].weight
            if edge is None or weight > edge["weight"]:
                tied.add_edge(*ends, weight=weight, link=k)
        sizes = np.bincount(self._labels)
        tree = nx.maximum_spanning_tree(tied)
        for part in sorted(map(sorted, nx.connected_components(tree))):
            root = max(part, key=lambda label: (sizes[label], -label))
            for parent, label in nx.bfs_edges(tree, root):
                k = tree.edges[parent, label]["link"]
                a_from_b, ends = self._table.means[k][None], (self._table.a[k], self._table.b[k])
                if self._labels[ends[0]] != parent:
                    a_from_b, ends = inverse_poses(a_from_b), ends[::-1]
                wanted = compose_poses(self._means[ends[0]][None], a_from_b)
                self._carry(self._labels == label, int(ends[1]), wanted)

    def _carry(self, some: Rows | NDArray[np.bool_], row: int, wanted: Array) -> None:
        """Move nodes as one, so that one of them is where it is wanted, (1, 3)."""
        motion = compose_poses(wanted, inverse_poses(self._means[row][None]))
        self._means[some] = compose_poses(motion, self._means[some])
        self._means[row] = wanted[0]

    def _solved(self, rows: Rows, factors: Factors, whole: bool) -> Component:
        """A component, its smallest node where its own map has it."""
        nodes = tuple(self._nodes[k] for k in rows.tolist())
        pose: Pose2 = self.by_node[nodes[0]].graph.pose(nodes[0])
        self._carry(rows, int(rows[0]), pose.vector[None])
        row_of = np.zeros(len(self._nodes), np.int64)
        row_of[rows] = np.arange(len(rows))
        inside = factors.take(np.arange(len(factors)), row_of)
        means, anchor = self._means[rows], np.zeros(1, np.int64)
        touched = np.flatnonzero(self._touched[rows])
        before = {int(label) for label in np.unique(self._labels[rows])}
        unsettled = len(touched) + sum(_unsettled(self._graphs.get(label)) for label in before)
        if whole or len(rows) <= WHOLE or unsettled > UNSETTLED * len(factors):
            means, unsettled = optimized(inside, means, np.arange(len(rows)), anchor), 0
        else:
            means = _followed(inside, means, touched, anchor)
        self._means[rows] = means
        return Component(nodes[0], nodes, means, inside, unsettled)


def _unsettled(graph: PoseGraph | None) -> int:
    return graph.unsettled if isinstance(graph, Component) else 0


def _parts(labels: Rows, factors: Factors) -> list[tuple[Rows, Rows]]:
    """Rows of each component, and its measurements, both ascending."""
    parts = []
    for some in (labels, labels[factors.a]):
        order = np.argsort(some, kind="stable")
        counts = np.bincount(some, minlength=int(labels.max(initial=-1)) + 1)
        parts.append(np.split(order, np.cumsum(counts)[:-1]))
    return list(zip(*parts, strict=True)) if len(labels) else []


def _followed(factors: Factors, means: Array, touched: Rows, held: Rows) -> Array:
    """Optimise around some rows, further and further out until the nodes at the rim stay where they are."""
    before, rows = means, factors.around(touched, LEAST, len(means))
    while True:
        means = optimized(factors, means, rows, held)
        inside = np.zeros(len(means), np.bool_)
        inside[rows] = True
        index = factors.at(rows)
        a, b = factors.a[index], factors.b[index]
        rim = np.unique(np.concatenate([a[~inside[b]], b[~inside[a]]]))
        off = np.abs(compose_poses(inverse_poses(before[rim]), means[rim]))
        rim = rim[(off[:, :2] >= RIM_XY).any(axis=1) | (off[:, 2] >= RIM_HEADING)]
        if not len(rim):
            return means
        rows = np.union1d(rows, factors.around(rim, len(rows), len(means)))

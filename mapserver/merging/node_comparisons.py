"""Comparing nodes: which look alike, and the verdicts on pairs of them, each found once."""

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from itertools import islice

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Edge, EdgeKind, Node
from mapweave.mapserver.merging.merger_counters import MergerCounters
from mapweave.mapserver.merging.verification_cache import (
    CachedVerifications,
    RecentComparisons,
    VerificationCache,
    fingerprint_of,
)
from mapweave.mapserver.retrieval.compared_landmarks import bounded
from mapweave.mapserver.retrieval.place_database import PlaceDatabase
from mapweave.mapserver.retrieval.ranking import IncompleteSearch
from mapweave.merge.pose_graph.candidates import Pair
from mapweave.merge.pose_graph.links import Link, RefusedLink
from mapweave.merge.pose_graph.pairs import PairTable
from mapweave.merge.pose_graph.verdicts import Verdict
from mapweave.merge.pose_graph.verification import verify

log = logging.getLogger(__name__)


Compare = Callable[[Sequence[tuple[Node, Node]]], Iterable[Verdict]]
"""Gives the verdicts on pairs of nodes, in order."""


def compare(pairs: Sequence[tuple[Node, Node]]) -> Iterator[Verdict]:
    """Compare pairs of nodes, each when it is asked for; what was found depends on these nodes alone."""
    for a, b in pairs:
        try:
            yield verify(bounded(a), bounded(b))
        except Exception as error:  # a defect with two nodes must not hold up all others
            log.exception("%s and %s cannot be compared", a.id, b.id)
            yield RefusedLink(a.id, b.id, f"cannot be compared ({type(error).__name__})")


class NodeComparisons:
    """The overlaps of nodes, the pairs that are compared, and the verdicts on them.

    A verdict holds while both nodes stay what they are. Those of another process are taken over for nodes
    that are just as they were.
    """

    def __init__(
        self,
        places: PlaceDatabase,
        node_of: Callable[[NodeId], Node | None],
        counters: MergerCounters,
        compare: Compare = compare,
        pause: Callable[[], None] = lambda: None,
    ) -> None:
        """Begin with no nodes.

        Args:
            places: says which nodes look alike.
            node_of: gives a node by its id.
            counters: of what is done.
            compare: compares nodes, here or elsewhere.
            pause: called between two comparisons.
        """
        self._places, self._node_of, self._compare, self._pause = places, node_of, compare, pause
        self._counters = counters
        self._pairs = PairTable()
        self._uncompared: dict[NodeId, None] = {}
        self._verdicts: dict[NodeId, dict[NodeId, Verdict]] = {}
        self._cached: CachedVerifications | None = None
        self._prints: dict[NodeId, tuple[Node, bytes]] = {}
        self._unsaved: set[NodeId] = set()
        self._recent: Set[NodeId] = frozenset()

    def __len__(self) -> int:
        """Pairs of nodes on which there is a verdict."""
        return sum(map(len, self._verdicts.values())) // 2

    def __getitem__(self, pair: Pair) -> Verdict:
        return self._verdicts[pair[0]][pair[1]]

    def __contains__(self, pair: Pair) -> bool:
        return pair[1] in self._verdicts.get(pair[0], {})

    @property
    def uncompared(self) -> int:
        """Nodes that were read and whose similar nodes are not searched yet."""
        return len(self._uncompared)

    @property
    def waiting(self) -> bool:
        """Whether there is anything for `changes` to give."""
        return self._pairs.waiting

    # Nodes come and go.

    def pairs_of(self, node_id: NodeId) -> list[Pair]:
        """The pairs of a node that are to be compared."""
        return self._pairs.of(node_id)

    def put(self, node: Node, before: Iterable[Pair] = ()) -> None:
        """Look which nodes are like one that is in the place database.

        Args:
            node: was added, or written again.
            before: its pairs as it was.
        """
        try:
            self.put_overlaps(node.id, self._places.overlaps(node, self._node_of, before))
        except IncompleteSearch:  # it must not pass for compared, here or in what is kept for the next start
            self.postpone([node])

    def put_overlaps(self, node_id: NodeId, overlaps: Mapping[NodeId, float]) -> None:
        """Take overlaps of a node with others that are known already."""
        self._pairs.put(node_id, dict(overlaps))
        self._unsaved.add(node_id)

    def postpone(self, nodes: Iterable[Node]) -> None:
        """Nodes for which `search_pairs` shall look which others are like them."""
        self._uncompared.update((node.id, None) for node in nodes)

    def forget(self, node_id: NodeId) -> None:
        """Drop what was found out about a node: it is gone, or is known better."""
        self._pairs.forget(node_id)
        self._uncompared.pop(node_id, None)
        self._unsaved.discard(node_id)
        for other in self._verdicts.pop(node_id, {}):
            del self._verdicts[other][node_id]

    def connect(self, edge: Edge) -> None:
        """An edge has come."""
        if _makes_neighbours(edge):
            self._pairs.connect(edge.a, edge.b)

    def disconnect(self, edge: Edge) -> None:
        """An edge has gone."""
        if _makes_neighbours(edge):
            self._pairs.disconnect(edge.a, edge.b)

    # Pairs are compared.

    def search_pairs(self, most: int | None = None) -> None:
        """Search for nodes similar to those that were read, or to so many of them."""
        for node_id in list(islice(self._uncompared, most)):
            del self._uncompared[node_id]
            if (node := self._node_of(node_id)) is not None:
                cached = self._cached
                known = cached is not None and cached.knows(node)
                try:
                    if cached is not None and known:
                        overlaps = cached.overlaps(node, self._node_of)
                    else:
                        before = [] if cached is None else cached.pairs_of(node_id)
                        overlaps = self._places.overlaps(node, self._node_of, before)
                    self._pairs.put(node_id, overlaps)
                    if not known or node_id in self._recent:
                        self._unsaved.add(node_id)
                except IncompleteSearch:
                    self.postpone([node])
                    return
                except Exception:  # a defect with one node must not hold up all others
                    log.exception(
                        "the search for nodes similar to %s failed: it is compared with none", node_id
                    )

    def changes(self) -> list[tuple[Pair, Verdict | None]]:
        """Compare what is to be compared, and tell what has changed since this was asked last.

        Returns:
            Pairs in the order of ids, each with its verdict; None if it is not to be compared, or gone.
        """
        changed = self._pairs.changed()
        self.verify(pair for pair in changed if pair in self._pairs)
        return [(pair, self[pair] if pair in self._pairs and pair in self else None) for pair in changed]

    def verify(self, pairs: Iterable[Pair]) -> None:
        """Compare pairs on which there is no verdict yet."""
        wanted: dict[Pair, tuple[Node, Node]] = {}
        for pair in pairs:
            a, b = self._node_of(pair[0]), self._node_of(pair[1])
            if pair not in self and a is not None and b is not None:
                wanted[pair] = a, b
        for pair, verdict in zip(wanted, self._compare([*wanted.values()]), strict=True):
            self.judge(pair, verdict)
            self._pause()
            self._counters.verified += 1
            self._counters.recognised += isinstance(verdict, Link)

    def judge(self, pair: Pair, verdict: Verdict) -> None:
        """Take a verdict that is known already."""
        for one, other in (pair, pair[::-1]):
            self._verdicts.setdefault(one, {})[other] = verdict

    # What was found outlives the process.

    @property
    def recollecting(self) -> bool:
        """Whether there are earlier verdicts that have not been taken over yet."""
        return self._cached is not None

    def recollect(self, findings: VerificationCache, recent: RecentComparisons) -> None:
        """Use earlier results, and later ones, for nodes that are unchanged when they are read."""
        self._cached, self._recent = CachedVerifications(findings.extended(recent)), recent.compared

    def take_over(self) -> None:
        """Take over all earlier verdicts, once nodes are read; later pairs are compared again."""
        if self._cached is not None:
            for pair, verdict in self._cached.verdicts(self._node_of):
                if pair not in self:
                    self.judge(pair, verdict)
            self._cached = None

    def kept(self) -> None:
        """Take note that the findings are on the disk."""
        self._unsaved = set()

    def recent(self, nodes: Iterable[Node]) -> RecentComparisons:
        """What was found since `kept` was called last.

        Args:
            nodes: all that there are.
        """
        compared = frozenset(self._unsaved - self._uncompared.keys())
        overlaps = {pair: value for node in compared for pair, value in self._pairs.overlaps_of(node).items()}
        return RecentComparisons(self.prints(nodes), compared, overlaps)

    def prints(self, nodes: Iterable[Node]) -> dict[NodeId, bytes]:
        """Fingerprints of nodes.

        Args:
            nodes: all that there are; those of others are forgotten.
        """
        before, self._prints = self._prints, {}
        for node in nodes:
            known = before.get(node.id)
            same = known is not None and known[0] is node
            self._prints[node.id] = known if known and same else (node, fingerprint_of(node))
        return {node_id: fingerprint for node_id, (_, fingerprint) in self._prints.items()}

    def findings(self, nodes: Iterable[Node]) -> VerificationCache:
        """What was found of those of these nodes that are compared."""
        prints = {n: print_ for n, print_ in self.prints(nodes).items() if n not in self._uncompared}
        verdicts = {(a, b): v for a, known in self._verdicts.items() for b, v in known.items() if a < b}
        return VerificationCache(prints, self._pairs.overlaps(), verdicts)


def _makes_neighbours(edge: Edge) -> bool:
    """Whether an edge connects two nodes that are near each other on their robot's drive.

    These are not compared: it would add nothing. Later drives and edges between nodes of others do not count.
    """
    return edge.kind is not EdgeKind.DRIVEN and edge.within

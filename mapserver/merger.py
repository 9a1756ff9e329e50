"""Keeps the merged map up to date as changes come in."""

from __future__ import annotations

from dataclasses import dataclass, field

from hybridmap.change import Change, ChangeBody, EdgePut, EdgeRetired, NodePut, NodeRetired
from hybridmap.hybrid_map import HybridMap
from hybridmap.node import Edge, EdgeKind, MapId, Node, NodeId
from hybridmap.ruling import Rulings
from mapserver.placeindex import PlaceIndex
from merge.candidates import CandidateSettings, Pair, choose_pairs
from merge.links import Link, RefusedLink
from merge.merged import MergedMap
from merge.merging import MergeSettings, merge_maps
from merge.undoing import undo
from merge.verification import VerificationSettings, verify


@dataclass(frozen=True)
class MergerSettings:
    """How maps are merged as they come.

    Attributes:
        candidates: which pairs are looked at; the place index must have the same.
        verification: when two nodes are linked.
        merging: which links are believed.
    """

    candidates: CandidateSettings = field(default_factory=CandidateSettings)
    verification: VerificationSettings = field(default_factory=VerificationSettings)
    merging: MergeSettings = field(default_factory=MergeSettings)


@dataclass
class MergerCounters:
    """What the merger has done since it started.

    Attributes:
        changes: taken in.
        verified: pairs of nodes that were compared.
        recognised: of these, pairs whose landmarks agreed.
        merges: times the merged map was made anew.
    """

    changes: int = 0
    verified: int = 0
    recognised: int = 0
    merges: int = 0


class Merger:
    """Holds every robot's map, the table of overlaps and the verdicts on pairs of nodes.

    Work is done where it is cheapest: a new node is compared with its best candidates when it comes; the
    merged map is made when it is asked for and something has changed. The outcome depends on what the maps
    hold, not on the order in which it came.
    """

    def __init__(self, index: PlaceIndex | None = None, settings: MergerSettings | None = None) -> None:
        """Start with no maps.

        Args:
            index: is filled with the nodes that come; give it to a Relocalizer too.
            settings: how.
        """
        self.index = index or PlaceIndex()
        self.maps: dict[MapId, HybridMap] = {}
        self.counters = MergerCounters()
        self._settings = settings or MergerSettings()
        self._overlaps: dict[Pair, float] = {}
        self._verdicts: dict[Pair, Link | RefusedLink] = {}
        self._rulings = Rulings()
        self._merged = MergedMap.empty()
        self._dirty = False

    def node(self, node_id: NodeId) -> Node | None:
        """A node of any map, if it is there."""
        one = self.maps.get(node_id.map)
        return None if one is None else one.nodes.get(node_id)

    def on_change(self, change: Change) -> None:
        """Take in one change, in the order of its log."""
        self.counters.changes += 1
        self.apply(change.map, change.body)
        if isinstance(change.body, NodePut):
            self._verify(self._chosen(change.body.node.id))

    def apply(self, map_id: MapId, body: ChangeBody) -> None:
        """Take in a change without comparing nodes yet: for reading a whole store at the start."""
        self.maps.setdefault(map_id, HybridMap()).apply(body)
        self._dirty = True
        match body:
            case NodePut(node):
                self._forget(node.id)
                self.index.add(node)
                for other, value in self.index.overlaps(node).items():
                    self._overlaps[min(node.id, other), max(node.id, other)] = value
            case NodeRetired(node_id):
                self._forget(node_id)
                self.index.remove(node_id)
            case EdgePut() | EdgeRetired():
                pass

    def rule(self, rulings: Rulings) -> None:
        """Heed these rulings of people from now on, and no others."""
        self._rulings = rulings
        self._dirty = True

    def merged(self) -> MergedMap:
        """The merged map of all that has come; made anew only if something has changed."""
        if self._dirty:
            chosen = choose_pairs(self._overlaps, self._edges(), self._settings.candidates)
            self._verify(chosen)
            verdicts = [self._verdicts[pair] for pair in chosen]
            undone = undo(
                # Copies: a merged map stays as it was when later changes come.
                {map_id: HybridMap(one.contents()) for map_id, one in self.maps.items()},
                [verdict for verdict in verdicts if isinstance(verdict, Link)],
                self._rulings,
            )
            refused = [verdict for verdict in verdicts if isinstance(verdict, RefusedLink)]
            merged = merge_maps(
                undone.maps, undone.links, [*refused, *undone.refused], self._settings.merging
            )
            self._merged = undone.completed(merged)
            self.counters.merges += 1
            self._dirty = False
        return self._merged

    def status(self) -> str:
        """For example `17 nodes, 3 maps, 2 components, 5 links, 2 refused`."""
        return self.merged().summary()

    def _edges(self) -> list[Edge]:
        """Edges that say which nodes lie so near to each other on a robot's way that to compare them tells
        nothing new. A later drive says nothing of that; it may lead from map to map.
        """
        edges = (edge for one in self.maps.values() for edge in one.edges.values())
        return [edge for edge in edges if edge.kind is not EdgeKind.DRIVEN]

    def _chosen(self, node_id: NodeId) -> list[Pair]:
        """The pairs of one node that would be chosen now; the edges of a new node come after it."""
        near = {pair: value for pair, value in self._overlaps.items() if node_id in pair}
        between = {pair: value for pair, value in near.items() if pair[0].map != pair[1].map}
        return choose_pairs(between, (), self._settings.candidates)

    def _verify(self, pairs: list[Pair]) -> None:
        for pair in pairs:
            a, b = self.node(pair[0]), self.node(pair[1])
            if pair in self._verdicts or a is None or b is None:
                continue
            verdict = verify(a, b, self._settings.verification)
            self._verdicts[pair] = verdict
            self.counters.verified += 1
            self.counters.recognised += isinstance(verdict, Link)

    def _forget(self, node_id: NodeId) -> None:
        """Drop what was found out about a node: it is gone, or is known better."""
        for known in (self._overlaps, self._verdicts):
            for pair in [pair for pair in known if node_id in pair]:
                del known[pair]

"""Keeps the merged map up to date as changes come in."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace
from itertools import islice

import numpy as np

from mapweave.hybridmap.change import Change, ChangeBody, EdgePut, NodePut, NodeRetired
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.manual_constraint import ManualConstraints
from mapweave.hybridmap.node import Edge, EdgeKind, MapId, Node, NodeId
from mapweave.hybridmap.reachability_cache import ReachabilityCache
from mapweave.mapserver.merging.isolation import Isolation, leave_out, reason_of
from mapweave.mapserver.merging.merger_counters import MergerCounters
from mapweave.mapserver.merging.superseded_nodes import SupersededNodes
from mapweave.mapserver.merging.verification_cache import (
    CachedVerifications,
    VerificationCache,
    fingerprint_of,
)
from mapweave.mapserver.relocalization.alias_cache import AliasCache
from mapweave.mapserver.retrieval.place_index import PlaceIndex, bounded
from mapweave.merge.islands import Islands
from mapweave.merge.map_maintenance.landmark_removal import LandmarkRemover
from mapweave.merge.map_maintenance.node_superseding import NodeSuperseder
from mapweave.merge.outlier_rejection.wrong_geometry import WrongGeometrySearch
from mapweave.merge.pose_graph.candidates import Pair
from mapweave.merge.pose_graph.links import Link, RefusedLink, refuse
from mapweave.merge.pose_graph.merged_map import MergedMap, WrongGeometry
from mapweave.merge.pose_graph.pairs import PairTable
from mapweave.merge.pose_graph.verdicts import MapPair, Verdict, Verdicts
from mapweave.merge.pose_graph.verification import verify
from mapweave.merge.settings import MergeSettings
from mapweave.registration.recognition import RecognitionSettings
from mapweave.wire.pose_codec import MAX_POSITION

log = logging.getLogger(__name__)


class Pipeline:
    """From maps to a merged map: the merge, renewal and fading, with what each knows from the last one."""

    def __init__(self, settings: MergeSettings, reaches: ReachabilityCache) -> None:
        """Nothing is merged yet."""
        self.islands = Islands(settings)
        self._renewer = NodeSuperseder(reaches)
        self._fader = LandmarkRemover()

    def merged(
        self,
        maps: Mapping[MapId, HybridMap],
        verdicts: Verdicts,
        touched: set[MapId],
        rulings: ManualConstraints,
    ) -> MergedMap:
        """See `Islands.merge`.

        Raises:
            InvalidValue: a node lies where nobody could be told of it.
        """
        merged = self.islands.merge(maps, verdicts, touched, rulings)
        for graph in merged.graphs:
            # Written so that NaN fails.
            if not (np.abs(graph.means[:, :2]) <= MAX_POSITION).all():
                raise InvalidValue(f"nodes joined with {graph.anchor} lie beyond {MAX_POSITION:g} m")
        return self._fader.fade(self._renewer.renewed(merged))


class Merger:
    """Holds every robot's map, the overlaps of their nodes and the verdicts on pairs of them.

    Work is done where it is cheapest: a new node is compared with its best candidates when it comes; the
    merged map is made when it is asked for and something has changed, and then only where it has. New
    nodes are not compared with such as were superseded on another day. But for that the outcome depends on
    what the maps hold, not on the order in which it came.
    """

    def __init__(self, index: PlaceIndex | None = None, settings: MergeSettings | None = None) -> None:
        """Start with no maps.

        Args:
            index: is filled with the nodes that come; give it to a Relocalizer too.
            settings: how.
        """
        # An index in which there is nothing yet is one.
        self.index = PlaceIndex() if index is None else index
        self.alike = AliasCache(RecognitionSettings())
        self.maps: dict[MapId, HybridMap] = {}
        self.counters = MergerCounters()
        self.reaches = ReachabilityCache()
        self.settings = settings or MergeSettings()
        self._before: CachedVerifications | None = None
        self._prints: dict[NodeId, tuple[Node, bytes]] = {}
        self._pairs = PairTable()
        self._succession = SupersededNodes(self.index, self._pairs, self.node)
        self._uncompared: dict[NodeId, None] = {}
        self._known: dict[NodeId, dict[NodeId, Verdict]] = {}
        self._verdicts = Verdicts()
        self._pipeline = Pipeline(self.settings, self.reaches)
        self._isolation = Isolation()
        self._suspects: frozenset[MapId] = frozenset()
        self._contradictions = WrongGeometrySearch(self.settings.consistency, self.settings.strain)
        self._wrong: dict[MapId, WrongGeometry] = {}
        self._stale: set[MapPair] = set()
        self._kept: dict[MapId, HybridMap] = {}
        self._touched: set[MapId] = set()
        self._changed: set[MapId] = set()
        self._rulings = ManualConstraints()
        self._merged = MergedMap.empty()
        self._dirty = False

    @property
    def uncompared(self) -> int:
        """Nodes that were read and for which nobody has yet looked which others are like them."""
        return len(self._uncompared)

    @property
    def compared(self) -> tuple[int, int]:
        """Nodes that were compared with all others, and pairs of them on which there is a verdict."""
        nodes = sum(len(one.nodes) for one in self.maps.values())
        return nodes - len(self._uncompared), sum(map(len, self._known.values())) // 2

    @property
    def recollecting(self) -> bool:
        """Whether there are findings of before that no merge has taken over yet."""
        return self._before is not None

    def recollect(self, findings: VerificationCache) -> None:
        """Believe what was found before of nodes that are just as they were; what is not read by then."""
        self._before = CachedVerifications(findings)

    def findings(self) -> VerificationCache:
        """What was found of all nodes that are compared."""
        before, self._prints = self._prints, {}
        for node_id, node in ((n.id, n) for one in self.maps.values() for n in one.nodes.values()):
            known = before.get(node_id)
            same = known is not None and known[0] is node
            self._prints[node_id] = known if known and same else (node, fingerprint_of(node))
        prints = {n: told for n, (_, told) in self._prints.items() if n not in self._uncompared}
        verdicts = {(a, b): v for a, known in self._known.items() for b, v in known.items() if a < b}
        return VerificationCache(prints, self._pairs.overlaps(), verdicts)

    def node(self, node_id: NodeId) -> Node | None:
        """A node of any map, if it is there."""
        one = self.maps.get(node_id.map)
        return None if one is None else one.nodes.get(node_id)

    def on_change(self, change: Change) -> None:
        """Take in one change, in the order of its log."""
        self.counters.changes += 1
        self.apply(change.map, change.body)
        if isinstance(change.body, NodePut):
            # Which nodes of its own map are no neighbours its edges tell, and they come after it.
            self._verify(pair for pair in self._pairs.of(change.body.node.id) if pair[0].map != pair[1].map)

    def apply(self, map_id: MapId, body: ChangeBody) -> None:
        """Take in a change without comparing nodes yet."""
        before = self._pairs.of(body.node.id) if isinstance(body, NodePut) else []
        self._replay(map_id, body)
        if isinstance(body, NodePut):
            self.index.add(body.node)
            self._pairs.put(body.node.id, self._succession.overlaps(body.node, before))

    def read(
        self,
        log: Iterable[tuple[MapId, ChangeBody]],
        overlaps: Mapping[Pair, float] | None = None,
        links: Mapping[Pair, Link] | None = None,
    ) -> None:
        """Take in many changes at once: a store at the start. Places can be found as soon as this returns.

        Which are alike is looked for by `look_around`, or when they are merged; then they are compared.

        Args:
            log: what each map tells, in its order.
            overlaps: if they are known already, of all pairs of these nodes; else they are looked for.
            links: what is known already of pairs of these nodes.
        """
        put: dict[NodeId, None] = {}
        for map_id, body in log:
            self._replay(map_id, body)
            if isinstance(body, NodePut):
                put[body.node.id] = None
        # What the index has already, just so, it leaves as it is.
        fresh = [node for node_id in put if (node := self.node(node_id)) is not None]
        self.index.extend(fresh)
        if overlaps is None:
            self._uncompared.update((node.id, None) for node in fresh)
        for (a, b), value in (overlaps or {}).items():
            self._pairs.put(a, {b: value})
        for pair, link in (links or {}).items():
            self._judge(pair, link)

    def rule(self, constraints: ManualConstraints) -> None:
        """Heed these rulings of people from now on, and no others."""
        ruled = {*constraints.in_force} ^ {*self._rulings.in_force}
        # A map that is retired harms nobody, and is no longer set apart.
        self._isolation.release(one.retires for one in ruled if one.retires is not None)
        if self._rulings.retired.keys() - constraints.retired.keys():
            self.alike.forget()
        self._rulings = constraints
        self._stale |= self._verdicts.at(self.maps.keys())
        self._dirty = True

    def suspect(self, maps: Iterable[MapId]) -> None:
        """Maps that another process has set apart: where it is this one or another, it is this one."""
        self._suspects = frozenset(maps)

    def merged(self, use: Callable[[MergedMap], object] | None = None) -> MergedMap:
        """The merged map of all that has come; made anew only if something has changed, and where it has.

        A map with which it fails is set apart: it is merged without it, until that has changed.

        Args:
            use: what is made of a merged map that is new; a map with which that fails is set apart as well.
        """
        if self._dirty:
            self.search_pairs()
            self._take_over()
            changed = self._pairs.changed()
            self._verify(pair for pair in changed if pair in self._pairs)
            for pair in changed:
                self._touched |= {pair[0].map, pair[1].map}
                self._stale.add((pair[0].map, pair[1].map))
                if pair in self._pairs and pair[1] in self._known.get(pair[0], {}):
                    self._verdicts.put(pair, self._told(self._known[pair[0]][pair[1]]))
                else:
                    self._verdicts.drop(pair)
            for map_id in self._changed:
                # Copies: a merged map stays as it was when later changes come. What did not change is not
                # copied: all that a merge remembers of a map it remembers of this very copy.
                self._kept[map_id] = HybridMap(self.maps[map_id].contents())
            self._isolation.changed(self._changed)
            try:
                self._find_wrong_geometry()
            except Exception:  # a defect with one map must not hold up the merge
                log.exception("maps with wrong geometry could not be looked for")
            maps = [one for one in self._kept if one not in self._isolation]
            try:
                merged = self._made(self._pipeline, self._verdicts, maps, self._touched, use)
            except Exception as error:  # whatever it is, it is one map's or a few maps' and not everybody's
                log.exception("the merge fails; looking for the map with which it does")
                merged = self._made_without_bad(maps, error, use)
            self._succession.follow(merged.superseded)
            self._merged = merged
            self.counters.merges += 1
            self._touched, self._changed = set(), set()
            self._dirty = False
        return self._merged

    def _made(
        self,
        pipeline: Pipeline,
        verdicts: Verdicts,
        maps: Collection[MapId],
        touched: set[MapId],
        use: Callable[[MergedMap], object] | None,
    ) -> MergedMap:
        kept = {one: self._kept[one] for one in maps}
        merged = pipeline.merged(kept, verdicts, touched, self._rulings)
        merged = replace(merged, set_apart=self._isolation.reasons, wrong=self._wrong)
        if use is not None:
            use(merged)
        return merged

    def _find_wrong_geometry(self) -> None:
        """Maps that contradict others that agree are merged with nobody."""
        self._stale |= self._verdicts.at(self._changed)
        before, left_out = self._wrong, {*self._rulings.retired, *self._isolation.reasons}
        self._wrong = self._contradictions.wrong(self._kept, self._links, self._stale, left_out)
        self._stale = set()
        if before.keys() - self._wrong.keys():
            self.alike.forget()
        differ = {which for which, _ in before.items() ^ self._wrong.items()}
        for maps in self._verdicts.at(differ):
            self._touched |= {*maps}
            for pair in list(self._verdicts.between(maps)):
                self._verdicts.put(pair, self._told(self._known[pair[0]][pair[1]]))

    def _links(self, maps: MapPair) -> list[Link]:
        """The links between two maps that people have not ruled out, also those of maps with wrong
        geometry.
        """
        known = (self._known[a][b] for a, b in self._verdicts.between(maps))
        return [v for v in known if isinstance(v, Link) and self._rulings.against(*v.pair) is None]

    def _told(self, verdict: Verdict) -> Verdict:
        """A verdict, or why it does not count."""
        if isinstance(verdict, RefusedLink) or verdict.within:
            return verdict
        wrong = self._wrong.get(verdict.a.map) or self._wrong.get(verdict.b.map)
        return verdict if wrong is None else refuse(verdict, wrong.reason)

    def _made_without_bad(
        self, maps: Collection[MapId], first: Exception, use: Callable[[MergedMap], object] | None
    ) -> MergedMap:
        """Merge as many maps as it works with, from nothing: nobody knows what a failure has left behind."""

        def attempt(some: Collection[MapId]) -> Pipeline:
            pipeline = Pipeline(self.settings, self.reaches)
            self._made(pipeline, self._verdicts, some, set(some), use)
            return pipeline

        # Those that are suspected before and the small ones last: they are rather set apart than others.
        trusted = sorted(maps, key=lambda one: (self._suspicion(one), -len(self._kept[one].nodes), one))
        pipeline, bad = leave_out(trusted, attempt)
        for one, error in bad.items():
            self._isolation.add(one, reason_of(error))
        if not bad:
            log.warning("the merge fails with what it knew (%s) and not without it: begun anew", first)
        self._pipeline = pipeline
        return self._made(pipeline, self._verdicts, [one for one in maps if one not in bad], set(), use)

    def _suspicion(self, one: MapId) -> int:
        return self._isolation.suspicion(one) + (one in self._suspects)

    def search_pairs(self, most: int | None = None) -> None:
        """Look for what is like the nodes that were read, or like so many of them."""
        for node_id in list(islice(self._uncompared, most)):
            del self._uncompared[node_id]
            if (node := self.node(node_id)) is not None:
                before = self._before
                source = before if before is not None and before.knows(node) else self.index
                try:
                    self._pairs.put(node_id, source.overlaps(node, self.node))
                except Exception:  # a defect with one node must not hold up all others
                    log.exception("nobody can say which nodes are like %s: it is compared with none", node_id)

    def _take_over(self) -> None:
        """Take over all verdicts of before, once nodes are read; whatever comes now is found anew."""
        # A server merges before it has read its store if people's rulings come first.
        if self._before is not None and self.maps:
            for pair, verdict in self._before.verdicts(self.node):
                if pair[1] not in self._known.get(pair[0], {}):
                    self._judge(pair, verdict)
            self._before = None

    def apart(self) -> MergedMap:
        """The merged map if nobody had compared any two maps: a component for each part of each map.

        Without those with which it fails: the merge says which they are.
        """
        kept = {map_id: HybridMap(one.contents()) for map_id, one in self.maps.items()}

        def attempt(some: Collection[MapId]) -> MergedMap:
            inside = {one: kept[one] for one in some}
            return Islands(self.settings).merge(inside, Verdicts(), set(inside), self._rulings)

        return leave_out(sorted(kept), attempt)[0]

    def status(self) -> str:
        """For example `17 nodes, 3 maps, 2 components, 5 links, 2 refused`."""
        return self.merged().summary()

    def _replay(self, map_id: MapId, body: ChangeBody) -> None:
        """Take a change into its map, and forget what no longer holds."""
        one = self.maps.setdefault(map_id, HybridMap())
        self._touched.add(map_id)
        self._changed.add(map_id)
        self._dirty = True
        gone = one.nodes.get(body.id) if isinstance(body, NodeRetired) else None
        for edge in one.dropped_by(body):
            if _makes_neighbours(edge):
                self._pairs.disconnect(edge.a, edge.b)
        one.apply(body)
        match body:
            case NodePut(node):
                self._forget(node.id)
                self._succession.put(node)
            case NodeRetired(node_id):
                self._forget(node_id)
                self.index.remove(node_id, None if gone is None else gone.landmarks.codes)
            case EdgePut(edge):
                if _makes_neighbours(edge):
                    self._pairs.connect(edge.a, edge.b)

    def _verify(self, pairs: Iterable[Pair]) -> None:
        for pair in pairs:
            a, b = self.node(pair[0]), self.node(pair[1])
            if pair[1] in self._known.get(pair[0], {}) or a is None or b is None:
                continue
            verdict: Verdict
            try:
                verdict = verify(bounded(a), bounded(b))
            except Exception as error:  # a defect with two nodes must not hold up all others
                log.exception("%s and %s cannot be compared", a.id, b.id)
                verdict = RefusedLink(a.id, b.id, f"cannot be compared ({type(error).__name__})")
            self._judge(pair, verdict)
            self.counters.verified += 1
            self.counters.recognised += isinstance(verdict, Link)

    def _judge(self, pair: Pair, verdict: Verdict) -> None:
        for one, other in (pair, pair[::-1]):
            self._known.setdefault(one, {})[other] = verdict

    def _forget(self, node_id: NodeId) -> None:
        """Drop what was found out about a node: it is gone, or is known better."""
        self._pairs.forget(node_id)
        self._uncompared.pop(node_id, None)
        self._succession.drop(node_id)
        for other in self._known.pop(node_id, {}):
            del self._known[other][node_id]


def _makes_neighbours(edge: Edge) -> bool:
    """Whether an edge says that two nodes are near to each other on their robot's way.

    These are not compared: it tells nothing new. A later drive says nothing of that, and nobody says it of
    others' nodes.
    """
    return edge.kind is not EdgeKind.DRIVEN and edge.within

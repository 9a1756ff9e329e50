"""Keeps the merged map up to date as changes come in."""

import logging
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

from mapweave.hybridmap.change import Change, ChangeBody, EdgePut, NodePut, NodeRetired
from mapweave.hybridmap.constraint_subject import Apart, Linked, RetiredMap
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraints
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pin import Pin
from mapweave.hybridmap.reachability_cache import ReachabilityCache
from mapweave.mapserver.merging.copies import Copies
from mapweave.mapserver.merging.counted_verdicts import CountedVerdicts
from mapweave.mapserver.merging.implausible_maps import ImplausibleMaps
from mapweave.mapserver.merging.isolation import Isolation, leave_out, reason_of
from mapweave.mapserver.merging.merge_pipeline import MergePipeline
from mapweave.mapserver.merging.merger_counters import MergerCounters
from mapweave.mapserver.merging.node_comparisons import Compare, NodeComparisons, compare
from mapweave.mapserver.merging.own_views_search import OwnViewsSearch
from mapweave.mapserver.merging.pruning import PrunePlan, Pruning
from mapweave.mapserver.merging.restart_record import RestartRecord
from mapweave.mapserver.merging.verification_cache import RecentComparisons, VerificationCache
from mapweave.mapserver.relocalization.alias_cache import AliasCache
from mapweave.mapserver.retrieval.place_database import PlaceDatabase
from mapweave.merge.islands import Islands
from mapweave.merge.map_maintenance.node_superseding import Superseding
from mapweave.merge.outlier_rejection.wrong_geometry import UNSOLVABLE
from mapweave.merge.pose_graph.candidates import Pair
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.pose_graph.pinned_frames import PinnedFrames
from mapweave.merge.pose_graph.verdicts import Verdicts
from mapweave.merge.retired_nodes import retired_nodes
from mapweave.merge.settings import MergeSettings
from mapweave.registration.recognition import RecognitionSettings

log = logging.getLogger(__name__)


class Merger:
    """Holds every robot's map, and merges them from what comparing their nodes has found.

    A new node is compared with its best candidates when it comes; the merged map is made when it is requested
    and something has changed, and then only where it has.

    With four exceptions the result depends on the maps, not on the order of changes. New nodes are not
    compared with nodes superseded on another day. Which of two nodes of one place supersedes the other
    depends on what was superseded before (docs/decisions/life-of-a-map.md says how much that is); a
    RestartRecord passes that on to the next process, and a map that goes has no share in it. In a large
    place database cells are searched, which depend on what was there when they were learned (see
    LandmarkIndexSettings). Decisions on a large island stay until much of it has changed (see Islands).
    """

    def __init__(
        self,
        places: PlaceDatabase | None = None,
        settings: MergeSettings | None = None,
        compare: Compare = compare,
        pause: Callable[[], None] = lambda: None,
        choice_key: bytes = b"",
    ) -> None:
        """Start with no maps.

        Args:
            places: is filled with the nodes that come; give it to a Relocalizer too.
            settings: how.
            compare: compares nodes.
            pause: called between the pieces of a merge.
            choice_key: decides which pairs of views are held against their map's way; see `OwnViewsSearch`.
        """
        # A database in which there is nothing yet is one.
        self.places = PlaceDatabase() if places is None else places
        self.alike = AliasCache(RecognitionSettings())
        self.maps: dict[MapId, HybridMap] = {}
        self.counters = MergerCounters()
        self.reaches = ReachabilityCache()
        self.settings = settings or MergeSettings()
        self._compare, self._pause, self._choice_key = compare, pause, choice_key
        self.pruning = Pruning()
        self._suspects: frozenset[MapId] = frozenset()
        self._implausible = ImplausibleMaps()
        self._kept: dict[MapId, HybridMap] = {}
        self._uncopied: set[MapId] = set()
        self._begin()
        self._constraints = ManualConstraints()
        self._pins: tuple[Pin, ...] = ()
        self._merged = MergedMap.empty()
        self._dirty = False

    def _begin(self) -> None:
        """Nothing is compared or merged."""
        self._comparisons = NodeComparisons(self.places, self.node, self.counters, self._compare, self._pause)
        self._counted = CountedVerdicts(self._comparisons, self.settings.consistency)
        self._record: RestartRecord | None = None
        self._resumed: Superseding | None = None
        self._pipeline = self._new_pipeline()
        self._isolation = Isolation()
        self._copies, self._copied = Copies(), dict[MapId, str]()
        self._own_views = OwnViewsSearch(self._comparisons, self._choice_key)
        self._touched, self._changed = set(self.maps), set(self.maps)

    @property
    def uncompared(self) -> int:
        """Nodes that were read and whose similar nodes are not searched yet."""
        return self._comparisons.uncompared

    @property
    def compared(self) -> tuple[int, int]:
        """Nodes that were compared with all others, and pairs of them on which there is a verdict."""
        nodes = sum(len(hybrid_map.nodes) for hybrid_map in self.maps.values())
        return nodes - self.uncompared, len(self._comparisons)

    @property
    def constraints(self) -> ManualConstraints:
        """Manual constraints that are to be applied."""
        return self._constraints

    @property
    def pins(self) -> tuple[Pin, ...]:
        """Pins that are to be applied."""
        return self._pins

    @property
    def recollecting(self) -> bool:
        """Whether there are earlier verdicts that no merge has taken over yet."""
        return self._comparisons.recollecting

    def recollect(self, findings: VerificationCache, record: RestartRecord | None = None) -> None:
        """Use earlier results for nodes that are unchanged when they are read.

        Args:
            findings: of comparisons.
            record: of the last merge, and what was compared after these findings.
        """
        self._record = record
        self._comparisons.recollect(findings, record.recent if record else RecentComparisons())

    def findings(self) -> VerificationCache:
        """What was found of all nodes that are compared."""
        return self._comparisons.findings(self._nodes())

    def findings_kept(self) -> None:
        """Take note that the findings are on the disk."""
        self._comparisons.kept()

    @property
    def superseding(self) -> Superseding:
        """What is superseded after the newest merge, and what that was judged from."""
        return self._pipeline.superseder.state

    @property
    def kept(self) -> Mapping[MapId, HybridMap]:
        """The maps as they were when they were merged last, or copied."""
        return self._kept

    def prints(self) -> dict[NodeId, bytes]:
        """Fingerprints of all nodes."""
        return self._comparisons.prints(self._nodes())

    def record(self) -> RestartRecord:
        """What another process needs to go on from the last merge, besides the findings on the disk."""
        return RestartRecord.of(self.superseding, self._comparisons.recent(self._nodes()))

    def _nodes(self) -> Iterator[Node]:
        return (node for hybrid_map in self.maps.values() for node in hybrid_map.nodes.values())

    def node(self, node_id: NodeId) -> Node | None:
        """A node of any map, if it is there."""
        hybrid_map = self.maps.get(node_id.map)
        return None if hybrid_map is None else hybrid_map.nodes.get(node_id)

    def on_change(self, change: Change) -> None:
        """Take in one change, in the order of its log."""
        self.counters.changes += 1
        self.apply(change.map, change.body)
        if isinstance(change.body, NodePut):
            # A node's neighbours in its own map follow from its edges, which come after it.
            pairs = self._comparisons.pairs_of(change.body.node.id)
            self._comparisons.verify(pair for pair in pairs if pair[0].map != pair[1].map)

    def apply(self, map_id: MapId, change: ChangeBody) -> None:
        """Take in a change without comparing nodes yet."""
        before = self._comparisons.pairs_of(change.node.id) if isinstance(change, NodePut) else []
        self._replay(map_id, change)
        if isinstance(change, NodePut):
            self.places.put([change.node])
            self._comparisons.put(change.node, before)

    def read(
        self,
        log: Iterable[tuple[MapId, ChangeBody]],
        overlaps: Mapping[Pair, float] | None = None,
        links: Mapping[Pair, Link] | None = None,
    ) -> None:
        """Take in many changes at once: a store at the start. Places can be found as soon as this returns.

        Similar nodes are searched by `search_pairs`, or when they are merged; then they are compared.

        Args:
            log: each map's changes, in order.
            overlaps: of all pairs of these nodes, if known; else they are searched.
            links: known results on pairs of these nodes.
        """
        put: dict[NodeId, None] = {}
        for map_id, change in log:
            self._replay(map_id, change)
            if isinstance(change, NodePut):
                put[change.node.id] = None
        # What the database has already, just so, it leaves as it is.
        fresh = [node for node_id in put if (node := self.node(node_id)) is not None]
        self.places.put(fresh)
        if overlaps is None:
            self._comparisons.postpone(fresh)
        for (a, b), value in (overlaps or {}).items():
            self._comparisons.put_overlaps(a, {b: value})
        for pair, link in (links or {}).items():
            self._comparisons.judge(pair, link)

    def copy_maps(self) -> None:
        """Keep the maps as they are now, for a merge of them that another server has made."""
        for map_id in self._uncopied:
            # A merged map stays as it was when later changes come. What did not change is not copied: all
            # that a merge remembers of a map it remembers of this very copy.
            self._kept[map_id] = HybridMap(self.maps[map_id].contents())
        self._uncopied = set()

    def adopt(self, merged: MergedMap, has_merged: bool) -> None:
        """Have another server's merge of the maps as they are kept in the place of one of its own.

        If this merger shall merge later, it is as if it had only read the maps: see `recollect`.

        Args:
            merged: by the other server.
            has_merged: this merger has merged itself since it began, or since it adopted a merge.
        """
        if has_merged:
            self._begin()
            for hybrid_map in self.maps.values():
                self._comparisons.postpone(hybrid_map.nodes.values())
                for node in hybrid_map.nodes.values():
                    self._copies.came(node, None)
                for edge in hybrid_map.edges.values():
                    self._comparisons.connect(edge)
        before, self._merged = self._merged, merged
        if before.implausible.keys() - merged.implausible.keys() or before.wrong.keys() - merged.wrong.keys():
            self.alike.forget()
        self.places.leave_out(merged.superseded, self.node)
        self._suspects = frozenset(merged.set_apart)
        self._dirty = True

    def constrain(self, constraints: ManualConstraints) -> None:
        """Apply exactly these manual constraints from now on."""
        changed = {*constraints.in_force} ^ {*self._constraints.in_force}
        # A retired map is harmless, and is no longer set apart.
        self._isolation.release(
            constraint.about.map for constraint in changed if isinstance(constraint.about, RetiredMap)
        )
        if any(not isinstance(c.about, Apart | Linked) for c in changed - {*constraints.in_force}):
            self.alike.forget()
        self._constraints = constraints
        self._counted.changed(self.maps)
        self._dirty = True

    def pin(self, pins: Sequence[Pin]) -> None:
        """Hold the frames of components by exactly these pins from now on, oldest first."""
        if tuple(pins) != self._pins:
            self._pins = tuple(pins)
            self._dirty = True

    def suspect(self, maps: Iterable[MapId]) -> None:
        """Maps that another process has set apart: where it is this one or another, it is this one."""
        self._suspects = frozenset(maps)

    def note_refusal(self, map_id: MapId, reason: str) -> None:
        """Note that a change of a map was refused; the first reason is kept."""
        self._dirty |= self._implausible.note_refusal(map_id, reason)

    def note_disbelief(self, map_id: MapId, reason: str) -> None:
        """Note that something said of a map is not believed; the first reason is kept."""
        self._dirty |= self._implausible.note_disbelief(map_id, reason)

    def merged(self, use: Callable[[MergedMap], object] | None = None) -> MergedMap:
        """The merged map of all changes; merged again only if something has changed, and where it has.

        A map with which it fails is set apart: it is merged without it, until that has changed.

        Args:
            use: what is made of a merged map that is new; a map with which that fails is set apart as well.

        Raises:
            MemoryError: there is not enough memory; the next call begins with all maps.
        """
        while self._dirty:
            self._merge(use)
            # Nodes that have returned to the index may be like others with which they were never compared.
            self._dirty = self._comparisons.waiting
        return self._merged

    def _merge(self, use: Callable[[MergedMap], object] | None) -> None:
        self.search_pairs()
        # A server merges before it has read its store if manual constraints come first.
        if self.maps:
            self._comparisons.take_over()
        for pair, verdict in self._comparisons.changes():
            self._touched |= {pair[0].map, pair[1].map}
            self._copies.forget(pair)
            if isinstance(verdict, Link):
                self._copies.compare(*(self.maps[node.map].nodes[node] for node in pair))
            self._counted.put(pair, verdict)
        self.copy_maps()
        for map_id in self._changed:
            self._implausible.changed(map_id, self._kept[map_id])
        self._isolation.changed(self._changed)
        before = self._copied.keys()
        linked = {frozenset((a.map, b.map)) for a, b in self._constraints.links}
        self._copied = self._copies.maps(self._suspects, linked)
        self._touched |= before - self._copied.keys()
        try:
            self._find_wrong_geometry()
        except Exception:  # a defect with one map must not hold up the merge
            log.exception("the search for maps with wrong geometry failed")
        for map_id in self._changed:
            self._hold_against_way(map_id)
        self._touched |= self._counted.leave_unlinked()
        apart = self._set_apart()
        maps = [kept_id for kept_id in self._kept if kept_id not in apart]
        try:
            merged = self._made(self._pipeline, self._counted.verdicts, maps, self._touched, use)
        except MemoryError:
            # No map's fault. What is cached may be damaged, and takes memory.
            self._pipeline, self._touched = self._new_pipeline(), set(self.maps)
            raise
        except Exception as error:  # any error is of one map or a few, and not of all
            log.exception("the merge fails; looking for the map with which it does")
            merged = self._made_without_bad(maps, error, use)
        self._resumed = None
        self._leave_out(merged.superseded)
        if self._merged.implausible.keys() - merged.implausible.keys():
            self.alike.forget()
        self._merged = merged
        self.counters.merges += 1
        self._touched, self._changed = set(), set()

    def _made(
        self,
        pipeline: MergePipeline,
        verdicts: Verdicts,
        maps: Collection[MapId],
        touched: set[MapId],
        use: Callable[[MergedMap], object] | None,
    ) -> MergedMap:
        kept = {map_id: self._kept[map_id] for map_id in maps}
        pruned = self.pruning.pruned
        odd = partial(self._implausible.of, pruned=pruned.maps)
        merged = pipeline.merged(kept, verdicts, touched, self._constraints, self._pins, odd, pruned)
        merged = replace(
            merged,
            set_apart=self._set_apart(),
            copies={which: self._kept[which] for which in self._copied},
            wrong=self._counted.wrong,
            refused_changes={m: why for m, why in self._implausible.refused.items() if m in kept},
            disbelieved={m: why for m, why in self._implausible.disbelieved.items() if m in self._kept},
        )
        if use is not None:
            use(merged)
        return merged

    def _set_apart(self) -> dict[MapId, str]:
        """Maps that are not merged, and why."""
        return {**self._copied, **self._isolation.reasons}

    def _find_wrong_geometry(self) -> None:
        """Find the maps that contradict others that agree."""
        self._counted.changed(self._changed)
        # What a retired area holds only the merge says; the robot's way by it is no less true.
        nodes = retired_nodes(self._kept, self._constraints, ())
        self._constraints = self._constraints.with_nodes(nodes)
        left_out = {*self._constraints.retired, *self._set_apart()}
        if self._counted.find_wrong(self._kept, self._constraints, left_out):
            self.alike.forget()

    def _hold_against_way(self, map_id: MapId) -> None:
        """Hold the views of a map against its own way."""
        reason, hybrid_map = "", self._kept[map_id]
        try:
            pieces = self._counted.search.pieces(map_id, hybrid_map)
            compared = self._counted.verdicts.between((map_id, map_id))
            reason = self._own_views.reason(map_id, hybrid_map, pieces, compared)
        except UNSOLVABLE:
            log.debug("map %s has no way that its views could contradict", map_id)
        except Exception:  # a defect with one map must not hold up the merge
            log.exception("the views of map %s cannot be held against its own way", map_id)
        self._implausible.note_views(map_id, reason)

    def _made_without_bad(
        self, maps: Collection[MapId], first: Exception, use: Callable[[MergedMap], object] | None
    ) -> MergedMap:
        """Merge as many maps as possible, without cached state, which a failure may have damaged."""

        def attempt(some: Collection[MapId]) -> MergePipeline:
            pipeline = self._new_pipeline()
            self._made(pipeline, self._counted.verdicts, some, set(some), use)
            return pipeline

        # Those that are suspected before and the small ones last: they are rather set apart than others.
        trusted = sorted(
            maps, key=lambda map_id: (self._suspicion(map_id), -len(self._kept[map_id].nodes), map_id)
        )
        pipeline, bad = leave_out(trusted, attempt, fatal=MemoryError)
        for map_id, error in bad.items():
            self._isolation.add(map_id, reason_of(error))
        if not bad:
            log.warning(
                "the merge fails with cached state (%s) and not without it: the cache is dropped", first
            )
        self._pipeline = pipeline
        good = [map_id for map_id in maps if map_id not in bad]
        return self._made(pipeline, self._counted.verdicts, good, set(), use)

    def _suspicion(self, map_id: MapId) -> int:
        return self._isolation.suspicion(map_id) + (map_id in self._suspects)

    def search_pairs(self, most: int | None = None) -> None:
        """Search for nodes similar to those that were read, or to so many of them."""
        # A server merges before it has read its store if manual constraints come first.
        if self._record is not None and self.maps:
            record, self._record = self._record, None
            self._resume(record)
        self._comparisons.search_pairs(most)

    def _resume(self, record: RestartRecord) -> None:
        """Go on from the last merge of another process, as far as the nodes are what they were."""
        unchanged = record.unchanged(self._comparisons.prints(self._nodes()))
        self._resumed = record.superseding(unchanged, self.node)
        self._pipeline.superseder.resume(self._resumed)
        # Later nodes are not compared with what had left the index before they came.
        self._leave_out(record.superseded.keys() & unchanged)

    def _leave_out(self, superseded: Collection[NodeId]) -> None:
        for node_id, overlaps in self.places.leave_out(superseded, self.node).items():
            self._comparisons.put_overlaps(node_id, overlaps)

    def apart(self) -> MergedMap:
        """The merged map without comparisons of maps: a component for each part of each map.

        Without those with which it fails; the merge returns them.
        """
        kept = {map_id: HybridMap(hybrid_map.contents()) for map_id, hybrid_map in self.maps.items()}

        def attempt(some: Collection[MapId]) -> MergedMap:
            inside = {hybrid_map: kept[hybrid_map] for hybrid_map in some}
            return Islands(self.settings).merge(inside, Verdicts(), set(inside), self._constraints)

        return PinnedFrames().moved(leave_out(sorted(kept), attempt)[0], self._pins)

    def prune(self, plan: PrunePlan) -> None:
        """Let the nodes of a plan go, as if their robots had retired them, and keep what is left of them."""
        self.pruning.take(plan)
        if plan.nodes:
            self.let_go(plan.nodes)
            self._pipeline.islands.replace_marginals(self.pruning.marginals, self.pruning.standing)

    def restore_pruning(self, pruning: Pruning) -> None:
        """Go on with what another process has pruned; what has left since is let go besides."""
        self.pruning = pruning
        self._pipeline.islands.replace_marginals(pruning.marginals, pruning.standing)
        # Nothing else may have changed in the maps that the links join.
        self._touched |= {end.map for link in pruning.marginals for end in link.pair} & self.maps.keys()
        self._dirty = True

    def let_go(self, nodes: Collection[NodeId]) -> None:
        """Let nodes go that were pruned, as if their robots had retired them."""
        for map_id, hybrid_map in list(self.maps.items()):
            for node in nodes:
                if node in hybrid_map.nodes or hybrid_map.edges_at(node):
                    self._replay(map_id, NodeRetired(node))
            if not (hybrid_map.nodes or hybrid_map.edges):
                del self.maps[map_id]
                self._changed.discard(map_id)
                self._uncopied.discard(map_id)
                self._kept.pop(map_id, None)
        self.alike.remove(nodes)
        self.reaches.remove(nodes)

    def _replay(self, map_id: MapId, change: ChangeBody) -> None:
        """Take a change into its map, and forget what no longer holds."""
        hybrid_map = self.maps.setdefault(map_id, HybridMap())
        self._touched.add(map_id)
        self._changed.add(map_id)
        self._uncopied.add(map_id)
        self._dirty = True
        removed = hybrid_map.nodes.get(change.id) if isinstance(change, NodeRetired) else None
        before = hybrid_map.nodes.get(change.node.id) if isinstance(change, NodePut) else None
        for edge in hybrid_map.dropped_by(change):
            self._comparisons.disconnect(edge)
        hybrid_map.apply(change)
        match change:
            case NodePut(node):
                self._copies.came(node, before)
                self._comparisons.forget(node.id)
                self.places.observe(node)
            case NodeRetired(node_id):
                self._comparisons.forget(node_id)
                self._copies.gone(node_id)
                self.places.remove(removed, node_id)
            case EdgePut(edge):
                self._comparisons.connect(edge)

    def _new_pipeline(self) -> MergePipeline:
        pipeline = MergePipeline(self.settings, self.reaches, self._pause)
        pipeline.islands.replace_marginals(self.pruning.marginals, self.pruning.standing)
        if self._resumed is not None:
            pipeline.superseder.resume(self._resumed)
        return pipeline

"""Prunes after merges, and keeps the record of it in the store.

Of the servers that share a store the one that leads prunes; the others take over what it has recorded. What
the store has counts: a node that its robot has sent again meanwhile stays.
"""

import logging
import secrets
from collections.abc import Callable, Collection, Iterable, Mapping

from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.errors import InvalidMessage
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.mapserver.log.store import PRUNING_MARK, Store
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.merging.pruning import DAY_NS, Pruning, named_nodes, plan_of

log = logging.getLogger(__name__)

LEAP_NS = 3_600_000_000_000
"""By so much the machine's clock may run ahead of a clock that only grows, between two merges, before it
counts as put forward: nothing against the days for which superseded nodes are kept."""
MARK_BYTES = 16
"""Of a digest: two of a million nodes have the same with a chance below 1e-26."""


class PruningRecord:
    """What was pruned from one store. Only the merging thread may call its methods."""

    def __init__(
        self,
        store: Store,
        keep_days: float,
        named: Callable[[], Iterable[object]],
        base: Collection[MapId],
        monotonic: Callable[[], float] | None = None,
    ) -> None:
        """Nothing is done yet.

        Args:
            store: with the logs of all maps.
            keep_days: superseded nodes are kept for so long.
            named: what people have said; nodes that it names are not pruned.
            base: maps of a file beside the store, of which nothing is pruned: which state of such a map is
                newer depends on all that the store has of it.
            monotonic: a clock that only grows, s; None: the server's clock is never put forward.
        """
        self._monotonic = monotonic
        self._clocks: tuple[int, float] | None = None
        self._store, self._keep_days, self._named, self._base = store, keep_days, named, frozenset(base)
        self._mark: bytes | None = None

    @property
    def outdated(self) -> bool:
        """Whether another server has pruned since this was read; for any thread.

        Raises:
            InvalidFile: the store cannot be read.
        """
        return self._store.result(PRUNING_MARK) != self._mark

    @property
    def mark(self) -> bytes | None:
        """Of the record that was read or written last."""
        return self._mark

    def restore(self, merger: Merger) -> None:
        """Go on with what was pruned before."""
        self._mark, pruning = self._read()
        merger.restore_pruning(pruning)

    def adopt(self, merger: Merger) -> None:
        """Take over what another server has pruned, if it has.

        Raises:
            InvalidFile: the store cannot be read; nothing is taken over.
        """
        if not self.outdated:
            return
        mark, pruning = self._read()
        before, after = merger.pruning.pruned.nodes, pruning.pruned.nodes
        # Also what is no longer pruned, where PostgreSQL has lost its last commits.
        differ = [n for n in before.keys() | after.keys() if before.get(n) != after.get(n)]
        gone = {node for node in differ if node.map not in self._base}
        there = {node for node in gone if self._store.landmarks(node) is not None}
        maps = {m for m, some in merger.maps.items() for node in there if some.edges_at(node)}
        stored = {
            map_id: HybridMap(change.body for change in self._store.replay(map_id))
            for map_id in maps | {node.map for node in there}
        }
        self._mark, merger.pruning = mark, pruning
        if not differ:
            return
        merger.restore_pruning(pruning)
        merger.let_go(gone)
        for map_id, hybrid_map in stored.items():
            for node in sorted(there & hybrid_map.nodes.keys()):
                merger.apply(map_id, NodePut(hybrid_map.nodes[node]))
            for edge in {edge.id: edge for node in there for edge in hybrid_map.edges_at(node)}.values():
                merger.apply(map_id, EdgePut(edge))
        log.info("%d superseded nodes have left the map, by the server that leads", len(gone - there))

    def prune(self, merger: Merger, now_ns: int, last: Mapping[MapId, int] | None = None) -> bool:
        """Prune what is due after a merge; whether anything was. Only the server that leads does so.

        Args:
            merger: with the merged map.
            now_ns: the server's clock.
            last: up to which change of each log the merger has it; None: all that the store has.

        Raises:
            InvalidFile: the disk does not take it; nothing is pruned.
        """
        if leap := self._leap(now_ns):
            # A machine without a clock of its own begins in another year.
            log.warning("the clock was put forward by %.1f days: nothing is older for that", leap / DAY_NS)
            merger.pruning.put_forward(leap)
        if not self._store.leads:
            return False
        named = {*named_nodes(tuple(self._named()))}
        plan = plan_of(
            merger.merged(), merger.maps.values(), merger.pruning, now_ns, self._keep_days,
            lambda node: node in named or node.map in self._base,
        )  # fmt: skip
        if plan is None:
            return False
        mark = secrets.token_bytes(MARK_BYTES)
        results = {**merger.pruning.records(plan), PRUNING_MARK: mark}
        if not self._store.prune(plan.nodes, plan.edges, results, last, {PRUNING_MARK: self._mark}):
            log.info("another server has pruned meanwhile: what is superseded is looked at again")
            return False
        self._mark = mark
        merger.prune(plan)
        if plan.nodes:
            log.info("%d superseded nodes have left the map", len(plan.nodes))
        return bool(plan.nodes)

    def came(self, node: NodeId, merger: Merger) -> None:
        """A node was put that may have been pruned: by a change of before, which the store has no more.

        Raises:
            InvalidFile: the store cannot be read.
        """
        pruned = node in merger.pruning.pruned and node.map not in self._base
        if pruned and self._store.landmarks(node) is None:
            merger.let_go([node])

    def _leap(self, now_ns: int) -> int:
        """By how much the server's clock was put forward since the merge before, ns; 0 if it was not."""
        if self._monotonic is None:
            return 0
        before, self._clocks = self._clocks, (now_ns, self._monotonic())
        if before is None:
            return 0
        leap = now_ns - before[0] - round((self._clocks[1] - before[1]) * 1e9)
        return leap if leap > LEAP_NS else 0

    def _read(self) -> tuple[bytes | None, Pruning]:
        """The mark and the record that the store has, all of one time."""
        while True:
            mark, pruning = self._store.result(PRUNING_MARK), Pruning()
            try:
                pruning.restore(self._store.result)
            except InvalidMessage as error:
                log.error("the record of what was pruned is damaged (%s): maps may come apart", error)
            if self._store.result(PRUNING_MARK) == mark:
                return mark, pruning

"""Prunes after merges, and keeps the record of it in the store."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterable

from mapweave.hybridmap.errors import InvalidMessage
from mapweave.hybridmap.ids import MapId
from mapweave.mapserver.log.store import Store
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.merging.pruning import Pruning, named_nodes, plan_of

log = logging.getLogger(__name__)


class PruningRecord:
    """Of one store. Only the merging thread may call it."""

    def __init__(
        self, store: Store, keep_days: float, named: Callable[[], Iterable[object]], base: Collection[MapId]
    ) -> None:
        """Nothing is done yet.

        Args:
            store: with the logs of all maps.
            keep_days: superseded nodes are kept for so long.
            named: what people have said; nodes that it names are not pruned.
            base: maps of a file beside the store, of which nothing is pruned: which state of such a map is
                newer depends on all that the store has of it.
        """
        self._store, self._keep_days, self._named, self._base = store, keep_days, named, frozenset(base)

    def restore(self, merger: Merger) -> None:
        """Go on with what was pruned before."""
        pruning = Pruning()
        try:
            pruning.restore(self._store.result)
        except InvalidMessage as error:
            log.error("the record of what was pruned is damaged (%s): maps may come apart", error)
        merger.restore_pruning(pruning)

    def prune(self, merger: Merger, now_ns: int) -> bool:
        """Prune what is due after a merge; whether anything was.

        Raises:
            InvalidFile: the disk does not take it; nothing is pruned.
        """
        named = {*named_nodes(tuple(self._named()))}
        plan = plan_of(
            merger.merged(), merger.maps.values(), merger.pruning, now_ns, self._keep_days,
            lambda node: node in named or node.map in self._base,
        )  # fmt: skip
        if plan is None:
            return False
        self._store.prune(plan.nodes, plan.edges, merger.pruning.records(plan))
        merger.prune(plan)
        if plan.nodes:
            log.info("%d superseded nodes have left the map", len(plan.nodes))
        return bool(plan.nodes)

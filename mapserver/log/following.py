"""Changes that this server did not take itself: another one wrote them to the store that they share."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import takewhile

from mapweave.hybridmap.change import Change
from mapweave.hybridmap.node import MapId
from mapweave.mapserver.log.agent_log import AgentLog
from mapweave.mapserver.log.entry import Applied, Position
from mapweave.mapserver.log.store import Store


def unseen(store: Store, agent_log: AgentLog, applied: Applied) -> Iterable[Change]:
    """The changes behind the watermark that this server knew, up to the one that is settled now."""
    if applied.before <= agent_log.watermark:
        return applied.changes
    return up_to(applied.watermark, store.replay(agent_log.map, agent_log.watermark))


def settled(store: Store, map_id: MapId, position: Position) -> Iterable[Change]:
    """A log from its beginning; of a store that servers share up to a position, since another may add to it.

    Where damage cost the position, what is good of the log is behind it.
    """
    changes = store.replay(map_id)
    return up_to(position.watermark, changes) if store.shared else changes


def up_to(watermark: int, changes: Iterable[Change]) -> Iterable[Change]:
    """Those that are settled: another server may add more while they are read."""
    return takewhile(lambda change: change.sequence <= watermark, changes)

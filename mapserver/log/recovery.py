"""Settled changes that the disk has lost are taken from their robot again.

A robot drops what later changes undo, and at last the retirement itself. So where it lacks a change that the
disk has lost, that may have been the retirement of what the store still has: all changes before it are
compared with the robot's log, and what the robot has dropped goes here, too.
"""

import logging
from collections.abc import Iterable

from mapweave.hybridmap.change import Change
from mapweave.mapserver.log.agent_log import AgentLog
from mapweave.mapserver.log.entry import ReceivedChange
from mapweave.mapserver.log.pulled import PulledChanges
from mapweave.mapserver.log.store import Store

log = logging.getLogger(__name__)


def recover(
    store: Store, agent_log: AgentLog, first: int, piece: PulledChanges
) -> tuple[Iterable[Change], int]:
    """Restore damaged changes, or verify others.

    Args:
        store: stays the caller's.
        agent_log: what is damaged or unverified of it is brought up to date.
        first: of the changes that the robot was asked for.
        piece: what it has of them.

    Returns:
        The changes to pass on in order, and how many were restored.

    Raises:
        InvalidFile: the disk does not take it; nothing is changed.
    """
    changes: Iterable[Change]
    map_id, covered, restored = agent_log.map, piece.covered, 0
    if agent_log.was_damaged(first):
        changes = store.restore(
            map_id, first, covered, [ReceivedChange.read(map_id, *row) for row in piece.rows]
        )
        restored = len(piece.rows)
        log.warning("changes %d to %d of %s are whole again", first, covered, map_id)
    else:
        changes = store.verify(map_id, first, covered, {sequence for sequence, _ in piece.rows})
        log.warning("changes %d to %d of %s are as the robot has them", first, covered, map_id)
    agent_log.damaged, agent_log.unverified = store.damaged(map_id), store.unverified(map_id)
    return changes, restored

"""Changes on their way into a merger: known at once, taken in when it is their turn."""

import logging
import threading
from collections.abc import Sequence

from mapweave.hybridmap.change import Change, NodePut
from mapweave.hybridmap.errors import InvalidFile, MapweaveError
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Node
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.merging.pruning_record import PruningRecord
from mapweave.wire.fair_queue import FairQueue

log = logging.getLogger(__name__)


class MergeIntake:
    """Robots take turns. Only the merging thread takes changes out, and into the merger.

    Attributes:
        last: the last change of each log that was taken in.
    """

    def __init__(self, merger: Merger, pruning: PruningRecord | None) -> None:
        """Nothing has come yet.

        Args:
            merger: takes the changes.
            pruning: says which nodes have been pruned before they come.
        """
        self._merger, self._pruning = merger, pruning
        self._fresh: dict[NodeId, Node] = {}
        self._waiting: FairQueue[Change] = FairQueue(0, 0)
        self._turn = threading.Lock()
        self.last: dict[MapId, int] = {}

    def __len__(self) -> int:
        return len(self._waiting)

    def waiting(self, robot: str) -> int:
        """Changes of a robot that wait."""
        return self._waiting.waiting(robot)

    def put(self, change: Change) -> None:
        """Have a change wait. A new place can be found from now on. From any thread."""
        if isinstance(change.body, NodePut):
            self._fresh[change.body.node.id] = change.body.node
            self._merger.places.announce(change.body.node)
        with self._turn:
            self._waiting.put(change.map.agent, change, bounded=False)

    def pop(self) -> Change:
        """The change whose turn it is."""
        with self._turn:
            return self._waiting.pop()[1]

    def node(self, node_id: NodeId) -> Node | None:
        """A node, also one that is not with the merger yet."""
        return self._fresh.get(node_id) or self._merger.node(node_id)

    def take(self, change: Change) -> None:
        """Take a change in."""
        if isinstance(change.body, NodePut):
            newest = self._fresh.get(change.body.node.id)
            if newest is not None and newest is not change.body.node:
                return  # The same node is put again by a change that waits: the last one counts.
        self._apply(change)
        self._has_come(change)

    def take_held(self, changes: Sequence[Change]) -> None:
        """Take changes in that were held back, without comparing nodes."""
        if changes:
            self.read(changes)
            self._merger.counters.changes += len(changes)
        for change in changes:
            self._has_come(change)

    def read(self, changes: Sequence[Change]) -> None:
        """Take in what a store has, without comparing nodes."""
        self.last |= {change.map: change.sequence for change in changes}
        try:
            self._merger.read((change.map, change.body) for change in changes)
        except Exception:  # a log may be replayed: a defect in one change must not stop the others
            log.exception("the changes in the store are taken in one by one")
            for change in changes:
                self._apply(change)

    def _apply(self, change: Change) -> None:
        # A change that was damaged comes again behind later ones.
        self.last[change.map] = max(change.sequence, self.last.get(change.map, 0))
        try:
            self._merger.on_change(change)
        except MapweaveError as error:
            log.warning("change %s of %s is not merged: %s", change.sequence, change.map, error)
        except Exception:  # a defect with one change must not end all merging
            log.exception("change %s of %s is not merged", change.sequence, change.map)

    def _has_come(self, change: Change) -> None:
        """The merger has a node now, unless it was pruned before."""
        if not isinstance(change.body, NodePut):
            return
        node = change.body.node
        if self._fresh.get(node.id) is node:
            del self._fresh[node.id]
        if self._pruning:
            try:
                self._pruning.came(node.id, self._merger)
            except InvalidFile as error:  # it stays until the next start
                log.warning("%s", error)
            except Exception:  # likewise; a defect with one node must not end the taking in of others
                log.exception("%s may be pruned, and stays", node.id)

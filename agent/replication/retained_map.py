"""What a journal has kept of a map that is to be resumed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.log_entry import LogEntry
from mapweave.hybridmap.change import ChangeBody, EdgeRetired, NodeRetired
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId


@dataclass(frozen=True)
class RetainedMap:
    """A map as it can be gone on with.

    Attributes:
        contents: what is still in force, nodes first.
        next_number: the first that no node or edge of the map has ever had, also none that was retired.
        complaint: in one line, what the disk has damaged; empty if nothing.
    """

    contents: tuple[ChangeBody, ...]
    next_number: int
    complaint: str = ""

    @staticmethod
    def of(journal: Journal, map_id: MapId) -> RetainedMap:
        """Read a map that was opened in a journal; see `of_entries`.

        Raises:
            InvalidValue: the map is another agent's.
            InvalidFile: the journal cannot be read at all.
        """
        return RetainedMap.of_entries(map_id, journal.entries(map_id))

    @staticmethod
    def of_entries(map_id: MapId, entries: Iterable[LogEntry]) -> RetainedMap:
        """Replay the changes of a map.

        What the disk has damaged is left out, with the edges at nodes that are missing for it. A damaged
        retirement still retires. Where a newer state of an element is damaged an older one is used.
        """
        hybrid, next_number, head = HybridMap(), 1, 0
        damaged: list[int] = []
        for entry in entries:
            head = entry.sequence
            next_number = max(next_number, entry.element.number + 1)
            if entry.body is not None:
                hybrid.apply(entry.body)
                continue
            damaged.append(entry.sequence)
            if not entry.put:
                hybrid.apply(EdgeRetired(entry.element))
                hybrid.apply(NodeRetired(entry.element))
        loose = [
            edge.id
            for edge in hybrid.edges.values()
            # Nodes of others, between which it may have driven, are not its own to keep.
            if any(end.map == map_id and end not in hybrid.nodes for end in (edge.a, edge.b))
        ]
        for edge in loose:
            hybrid.apply(EdgeRetired(edge))
        complaint = ""
        if damaged:
            also = f" and without {len(loose)} edges at nodes that are missing" if loose else ""
            complaint = (
                f"{len(damaged)} of {head} changes of map {map_id} are damaged on the disk, "
                f"the first is {damaged[0]}: the map goes on without them{also}"
            )
        return RetainedMap(tuple(hybrid.contents()), next_number, complaint)

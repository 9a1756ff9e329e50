"""What a log need no longer say because nodes or edges were retired."""

from collections.abc import Iterable

from mapweave.agent.replication.log_entry import LogEntry
from mapweave.hybridmap.change import EdgePut, NodeRetired
from mapweave.hybridmap.ids import NodeId


def undone(entries: Iterable[LogEntry], limit: int, everyone: int) -> list[int]:
    """Changes without which a log gives the same map: edges at retired nodes, and the retirements.

    The newest change stays, and that of the greatest number: from them follows which come next.

    Args:
        entries: of a log, in order. Up to the limit no element has a change before a later one that puts it
            or retires it, but for retirements.
        limit: edges go up to this change.
        everyone: retirements go up to this change, which is not behind the limit.

    Returns:
        Their sequence numbers.
    """
    entries = list(entries)
    newest = max((entry.sequence for entry in entries), default=0)
    greatest = max((entry.element.number for entry in entries), default=0)
    retired = {
        entry.element: entry.sequence
        for entry in entries
        if isinstance(entry.body, NodeRetired) and entry.sequence <= limit
    }
    out: list[int] = []
    # Nodes at which an edge stays that only their retirement takes away.
    needed: set[NodeId] = set()
    for entry in entries:
        if isinstance(entry.body, EdgePut):
            ends = {entry.body.edge.a, entry.body.edge.b}
            gone = {end for end in ends if entry.sequence < retired.get(end, 0)}
            if gone and entry.element.number != greatest:
                out.append(entry.sequence)
            else:
                needed |= gone
    out += [
        entry.sequence
        for entry in entries
        if not entry.put
        and entry.body is not None
        and entry.sequence <= everyone
        and entry.sequence != newest
        and entry.element.number != greatest
        and entry.element not in needed
    ]
    return out

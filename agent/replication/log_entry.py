"""One change of a log as a journal has kept it."""

from typing import NamedTuple

from mapweave.hybridmap.change import ChangeBody
from mapweave.hybridmap.ids import NodeId


class LogEntry(NamedTuple):
    """One change of a log: the node or edge that it writes or retires; body None if damaged."""

    sequence: int
    element: NodeId
    put: bool
    body: ChangeBody | None

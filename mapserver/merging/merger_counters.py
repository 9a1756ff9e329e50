"""Counters of a merger."""

from dataclasses import dataclass


@dataclass
class MergerCounters:
    """Counters of the merger since its start.

    Attributes:
        changes: taken in.
        verified: pairs of nodes that were compared.
        recognised: of these, pairs whose landmarks agreed.
        merges: number of merges.
    """

    changes: int = 0
    verified: int = 0
    recognised: int = 0
    merges: int = 0

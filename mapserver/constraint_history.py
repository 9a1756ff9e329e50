"""The history of the maps: manual constraints and the merge's own events, in order."""

from __future__ import annotations

from collections.abc import Iterable

from mapweave.hybridmap.manual_constraint import ManualConstraints, event_words
from mapweave.hybridmap.map_event import MapEvent, MapEventKind


def with_constraints(events: Iterable[MapEvent], constraints: ManualConstraints) -> tuple[MapEvent, ...]:
    """Events of the merge and manual constraints, in order."""
    constrained = [
        MapEvent(constraint.stamp_ns, MapEventKind.CONSTRAINED, event_words(constraint))
        for constraint in constraints.made
    ]
    return tuple(sorted([*constrained, *events], key=lambda one: one.stamp_ns))

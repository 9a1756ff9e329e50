"""The history of the maps: what people decided and said, and the merge's own events, in order."""

from __future__ import annotations

from collections.abc import Iterable

from mapweave.hybridmap.annotation import Annotations
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints, reason_of
from mapweave.hybridmap.map_event import MapEvent, MapEventKind


def with_constraints(
    events: Iterable[MapEvent], constraints: ManualConstraints, annotations: Annotations | None = None
) -> tuple[MapEvent, ...]:
    """Events of the merge, manual constraints and annotations, in order."""
    constrained = [
        MapEvent(constraint.stamp_ns, MapEventKind.CONSTRAINED, said_of(constraint))
        for constraint in constraints.made
    ]
    annotated = [
        MapEvent(annotation.stamp_ns, MapEventKind.ANNOTATED, annotation.words)
        for annotation in (annotations or Annotations()).made
    ]
    return tuple(sorted([*constrained, *annotated, *events], key=lambda one: one.stamp_ns))


def said_of(constraint: ManualConstraint) -> str:
    """A manual constraint as an event, in one sentence."""
    first, second = constraint.ends
    who = constraint.who or "a person"
    if constraint.retires is not None:
        return (
            reason_of(constraint)
            if constraint.apart
            else f"map {constraint.retires} is in use again, by {who}"
        )
    words = reason_of(constraint) if constraint.apart else f"may be linked again, by {who}"
    return f"{first} and {second}: {words}"

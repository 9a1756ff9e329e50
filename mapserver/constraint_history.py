"""The history of the maps: what people decided and said, and the merge's own events, in order."""

from collections.abc import Iterable

from mapweave.hybridmap.annotation import Annotations
from mapweave.hybridmap.manual_constraint import ManualConstraints, event_words
from mapweave.hybridmap.map_event import MapEvent, MapEventKind


def with_constraints(
    events: Iterable[MapEvent], constraints: ManualConstraints, annotations: Annotations | None = None
) -> tuple[MapEvent, ...]:
    """Events of the merge, manual constraints and annotations, in order."""
    constrained = [
        MapEvent(constraint.stamp_ns, MapEventKind.CONSTRAINED, event_words(constraint))
        for constraint in constraints.made
    ]
    annotated = [
        MapEvent(annotation.stamp_ns, MapEventKind.ANNOTATED, annotation.words)
        for annotation in (annotations or Annotations()).made
    ]
    return tuple(sorted([*constrained, *annotated, *events], key=lambda one: one.stamp_ns))

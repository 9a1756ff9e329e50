"""What people have ruled, told in order with what has become of the maps by itself."""

from __future__ import annotations

from collections.abc import Iterable

from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints, reason_of
from mapweave.hybridmap.map_event import MapEvent, MapEventKind


def with_rulings(happenings: Iterable[MapEvent], rulings: ManualConstraints) -> tuple[MapEvent, ...]:
    """What has happened by itself and what people have ruled, in order."""
    ruled = [MapEvent(ruling.stamp_ns, MapEventKind.RULED, said_of(ruling)) for ruling in rulings.made]
    return tuple(sorted([*ruled, *happenings], key=lambda one: one.stamp_ns))


def said_of(ruling: ManualConstraint) -> str:
    """What has come of a ruling, in one sentence."""
    first, second = ruling.ends
    who = ruling.who or "somebody"
    if ruling.retires is not None:
        return reason_of(ruling) if ruling.apart else f"map {ruling.retires} is in use again, says {who}"
    words = reason_of(ruling) if ruling.apart else f"may be linked again, says {who}"
    return f"{first} and {second}: {words}"

"""What people have ruled, told in order with what has become of the maps by itself."""

from __future__ import annotations

from collections.abc import Iterable

from hybridmap.history import Happening, Kind
from hybridmap.ruling import Ruling, Rulings, reason_of


def with_rulings(happenings: Iterable[Happening], rulings: Rulings) -> tuple[Happening, ...]:
    """What has happened by itself and what people have ruled, in order."""
    ruled = [Happening(ruling.stamp_ns, Kind.RULED, said_of(ruling)) for ruling in rulings.made]
    return tuple(sorted([*ruled, *happenings], key=lambda one: one.stamp_ns))


def said_of(ruling: Ruling) -> str:
    """What has come of a ruling, in one sentence."""
    first, second = ruling.ends
    who = ruling.who or "somebody"
    if ruling.retires is not None:
        return reason_of(ruling) if ruling.apart else f"map {ruling.retires} is in use again, says {who}"
    words = reason_of(ruling) if ruling.apart else f"may be linked again, says {who}"
    return f"{first} and {second}: {words}"

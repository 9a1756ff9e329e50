"""Manual constraints: decisions of a person on links and maps, which override the robots' measurements."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.limits import Stamp
from mapweave.hybridmap.node import NUMBER, MapId, NodeId, check_name

Ends = tuple[NodeId, NodeId] | tuple[MapId, MapId]
"""Two nodes, or two maps; the smaller first. The same map twice: it is about the map itself."""

EXAMPLE = "two nodes look like r0.1.17 r1.1.5, two maps like r0.1 r1.1"

MOST_WORDS = 300
"""Characters of a reason."""

NANOSECONDS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class ManualConstraint:
    """That two nodes, or two maps, shall not be linked, or that they may be again; or that a map is retired.

    Attributes:
        ends: what it is about. Of two maps it holds for every link between them, also for those to come. The
            same map twice: the map is retired, and takes no part in anything.
        apart: whether they shall not be linked; False withdraws an earlier constraint.
        who: has decided.
        stamp_ns: when, wall time since 1970.
        because: why, in that one's words; may be empty.
    """

    ends: Ends
    apart: bool
    who: str
    stamp_ns: Stamp
    because: str = ""

    def __post_init__(self) -> None:
        """Put the ends in order.

        Raises:
            InvalidValue: no two different nodes or maps, or words that are no single printable line.
        """
        first, second = sorted(self.ends)
        if len(first) != len(second) or (first == second and isinstance(first, NodeId)):
            raise InvalidValue("a manual constraint needs two different nodes, or two maps")
        for words in (self.who, self.because):
            if len(words) > MOST_WORDS or not words.isprintable():
                raise InvalidValue(f"who and why must be one printable line, at most {MOST_WORDS} characters")
        object.__setattr__(self, "ends", (first, second))

    @property
    def retires(self) -> MapId | None:
        """The map that it retires, or takes in again; None if it is about two nodes or two maps."""
        first, second = self.ends
        return MapId(*first) if first == second else None


class ManualConstraints:
    """All manual constraints in the order of their dates; for the same ends the last holds."""

    def __init__(self, made: Iterable[ManualConstraint] = ()) -> None:
        """Take them over; the same one twice counts once."""
        self.made = tuple(dict.fromkeys(made))
        self._last = {constraint.ends: constraint for constraint in self.made}

    def __add__(self, other: ManualConstraints) -> ManualConstraints:
        """Both, by the time when they were made."""
        return ManualConstraints(
            sorted({*self.made, *other.made}, key=lambda r: (r.stamp_ns, r.ends, r.apart))
        )

    @property
    def in_force(self) -> tuple[ManualConstraint, ...]:
        """Those that keep something apart, in the order of their ends."""
        return tuple(self._last[ends] for ends in sorted(self._last) if self._last[ends].apart)

    @property
    def retired(self) -> dict[MapId, ManualConstraint]:
        """Retired maps, with the constraints that retire them."""
        return {
            constraint.retires: constraint for constraint in self.in_force if constraint.retires is not None
        }

    def against(self, a: NodeId, b: NodeId) -> ManualConstraint | None:
        """The constraint by which two nodes shall not be linked; None if there is none in force."""
        for ends in (_ordered(a, b), _ordered(a.map, b.map), (a.map, a.map), (b.map, b.map)):
            latest = self._last.get(ends)
            if latest is not None and latest.apart:
                return latest
        return None

    def about(self, first: NodeId | MapId, second: NodeId | MapId) -> tuple[ManualConstraint, ...]:
        """Every constraint on these two, or on the maps of these two nodes."""
        ends = [_ordered(first, second)]
        maps = [end.map if isinstance(end, NodeId) else end for end in (first, second)]
        ends += [_ordered(*maps), *((end, end) for end in maps)]
        return tuple(constraint for constraint in self.made if constraint.ends in ends)


def reason_of(constraint: ManualConstraint) -> str:
    """For example `undone by anna on 2026-03-01 12:00 UTC: "two kitchens"`."""
    when = datetime.fromtimestamp(constraint.stamp_ns // NANOSECONDS, UTC).strftime("%Y-%m-%d %H:%M UTC")
    first, second = constraint.ends
    scope = "" if isinstance(first, NodeId) else f" with all links between {first} and {second}"
    why = f': "{constraint.because}"' if constraint.because else ""
    if constraint.retires is not None:
        return f"map {constraint.retires} is retired by {constraint.who or 'a person'} on {when}{why}"
    return f"undone{scope} by {constraint.who or 'a person'} on {when}{why}"


def read_ends(first: str, second: str) -> Ends:
    """Two nodes or two maps as people write them.

    Raises:
        InvalidValue: they are neither.
    """
    a, b = read_end(first), read_end(second)
    if isinstance(a, NodeId) and isinstance(b, NodeId):
        return a, b
    if isinstance(a, NodeId) or isinstance(b, NodeId):
        raise InvalidValue(f"{first} and {second} are a node and a map: {EXAMPLE}")
    return a, b


def read_end(word: str) -> NodeId | MapId:
    """A node (r0.1.17) or a map (r0.1).

    Raises:
        InvalidValue: it is neither.
    """
    parts = word.split(".")
    if len(parts) == 3:
        return NodeId.parse(word)
    if len(parts) != 2 or not NUMBER.fullmatch(parts[1]):
        raise InvalidValue(f"{word!r} is neither a node nor a map: {EXAMPLE}")
    return MapId(check_name(parts[0]), int(parts[1]))


def _ordered(a: NodeId | MapId, b: NodeId | MapId) -> Ends:
    first, second = sorted((a, b))
    return first, second  # type: ignore[return-value]

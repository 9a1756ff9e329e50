"""Annotations: what people say about a map without changing the merge, such as the names of places.

The record is kept as it was made: an entry is never deleted, a later one of the same kind and name holds in
its place.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, ClassVar, TypeVar
from unicodedata import normalize

from msgspec import Meta

from mapweave.hybridmap.area import Area
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.floor_plan import FloorPlan
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.limits import Stamp
from mapweave.hybridmap.manual_constraint import MOST_WORDS
from mapweave.hybridmap.pin import Pin
from mapweave.hybridmap.portal import Portal
from mapweave.hybridmap.wall_time import utc_words

MAX_NAME = 64
"""Characters. A limit for messages."""
LEAST_FACTOR, MOST_FACTOR = 0.1, 100.0
"""By which a preference multiplies the cost of a way."""
MAX_ANNOTATIONS = 10_000
"""Made by hand, one by one."""
RESERVED = ("home", "area", "here", "all")
"""Words of commands, which are no names of places."""
LIKE_AN_ID = re.compile(r"[a-z0-9][a-z0-9_-]*(\.[0-9]+){1,2}", re.IGNORECASE)

Name = Annotated[str, Meta(min_length=1, max_length=MAX_NAME)]
Pair = tuple[NodeId, NodeId]


@dataclass(frozen=True, slots=True)
class Place:
    """A place with a name: a node, or an area.

    Attributes:
        node: where it is; None if it is an area.
        area: its extent; None if it is a node.
    """

    TAG: ClassVar[str] = "place"
    node: NodeId | None = None
    area: Area | None = None

    def __post_init__(self) -> None:
        """Refuse both, and neither (InvalidValue)."""
        _check_one("a place is a node or an area", self.node, self.area)

    @property
    def anchor(self) -> NodeId:
        """The node by which its position is known."""
        return _one(self.node, self.area)

    @property
    def words(self) -> str:
        """The annotation in words."""
        return f"node {self.node}" if self.area is None else _area_words(self.area)


@dataclass(frozen=True, slots=True)
class Closure:
    """Robots do not drive along an edge, or through an area, between two times.

    Attributes:
        edge: its two nodes; what crosses its middle is closed with it. None if it is an area.
        area: None if it is an edge.
        begin_ns: from when on, wall time since 1970; None: from the beginning.
        end_ns: until when; None: until it is withdrawn.
    """

    TAG: ClassVar[str] = "closure"
    edge: Pair | None = None
    area: Area | None = None
    begin_ns: Stamp | None = None
    end_ns: Stamp | None = None

    def __post_init__(self) -> None:
        """Refuse both, neither, and an end before the beginning (InvalidValue)."""
        _check_one("a closure is of an edge or an area", self.edge, self.area)
        _check_edge(self.edge)
        if self.end_ns is not None and (self.begin_ns or 0) >= self.end_ns:
            raise InvalidValue("the closure ends before it begins")

    def holds(self, stamp_ns: int) -> bool:
        """Whether it is in force at a time."""
        return (self.begin_ns or 0) <= stamp_ns and (self.end_ns is None or stamp_ns < self.end_ns)

    @property
    def anchor(self) -> NodeId:
        """The node by which its position is known."""
        return _one(self.edge and self.edge[0], self.area)

    @property
    def words(self) -> str:
        """The annotation in words."""
        begin = "" if self.begin_ns is None else f" from {utc_words(self.begin_ns)}"
        end = "" if self.end_ns is None else f" until {utc_words(self.end_ns)}"
        return f"{_edge_or_area(self.edge, self.area)}, closed{begin}{end}"


@dataclass(frozen=True, slots=True)
class Preference:
    """Ways that robots prefer, or avoid where they can.

    Attributes:
        factor: by which the cost of these ways is multiplied: below 1 they are preferred, above 1 avoided.
        edge: its two nodes; None if it is an area.
        area: None if it is an edge.
    """

    TAG: ClassVar[str] = "preference"
    factor: Annotated[float, Meta(ge=LEAST_FACTOR, le=MOST_FACTOR)]
    edge: Pair | None = None
    area: Area | None = None

    def __post_init__(self) -> None:
        """Refuse both, neither, and a factor that says nothing (InvalidValue)."""
        _check_one("a preference is of an edge or an area", self.edge, self.area)
        _check_edge(self.edge)
        if not (LEAST_FACTOR <= self.factor <= MOST_FACTOR) or self.factor == 1.0:
            within = f"{LEAST_FACTOR:g} to {MOST_FACTOR:g}"
            raise InvalidValue(f"factor {self.factor:g}: give {within}, below 1 to prefer, above to avoid")

    @property
    def anchor(self) -> NodeId:
        """The node by which its position is known."""
        return _one(self.edge and self.edge[0], self.area)

    @property
    def words(self) -> str:
        """What it is about, for people."""
        verb = "preferred" if self.factor < 1.0 else "avoided"
        return f"{_edge_or_area(self.edge, self.area)}, {verb}: cost times {self.factor:g}"


@dataclass(frozen=True, slots=True)
class Floor:
    """The floor on which a robot's map is; the name of the annotation is the map.

    Attributes:
        node: one of the map.
        label: of the floor.
    """

    TAG: ClassVar[str] = "floor"
    node: NodeId
    label: Annotated[str, Meta(min_length=1, max_length=MAX_NAME)]

    def __post_init__(self) -> None:
        """Refuse labels that are no single printable line (InvalidValue)."""
        if not 1 <= len(self.label) <= MAX_NAME or not self.label.isprintable():
            raise InvalidValue(f"the label of a floor has 1 to {MAX_NAME} printable characters")

    @property
    def anchor(self) -> NodeId:
        """The node by which it is known."""
        return self.node

    @property
    def words(self) -> str:
        """The annotation in words."""
        return f"on floor {self.label}"


Body = Place | Closure | Preference | Floor | Portal | FloorPlan | Pin
BODIES: dict[str, type[Body]] = {
    body.TAG: body for body in (Place, Closure, Preference, Floor, Portal, FloorPlan, Pin)
}
"""Kinds of annotations, by the word that names them in messages."""
AnyBody = TypeVar("AnyBody", bound=Body)


@dataclass(frozen=True, slots=True)
class Annotation:
    """One entry of the record.

    Attributes:
        name: for the same kind and name the last entry holds. Keyboards write a letter with an accent as one
            character or as two; here it is one.
        body: what is said.
        removed: whether it is withdrawn.
        who: has said so.
        stamp_ns: when, wall time since 1970.
        because: why, in that one's words; may be empty.
    """

    name: Name
    body: Body
    removed: bool
    who: str
    stamp_ns: Stamp
    because: str = ""

    def __post_init__(self) -> None:
        """Refuse what is no printable line, and a place called like a node or a position (InvalidValue)."""
        object.__setattr__(self, "name", normalize("NFC", self.name))
        if not 1 <= len(self.name) <= MAX_NAME or not self.name.isprintable():
            raise InvalidValue(f"a name has 1 to {MAX_NAME} printable characters")
        if isinstance(self.body, Place):
            check_place_name(self.name)
        if isinstance(self.body, Floor) and self.name != str(self.body.node.map):
            raise InvalidValue(f"the floor of map {self.body.node.map} cannot be called {self.name!r}")
        for words in (self.who, self.because):
            if len(words) > MOST_WORDS or not words.isprintable():
                raise InvalidValue(f"who and why must be one printable line, at most {MOST_WORDS} characters")

    @property
    def kind(self) -> str:
        """The kind of the body: place, closure and so on."""
        return self.body.TAG

    @property
    def words(self) -> str:
        """The entry in one sentence."""
        by = f", by {self.who or 'a person'}" + (f': "{self.because}"' if self.because else "")
        return (
            f"{self.kind} {self.name} " + ("is withdrawn" if self.removed else f"is {self.body.words}") + by
        )


@dataclass(frozen=True, slots=True)
class AnnotationRequest:
    """An annotation for a server.

    Attributes:
        annotation: to be kept.
        check: whether only to say what it would do.
    """

    annotation: Annotation
    check: bool = False


@dataclass(frozen=True)
class Annotations:
    """The record, in the order in which it was made.

    Attributes:
        made: all entries.
    """

    made: tuple[Annotation, ...] = ()

    def __add__(self, other: Annotations | Iterable[Annotation]) -> Annotations:
        """Both, by the time when they were made; the same entry twice counts once."""
        entries = other.made if isinstance(other, Annotations) else other
        both = dict.fromkeys((*self.made, *entries))
        return Annotations(tuple(sorted(both, key=lambda one: (one.stamp_ns, one.kind, one.name))))

    def last(self, kind: str, name: str) -> Annotation | None:
        """The entry that holds; None if there is none, or it is withdrawn."""
        entry = self._last.get((kind, normalize("NFC", name)))
        return None if entry is None or entry.removed else entry

    def in_force(self, body: type[AnyBody]) -> tuple[tuple[Annotation, AnyBody], ...]:
        """Entries of one kind that hold, with their bodies, in the order of their names."""
        return tuple(
            (entry, entry.body)
            for _, entry in sorted(self._last.items())
            if isinstance(entry.body, body) and not entry.removed
        )

    @property
    def pins(self) -> tuple[Pin, ...]:
        """Pins that hold, oldest first."""
        made = sorted(self.in_force(Pin), key=lambda item: item[0].stamp_ns)
        return tuple(pin for _, pin in made)

    @cached_property
    def floors(self) -> dict[MapId, str]:
        """Labels of the maps of which people say on which floor they are."""
        return {floor.node.map: floor.label for _, floor in self.in_force(Floor)}

    @cached_property
    def _last(self) -> dict[tuple[str, str], Annotation]:
        return {(entry.kind, entry.name): entry for entry in self.made}


def check_place_name(name: str) -> None:
    """Refuse names that commands would take for something else.

    Raises:
        InvalidValue: it looks like a node, a map, a position or an option, or is a word of commands.
    """
    if name != name.strip() or name.startswith("-"):
        raise InvalidValue(f"place {name!r}: a name begins with no '-', and has no blanks at its ends")
    if name.casefold() in RESERVED:
        raise InvalidValue(f"place {name!r}: this word has a meaning of its own; take another one")
    if LIKE_AN_ID.fullmatch(name) or _is_position(name):
        raise InvalidValue(f"place {name!r} looks like a node, a map or a position; take another name")


def _is_position(name: str) -> bool:
    try:
        return len(list(map(float, name.split(",")))) > 1
    except ValueError:
        return False


def _check_one(choice: str, first: object, second: object) -> None:
    if (first is None) == (second is None):
        raise InvalidValue(f"{choice}: give one of them")


def _check_edge(edge: Pair | None) -> None:
    if edge is not None and edge[0] == edge[1]:
        raise InvalidValue(f"an edge joins two different nodes, not {edge[0]} with itself")


def _one(node: NodeId | None, area: Area | None) -> NodeId:
    if node is not None:
        return node
    assert area is not None, "one of both is given"
    return area.anchor


def _edge_or_area(edge: Pair | None, area: Area | None) -> str:
    if edge is not None:
        return f"the way between {edge[0]} and {edge[1]}"
    assert area is not None, "one of both is given"
    return _area_words(area)


def _area_words(area: Area) -> str:
    return f"an area of {area.size:.1f} m² at {area.anchor}"

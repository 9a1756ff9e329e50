"""Manual constraints: decisions of a person on links and maps, which override the robots' measurements."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from mapweave.hybridmap.constraint_subject import (
    Apart,
    Ends,
    Linked,
    RetiredArea,
    RetiredMap,
    RetiredNodes,
    RetiredWindow,
    Subject,
)
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.limits import Stamp
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.wall_time import utc_words

FARTHEST = 1e4
"""Between two nodes that are linked by hand, m."""
MOST_WORDS = 300
"""Characters of a reason."""
FEW = 4
"""Nodes that are written out in a command."""


@dataclass(frozen=True, slots=True)
class ManualConstraint:
    """A person's statement that something is so, or that it no longer is.

    Attributes:
        about: what: nodes or maps kept apart, nodes linked by hand, what is retired.
        holds: False withdraws an earlier constraint.
        who: has decided.
        stamp_ns: when, wall time since 1970.
        because: why, in that one's words; may be empty.
    """

    about: Subject
    holds: bool
    who: str
    stamp_ns: Stamp
    because: str = ""

    def __post_init__(self) -> None:
        """Refuse words that are no single printable line (InvalidValue)."""
        for words in (self.who, self.because):
            if len(words) > MOST_WORDS or not words.isprintable():
                raise InvalidValue(f"who and why must be one printable line, at most {MOST_WORDS} characters")


@dataclass(frozen=True, slots=True)
class ConstraintRequest:
    """A manual constraint for a server.

    Attributes:
        constraint: to be kept. Of a link without a pose the server asks the images.
        check: whether only to say what it would do.
    """

    constraint: ManualConstraint
    check: bool = False

    def __post_init__(self) -> None:
        """Refuse what a person cannot mean; what was kept is taken back all the same.

        Raises:
            InvalidValue: an area whose outline crosses itself, or nodes of one place that are far apart.
        """
        if not self.constraint.holds:
            return
        match self.constraint.about:
            case RetiredArea(area):
                area.check_outline()
            # Written so that NaN fails.
            case Linked(pose=Pose2(x=x, y=y)) if not (abs(x) <= FARTHEST and abs(y) <= FARTHEST):
                raise InvalidValue(
                    f"a pose of {x:g},{y:g}: nodes that see one place are at most {FARTHEST:g} m apart"
                )


@dataclass(frozen=True, slots=True)
class ConstraintList:
    """The record of manual constraints.

    Attributes:
        made: all of them, in order; the first is number 1.
    """

    made: tuple[ManualConstraint, ...]


class ManualConstraints:
    """All manual constraints in the order of their dates; of those about the same the last holds.

    Attributes:
        made: in order.
        nodes: retired nodes of maps that are not retired as a whole, each with the constraint that retires
            it. Only the merge knows them, see mapweave.merge.retired_nodes.
        retired: retired maps, with the constraints that retire them.
        floors: maps of which people say on which floor they are (mapweave.hybridmap.annotation.Floor).
    """

    def __init__(
        self,
        made: Iterable[ManualConstraint] = (),
        nodes: Mapping[NodeId, ManualConstraint] | None = None,
        floors: Mapping[MapId, str] | None = None,
    ) -> None:
        """Take them over; the same one twice counts once."""
        self.made = tuple(dict.fromkeys(made))
        self.nodes: Mapping[NodeId, ManualConstraint] = {} if nodes is None else nodes
        self.floors: Mapping[MapId, str] = {} if floors is None else floors
        self._last = {constraint.about.key: constraint for constraint in self.made}
        self.retired: dict[MapId, ManualConstraint] = {}
        self._apart: dict[Ends, ManualConstraint] = {}
        for constraint in self.in_force:
            match constraint.about:
                case RetiredMap(which):
                    self.retired[which] = constraint
                case Apart(ends):
                    self._apart[ends] = constraint

    def __add__(self, other: ManualConstraints) -> ManualConstraints:
        """Both, by the time when they were made."""
        return ManualConstraints(
            sorted({*self.made, *other.made}, key=lambda c: (c.stamp_ns, c.about.key, c.holds)),
            floors={**self.floors, **other.floors},
        )

    def with_nodes(self, nodes: Mapping[NodeId, ManualConstraint]) -> ManualConstraints:
        """The same with other retired nodes."""
        return ManualConstraints(self.made, nodes, self.floors)

    def with_floors(self, floors: Mapping[MapId, str]) -> ManualConstraints:
        """The same with other labels of floors."""
        return ManualConstraints(self.made, self.nodes, floors)

    def without(self, kind: type[Subject]) -> ManualConstraints:
        """Only those that are about something else."""
        rest = (c for c in self.made if not isinstance(c.about, kind))
        return ManualConstraints(rest, floors=self.floors)

    @property
    def in_force(self) -> tuple[ManualConstraint, ...]:
        """Those that hold, in the order of what they are about."""
        return tuple(self._last[key] for key in sorted(self._last) if self._last[key].holds)

    @property
    def links(self) -> dict[tuple[NodeId, NodeId], Linked]:
        """Links by hand, by their nodes, without those that another constraint excludes."""
        return {
            (link.a, link.b): link
            for constraint in self.in_force
            if isinstance(link := constraint.about, Linked)
            and link.covariance
            and self.against(link.a, link.b) is None
        }

    def standing(self, about: Subject) -> ManualConstraint | None:
        """The constraint about this that holds, if there is one."""
        latest = self._last.get(about.key)
        return latest if latest is not None and latest.holds else None

    def taken_back(self, a: NodeId, b: NodeId) -> ManualConstraint | None:
        """The constraint by which the link by hand of two nodes no longer holds; None if there is none."""
        latest = self._last.get(Linked(a, b).key)
        return None if latest is None or latest.holds else latest

    def against(self, a: NodeId, b: NodeId) -> ManualConstraint | None:
        """The constraint by which two nodes shall not be linked; None if there is none in force."""
        pair = self._apart.get((a, b) if a <= b else (b, a))
        if pair is None:
            first, second = sorted((a.map, b.map))
            pair = self._apart.get((first, second))
        return pair or self.retires(a) or self.retires(b)

    def retires(self, node: NodeId) -> ManualConstraint | None:
        """The constraint that retires a node, or its map; None if there is none in force."""
        return self.retired.get(node.map) or self.nodes.get(node)

    def about(self, first: NodeId | MapId, second: NodeId | MapId) -> tuple[ManualConstraint, ...]:
        """Every constraint on these two, or on the maps of these two nodes."""
        nodes = {end for end in (first, second) if isinstance(end, NodeId)}
        maps = {MapId(*end[:2]) for end in (first, second)}
        retiring = {
            constraint.about.key
            for node, constraint in self.nodes.items()
            if (node in nodes if nodes else node.map in maps)
        }

        def bears(about: Subject) -> bool:
            match about:
                case Apart():
                    return {*about.ends} in (nodes, maps)
                case Linked():
                    return {about.a, about.b} == nodes if nodes else about.maps == maps
                case RetiredMap():
                    return about.map in maps
                case RetiredNodes():
                    return bool(nodes & {*about.nodes} if nodes else about.maps & maps)
                case RetiredArea() | RetiredWindow():
                    return about.key in retiring

        return tuple(constraint for constraint in self.made if bears(constraint.about))


def decided(constraint: ManualConstraint) -> str:
    """Who decided it, when and why, for example `by anna on 2026-03-01 12:00 UTC: "two kitchens"`."""
    why = f': "{constraint.because}"' if constraint.because else ""
    return f"by {constraint.who or 'a person'} on {utc_words(constraint.stamp_ns)}{why}"


def reason_of(constraint: ManualConstraint) -> str:
    """Who undid it, when and why, for example `undone by anna on 2026-03-01 12:00 UTC: "two kitchens"`."""
    about, how = constraint.about, decided(constraint)
    match about:
        case Apart((first, second)):
            scope = "" if isinstance(first, NodeId) else f" with all links between {first} and {second}"
            return f"undone{scope} {how}"
        case Linked():
            return f"linked by hand {how}"
    return f"{about} {verb_of(about)} retired {how}"


def event_words(constraint: ManualConstraint) -> str:
    """A manual constraint as an event, in one sentence."""
    about, how = constraint.about, decided(constraint)
    match about:
        case Apart() | Linked() if constraint.holds:
            return f"{about}: {reason_of(constraint)}"
        case Apart():
            return f"{about}: may be linked again, {how}"
        case Linked():
            return f"{about}: the link by hand is taken back, {how}"
    return reason_of(constraint) if constraint.holds else f"{about} {verb_of(about)} in use again, {how}"


def to_take_back(made: Sequence[ManualConstraint], number: int) -> Subject:
    """What the constraint of this number is about, so that it can be taken back.

    Args:
        made: the record, in order.
        number: from 1.

    Raises:
        InvalidValue: there is none of this number, it takes another one back, or it was taken back already:
            a later constraint about the same is another decision, which has its own number.
    """
    if not 1 <= number <= len(made):
        raise InvalidValue(f"there is no constraint {number}: the record has {len(made)}")
    asked = made[number - 1]
    if not asked.holds:
        raise InvalidValue(
            f"constraint {number} takes another one back ({event_words(asked)}): there is nothing to undo"
        )
    same = [(k, one) for k, one in enumerate(made[number:], number + 1) if one.about.key == asked.about.key]
    withdrawal = next((one for _, one in same if not one.holds), None)
    if withdrawal is None:
        return asked.about
    words = f"constraint {number} was taken back already {decided(withdrawal)}"
    last, newest = same[-1]
    if newest.holds:
        words += f"; what holds now is number {last}, {decided(newest)}"
    raise InvalidValue(words)


def retired_words(constraint: ManualConstraint) -> str:
    """Who has retired what, when and why, and how it comes back into use, in one sentence."""
    about = constraint.about
    match about:
        case RetiredMap(which):
            how = f"`mapweave map retire {which} --undo` brings it back"
        case RetiredNodes(nodes) if len(nodes) <= FEW:
            back = "them" if len(nodes) > 1 else "it"
            how = f"`mapweave map retire {' '.join(map(str, nodes))} --undo` brings {back} back"
        case _:
            how = "`mapweave map undo` lists it with the number that takes it back"
    return f"{reason_of(constraint)}; {how}"


def verb_of(about: Subject) -> str:
    """The verb of a sentence on what is retired: `is`, or `are`."""
    return "are" if isinstance(about, RetiredNodes) and len(about.nodes) > 1 else "is"

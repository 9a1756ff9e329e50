"""What people say about a map, and how they correct it: typed methods, of a fleet as of a file."""

import time
from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, TypedDict, Unpack, get_type_hints

from mapweave.hybridmap.annotation import Annotation
from mapweave.hybridmap.area import Area
from mapweave.hybridmap.constraint_subject import (
    Apart,
    Linked,
    RetiredArea,
    RetiredMap,
    Subject,
    read_ends,
    read_window,
)
from mapweave.hybridmap.errors import InvalidValue, Refused
from mapweave.hybridmap.floor_plan import PlanImage
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import (
    ConstraintRequest,
    ManualConstraint,
    event_words,
    to_take_back,
)
from mapweave.hybridmap.named_nodes import (
    NodeWord,
    asked_of,
    ids_of,
    is_position,
    noting,
    own_ids_of,
    retired_of,
    word_of,
)
from mapweave.hybridmap.pose import Pose2
from mapweave.map import Map
from mapweave.refusals import refusals
from mapweave.wire.typed import packed

Corners = Sequence[tuple[float, float]]
"""Of an area, in order around it, m, in the merged map, or on a plan."""
Time = str | int
"""ns since 1970, or text such as `2026-03-01 14:00`, in UTC unless it names a zone."""


class FloorWords(TypedDict, total=False):
    """Which floor is meant.

    Attributes:
        radius: of the floor around a node, or around a place, m.
        corners: of an area.
        near: in the part of the map where this node or place is; the largest part without.
        plan: a floor plan, in whose frame positions are then, instead of in the merged map.
    """

    radius: float | None
    corners: Corners | None
    near: NodeWord
    plan: str | None


class WayWords(FloorWords, total=False):
    """Which ways are meant: an edge, or all in an area.

    Attributes:
        edge: its two nodes.
        place: a named place.
        node: amid the floor that is meant.
    """

    edge: tuple[NodeWord, NodeWord] | None
    place: str
    node: NodeWord


FLOOR_WORDS, WAY_WORDS = (frozenset(get_type_hints(one)) for one in (FloorWords, WayWords))


class EditableMap(Map):
    """Annotations say something about the map, manual constraints correct the merge; the record keeps all.

    Each method returns in words what it says or does; with `check` nothing is kept, and the words say what it
    would do. Each raises Refused with the reason, and what `annotate` or `link` raises.
    """

    _by: str
    """Who says so."""

    @abstractmethod
    def _check_writable(self, check: bool) -> None:
        """Raise if nothing can be said, before the words are looked up; with `check` it is only checked."""

    @abstractmethod
    def _say(self, annotation: Annotation, check: bool) -> str:
        """Keep an annotation, unless it is only checked; returns what it says and does."""

    def annotate(self, kind: str, name: str, because: str = "", *, check: bool = False, **fields: Any) -> str:
        """Say something about the map, for example `annotate("place", "kitchen", node="r0.1.17")`.

        Each kind has a typed method: `place`, `close_way`, `prefer`, `floor`, `portal`, `plan`, `pin`. Of a
        map only a pin moves it.

        Args:
            kind: of the annotation: place, closure, preference, floor, portal, plan, pin.
            name: for the same kind and name the last one holds.
            because: why.
            check: only say what it would do.
            fields: of the body, see mapweave.hybridmap.annotation. Nodes may be words: a node, the name of a
                place, a position `3.1,-2.0` in the merged map. An area is `corners`, positions in the merged
                map (in the component of the place or node `near`), or `radius`, m, around `node`.

        Returns:
            What it says, in words.

        Raises:
            Refused: it says nothing new, or is about something that is not there.
            NotConnected: it is about a fleet, and no map server answers.
            MissingExtra: a map that is open needs the extra "server" for it.
            MapweaveError: the file cannot be written.
        """
        return self._annotate(name, {"kind": kind, **fields}, False, because, check)

    def withdraw(self, kind: str, name: str, because: str = "", *, check: bool = False) -> str:
        """Withdraw what was said about the map; the record keeps both. See `annotate`."""
        return self._annotate(name, {"kind": kind}, True, because, check)

    def _annotate(
        self, name: str, fields: Mapping[str, Any], removed: bool, because: str, check: bool
    ) -> str:
        self._check_writable(check)
        # It loads what reads maps: who only asks a fleet does without.
        from mapweave.mapserver.annotation_words import annotation_of_words

        notes: list[str] = []
        with refusals():
            annotation = annotation_of_words(
                name, _in_words(fields), removed, self.annotations, noting(self.resolve, notes), self.plans,
                self._by, because, time.time_ns(),
            )  # fmt: skip
        return "; ".join((self._say(annotation, check), *notes))

    @abstractmethod
    def put_plan_image(self, png: bytes) -> PlanImage:
        """Keep the image of a plan, a PNG file, before the annotation that names it."""

    @abstractmethod
    def plan_image(self, sha256: str) -> bytes:
        """The PNG file of a plan, by the name of its image."""

    def place(
        self, name: str, node: NodeWord = "", *, because: str = "", check: bool = False,
        **floor: Unpack[FloorWords],
    ) -> str:  # fmt: skip
        """Name a node, the floor within a radius of it, m, or the floor within corners.

        Args:
            name: of the place; the same name again: the later one holds.
            node: where it is; none with corners.
            because: why.
            check: only say what it would do.
            floor: radius, corners, near and plan, see `FloorWords`.
        """
        return self.annotate("place", name, because, check=check, **_where(floor, FLOOR_WORDS, node=node))

    def close_way(
        self, name: str, *, begin: Time | None = None, end: Time | None = None, because: str = "",
        check: bool = False, **ways: Unpack[WayWords],
    ) -> str:  # fmt: skip
        """Close an edge or an area to robots; give one of edge, place, node with radius, and corners.

        Args:
            name: of the closure.
            begin: from when on; from now on without.
            end: until when; until it is withdrawn without.
            because: why.
            check: only say what it would do.
            ways: edge, place, node, radius, corners, near and plan, see `WayWords`.
        """
        fields = {**_where(ways, WAY_WORDS), **_given(begin_ns=begin, end_ns=end)}
        return self.annotate("closure", name, because, check=check, **fields)

    def prefer(
        self, name: str, factor: float, *, because: str = "", check: bool = False, **ways: Unpack[WayWords]
    ) -> str:
        """Let robots prefer ways, or avoid them where they can; which ways, see `close_way`.

        Args:
            name: of the preference.
            factor: by which their cost is multiplied: 0.1 to 1 prefers, 1 to 100 avoids.
            because: why.
            check: only say what it would do.
            ways: edge, place, node, radius, corners, near and plan, see `WayWords`.
        """
        return self.annotate(
            "preference", name, because, check=check, factor=factor, **_where(ways, WAY_WORDS)
        )

    def floor(
        self,
        node: NodeWord,
        label: str,
        *,
        near: NodeWord = "",
        plan: str | None = None,
        because: str = "",
        check: bool = False,
    ) -> str:
        """Label the map of a node with its floor; a label that parts maps needs a reason.

        Args:
            node: any of the map.
            label: of the floor.
            near: see `place`.
            plan: see `place`.
            because: why.
            check: only say what it would do.
        """
        words = [word_of(node)]
        if plan is not None:
            from mapweave.mapserver.plan_answers import off_plan

            words = off_plan(words, self.plans().plan(plan), word_of(near), self.resolve)
        notes: list[str] = []
        (own,) = ids_of(words, noting(self.resolve, notes), word_of(near))
        name = str(NodeId.parse(own).map)
        said = self.annotate("floor", name, because, check=check, node=own, label=label)
        return "; ".join((said, *notes))

    def portal(
        self,
        name: str,
        a: NodeWord,
        b: NodeWord,
        means: Literal["lift", "ramp", "door"],
        note: str = "",
        *,
        near: NodeWord = "",
        plan: str | None = None,
        because: str = "",
        check: bool = False,
    ) -> str:
        """Add a lift, a ramp or a door between two nodes.

        Args:
            name: of the portal.
            a: node at one side.
            b: at the other side.
            means: what it is.
            note: for who takes robots through.
            near: see `place`.
            plan: see `place`; a node that is not on it is given by its id or a name.
            because: why.
            check: only say what it would do.
        """
        given = _given(near=word_of(near), plan=plan)
        fields = {"a": word_of(a), "b": word_of(b), "means": str(means), "note": note, **given}
        return self.annotate("portal", name, because, check=check, **fields)

    def plan(
        self,
        name: str,
        image: PlanImage,
        pairs: Iterable[tuple[NodeWord, float, float]],
        *,
        metres_per_pixel: float | None = None,
        origin: Pose2 | None = None,
        near: NodeWord = "",
        because: str = "",
        check: bool = False,
    ) -> str:
        """Lay a floor plan under the map.

        Args:
            name: of the plan.
            image: as `put_plan_image` returns it.
            pairs: three or more: a place, and its pixel in the image, right and down, px.
            metres_per_pixel: of the image; the pairs say it without.
            origin: pose of the lower left corner of the image in the frame of the plan.
            near: in the part of the map where this node or place is; the largest part without.
            because: why.
            check: only say what it would do.
        """
        clicked = [{"at": word_of(at), "u": u, "v": v} for at, u, v in pairs]
        given = _given(metres_per_pixel=metres_per_pixel, near=word_of(near))
        if origin is not None:
            given["origin"] = packed(origin)
        fields = {"pairs": clicked, "image": packed(image), **given}
        return self.annotate("plan", name, because, check=check, **fields)

    def pin(
        self,
        node: NodeWord,
        pose: Pose2 | None = None,
        *,
        plan: str | None = None,
        because: str = "",
        check: bool = False,
    ) -> str:
        """Hold the frame of a component by one of its nodes: at a pose, or where it is now; with a floor plan
        at its pose on that, so that the component gets the coordinates of the plan.
        """
        notes: list[str] = []
        own = str(noting(self.resolve, notes)(asked_of(node)).found[0].node)
        fields = _given(plan=plan, merged_from_node=None if pose is None else packed(pose))
        return "; ".join((self.annotate("pin", own, because, check=check, node=own, **fields), *notes))

    @abstractmethod
    def constraints(self) -> tuple[ManualConstraint, ...]:
        """What people have linked, unmerged, retired and taken back, in order; the first is number 1."""

    @abstractmethod
    def keep(self, request: ConstraintRequest) -> str:
        """Keep what `request` returns, unless it is only to be checked; see `link`."""

    def request(
        self, about: Subject, holds: bool, because: str = "", check: bool = False
    ) -> ConstraintRequest:
        """A manual constraint of now, or that it holds no more, for `keep`.

        Raises:
            InvalidValue: a person cannot mean it.
        """
        return ConstraintRequest(ManualConstraint(about, holds, self._by, time.time_ns(), because), check)

    def constrain(self, about: Subject, holds: bool, because: str = "", *, check: bool = False) -> str:
        """Set a manual constraint of any kind, or take it back; see `link`."""
        return self.keep(self.request(about, holds, because, check))

    def link(
        self, a: NodeWord, b: NodeWord, pose: Pose2 | None = None, because: str = "", *, check: bool = False
    ) -> str:
        """Link two nodes by hand: they see one place.

        Args:
            a: a node, `r0.1.17`, the name of a place, or a position `(3.1, -2.0)`.
            b: another one, of the same map or of another.
            pose: of b's robot frame in a's, where their images do not say it; needs `because`.
            because: why.
            check: only say what it would do.

        Returns:
            What came of it, in words.

        Raises:
            Refused: the images do not agree, or the map contradicts it: the evidence, and what to do.
            NotConnected: it is a fleet's, and no map server answers.
        """
        first, second = map(NodeId.parse, own_ids_of(map(word_of, (a, b)), self.annotations, self.resolve))
        return self.constrain(Linked(first, second, pose), True, because, check=check)

    def unlink(
        self, first: NodeWord | MapId, second: NodeWord | MapId, because: str = "", *, check: bool = False
    ) -> str:
        """Undo the link between two nodes, or all links between two maps; see `link`."""
        words = map(word_of, (first, second))
        ends = read_ends(*own_ids_of(words, self.annotations, self.resolve))
        return self.constrain(Apart(ends), True, because, check=check)

    def retire(
        self,
        *which: NodeWord | MapId,
        area: Area | None = None,
        begin: str | int = "",
        end: str | int = "",
        because: str = "",
        check: bool = False,
    ) -> str:
        """Retire a map, some nodes, an area, or what a map has of a time; see `link`.

        Args:
            which: one map, `r0.1`, or nodes, `r0.1.17`, or names of places: of one that is an area all of it;
                none with `area`.
            area: where all nodes are retired, of all maps.
            begin: of one map alone nodes from then on: ns since 1970, or `2026-03-01 12:00` (UTC).
            end: and until then.
            because: why.
            check: only say what it would do.
        """
        about: Subject
        # The number 0 is a time.
        in_time = begin != "" or end != ""
        if area is not None:
            if which or in_time:
                raise InvalidValue("an area goes with neither maps, nodes nor times")
            about = RetiredArea(area)
        else:
            about = retired_of(map(word_of, which), self.annotations, self.resolve)
            if in_time:
                if not isinstance(about, RetiredMap):
                    raise InvalidValue("a time window is of one map")
                about = read_window(about.map, begin, end, time.time_ns())
        return self.constrain(about, True, because, check=check)

    def undo(self, what: int | ManualConstraint, because: str = "", *, check: bool = False) -> str:
        """Take a manual constraint back.

        Args:
            what: the constraint, or its number in `constraints()`, from 1.
            because: why.
            check: only say what it would do.

        Raises:
            Refused: there is none of this number, or it was taken back already: the words say who did so, and
                when.
        """
        record = self.constraints()
        if not isinstance(what, int):
            if what not in record:
                raise Refused(f"the record does not have this constraint: {event_words(what)}")
            what = record.index(what) + 1
        with refusals():
            about = to_take_back(record, what)
        return self.constrain(about, False, because, check=check)


def _where(words: Mapping[str, Any], known: frozenset[str], **more: Any) -> dict[str, Any]:
    """Words for a floor or for ways, with text for nodes.

    Raises:
        TypeError: there is no such word, as for any other argument.
    """
    if unknown := words.keys() - known:
        raise TypeError(f"unexpected keyword argument {', '.join(sorted(unknown))}")
    given = {name: value for name, value in {**words, **more}.items() if value is not None}
    for name in given.keys() & {"node", "near"}:
        given[name] = word_of(given[name])
    if "edge" in given:
        given["edge"] = [word_of(end) for end in given["edge"]]
    return _given(**given)


def _in_words(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a body with text for nodes that are given by a position or an id."""
    plain = dict(fields)
    for name in ("node", "near", "a", "b"):
        if is_position(plain.get(name)) or isinstance(plain.get(name), NodeId):
            plain[name] = word_of(plain[name])
    if isinstance(edge := plain.get("edge"), list | tuple):
        plain["edge"] = [word_of(end) if is_position(end) or isinstance(end, NodeId) else end for end in edge]
    return plain


def _given(**fields: Any) -> dict[str, Any]:
    """Those that are given."""
    return {name: value for name, value in fields.items() if value is not None and value != ""}

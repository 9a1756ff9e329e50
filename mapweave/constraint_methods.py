"""Manual constraints from Python, of a file and of a fleet: links by hand, links undone, what is retired."""

import time
from abc import ABC, abstractmethod
from collections.abc import Iterable

from mapweave.hybridmap.annotation import Annotations
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
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import (
    ConstraintRequest,
    ManualConstraint,
    event_words,
    to_take_back,
)
from mapweave.hybridmap.named_nodes import NodeWord, own_ids_of, retired_of, word_of
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import ResolveAnswer, ResolveRequest
from mapweave.refusals import refusals


class ConstraintMethods(ABC):
    """How people correct the merge. Each correction can be taken back by `undo`; the record keeps both."""

    _by: str
    """Who decides."""

    @abstractmethod
    def annotations(self) -> Annotations:
        """What people say about the map."""

    @abstractmethod
    def resolve(self, request: ResolveRequest | NodeWord | Iterable[NodeWord]) -> ResolveAnswer:
        """Nodes for words."""

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

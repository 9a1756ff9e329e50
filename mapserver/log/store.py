"""What a server keeps for good: every agent's log, exactly once and in order, and the server's own results.

There are two: one SQLite file (mapweave.mapserver.log.sqlite_store), and a PostgreSQL database that several
servers share (mapweave.mapserver.log.postgres_store).
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from mapweave.hybridmap.change import Change
from mapweave.hybridmap.errors import InvalidValue, MapweaveError
from mapweave.hybridmap.ids import EdgeId, MapId, NodeId
from mapweave.mapserver.log.entry import Applied, Position, ReceivedChange, Traffic
from mapweave.mapserver.log.integrity import Gap
from mapweave.wire.log_messages import Refusal

ID = "store id"
"""Among the results."""
HISTORY = "history"
"""Among the results, too: see mapweave.mapserver.map_history."""
PRUNING = "pruning"
"""Likewise: see mapweave.mapserver.merging.pruning."""
PRUNING_MARK = "pruning_mark"
"""A random number that is drawn with each change of that record."""
MOST_REFUSED_KEPT = 100
"""Refused changes of a map of which the bytes are kept; of further ones only the reason."""
MOST_REFUSALS = 1000
"""Reasons of a map that are kept; then a new one takes the place of the oldest that is kept without bytes."""
ROW_BYTES = 100
"""That a change takes beside its message: its key, its columns and its place in the table."""
MAX_CONSTRAINTS = 10_000
"""Made by hand, one by one."""


@dataclass(frozen=True, slots=True)
class LogChanges:
    """The next changes of one log.

    Attributes:
        map_id: whose log.
        log_id: which.
        entries: in order of their sequence numbers.
        covered: the agent has nothing else up to here. Without it, entries behind a gap are left out.
    """

    map_id: MapId
    log_id: int
    entries: Sequence[ReceivedChange]
    covered: int | None = None


@dataclass(frozen=True, slots=True)
class News:
    """What other servers have written to a store that they share.

    Attributes:
        maps: whose logs have grown; None: any may have.
        records: names of results, `manual_constraint` or `annotation`; None: any may have changed.
    """

    maps: frozenset[MapId] | None
    records: frozenset[str] | None

    def names(self, record: str) -> bool:
        """Whether this record may have changed."""
        return self.records is None or record in self.records


EVERYTHING = News(None, None)
CONSTRAINTS, ANNOTATIONS = "manual_constraint", "annotation"
"""Records, by the names of their tables."""


class Store(Protocol):
    """The record of all logs. Any thread may call it; what it returns as done survives a loss of power.

    Attributes:
        id: random, drawn when the store was made, see mapweave.wire.log_messages.Ack.
        shared: whether other servers may write to it, too.
    """

    id: int
    shared: bool

    @property
    def leads(self) -> bool:
        """Whether this server writes the results of merging: one of those that share a store does."""

    @property
    def displaced(self) -> str:
        """Why this server must end, in one line; empty if it need not.

        Another server of its name has taken a store that servers share. Nothing more is written.
        """

    def follow(self, changed: Callable[[News], None]) -> None:
        """Have what other servers write reported from now on, from a thread of the store's.

        Before this server leads, it is called once more: what the leader before wrote is known then.
        """

    def maps(self, agent: str | None = None) -> list[MapId]:
        """All maps of a robot, or of all robots, of which something is known."""

    def positions(self, maps: Collection[MapId] | None = None) -> dict[MapId, Position]:
        """Which log is kept of each of these maps, or of all, and how far it is settled."""

    def watermark(self, map_id: MapId) -> int:
        """Up to which change the log is settled, 0 without a log."""

    def log_id(self, map_id: MapId) -> int | None:
        """Id of the log of this name, None without one."""

    def apply(
        self, map_id: MapId, log_id: int, entries: Sequence[ReceivedChange], covered: int | None = None
    ) -> Applied:
        """Take the next changes of one log; see `apply_all`, and `LogChanges` for the arguments.

        Returns:
            What is new.

        Raises:
            InvalidValue: another log goes by this name.
            InvalidFile: the disk does not take it; nothing is applied.
        """
        (result,) = self.apply_all([LogChanges(map_id, log_id, entries, covered)])
        if isinstance(result, MapweaveError):
            raise result
        return result

    def apply_all(self, runs: Sequence[LogChanges]) -> list[Applied | MapweaveError]:
        """Take the next changes of many logs, all in one transaction with their watermarks.

        Duplicates are left out. A refused change is kept aside with its reason and the log goes on
        behind it: one bad change must not hold up a map for ever.

        Returns:
            For each run what is new, or its error: InvalidValue where another log goes by this name, which
            holds up no other run; InvalidFile for all if the disk does not take it, and nothing is applied.
        """

    def replay(self, map_id: MapId, last: int = 0) -> Iterator[Change]:
        """Every change behind `last` that was taken, in order.

        Those that cannot be read, or are out of bounds since they were taken, are left out.
        """

    def prune(
        self,
        nodes: Iterable[NodeId],
        edges: Iterable[EdgeId],
        results: Mapping[str, bytes],
        last: Mapping[MapId, int] | None = None,
        unchanged: Mapping[str, bytes | None] | None = None,
    ) -> bool:
        """Delete what logs say of some nodes and edges, for good, and store results in their place.

        All in one transaction. The logs' watermarks stay, so robots do not send them again.

        Args:
            nodes: that have left the map.
            edges: likewise.
            results: by their names, see `put_result`.
            last: up to which change of each log this is decided; what comes behind stays. None: all.
            unchanged: results that must still be these, since this is decided by them; None: not stored.

        Returns:
            Whether it is done: not if another server has written one of those results, and then nothing is.

        Raises:
            InvalidFile: the disk does not take it; nothing is pruned.
        """

    def damaged(self, map_id: MapId | None = None) -> list[Gap]:
        """Changes that were found damaged and are not restored yet, of one map or of all."""

    def restore(
        self, map_id: MapId, first: int, covered: int, entries: Sequence[ReceivedChange]
    ) -> Iterator[Change]:
        """Put changes that were damaged in their places again, as the robot's log has them.

        Where the robot has dropped some of them, what comes before is unverified: a retirement may be lost.

        Args:
            map_id: whose log.
            first: of a damaged part.
            covered: the robot has nothing else up to here.
            entries: of this part.

        Returns:
            What makes the map whole in the order of its log: the restored changes, and those behind them if
            one of these may undo a restored one.

        Raises:
            InvalidFile: the disk does not take it; nothing is restored.
        """

    def unverified(self, map_id: MapId) -> Gap | None:
        """Stored changes that a lost one may have undone; None if there are none, see `verify`."""

    def verify(self, map_id: MapId, first: int, covered: int, kept: Collection[int]) -> list[Change]:
        """Delete unverified changes that the robot has dropped, since others undid them.

        Args:
            map_id: whose log.
            first: of the unverified changes.
            covered: the robot has nothing else up to here.
            kept: which of them the robot has.

        Returns:
            The retirement of each node and edge that no stored change puts now.

        Raises:
            InvalidFile: the disk does not take it; nothing is deleted.
        """

    def landmarks(self, node: NodeId) -> int | None:
        """How many landmarks a node has; None if there is no such node."""

    def kept(self, agent: str) -> dict[MapId, tuple[int, int]]:
        """Nodes and landmarks of each map of a robot."""

    def edges(self, agent: str) -> dict[MapId, int]:
        """Edges of each map of a robot; this reads through all of its logs."""

    def stored_bytes(self, map_id: MapId, after: int, last: int) -> int:
        """Bytes that are kept of the changes of a map behind `after`, up to `last`, taken or refused.

        Each counts with its message and `ROW_BYTES`. This reads through that part of the log.
        """

    def superseded(self, map_id: MapId, most: int) -> list[tuple[int, int]]:
        """Changes of a map that later ones of it supersede: without them its replay is the same map.

        Of each node and edge that was put or retired the newest change stays, and the last retirement. This
        reads through the log.

        Args:
            map_id: of the map.
            most: so many at most.

        Returns:
            Sequence number and bytes of each, as in `stored_bytes`.
        """

    def drop(self, map_id: MapId, sequences: Sequence[int]) -> None:
        """Delete superseded changes of a map.

        The watermark stays, so the robot does not send again what is deleted.

        Raises:
            InvalidFile: the disk does not take it; nothing is deleted.
        """

    def refusals(self, map_id: MapId, newest: int = 16) -> list[Refusal]:
        """The newest changes of a map that were refused, in order."""

    def refused(self) -> int:
        """How many changes of any map were refused; of each map at most `MOST_REFUSALS` count."""

    def traffic(self, map_id: MapId | None = None) -> Traffic:
        """What a map has cost on the wire, or all maps together if none is named."""

    def constraints(self) -> list[bytes]:
        """The manual constraints, in order."""

    def add_constraint(self, body: bytes) -> None:
        """Add a manual constraint.

        Raises:
            InvalidValue: there are too many.
            InvalidFile: the disk does not take it.
        """

    def annotations(self) -> list[bytes]:
        """The annotations, in order."""

    def add_annotation(self, body: bytes) -> None:
        """Add an annotation; see `add_constraint`."""

    def put_result(self, name: str, value: bytes) -> None:
        """Store another result of the server.

        Raises:
            InvalidFile: the disk does not take it.
        """

    def result(self, name: str) -> bytes | None:
        """The result of this name."""

    def close(self) -> None:
        """Close it. Idempotent."""


def fresh_id() -> int:
    """For a store that is made now."""
    return secrets.randbits(62) + 1


def name_taken(map_id: MapId) -> InvalidValue:
    """The error of a run whose log is not the one that is stored."""
    return InvalidValue(f"another log goes by the name {map_id}: begin a fresh map")

"""What the stores' classes build on: queries of one database, inside a transaction or outside."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from typing import Any

from mapweave.hybridmap.ids import MapId
from mapweave.mapserver.log.entry import Position
from mapweave.mapserver.log.store import LogChanges


class SqlTables(ABC):
    """Tables as in mapweave.mapserver.log.integrity. Marks of values are `?`."""

    @abstractmethod
    def _wire_bytes(self, grown: Sequence[tuple[str, int, int, int]]) -> Iterable[tuple[str, int, int]]:
        """Changes and their bytes by kind, of stretches of logs.

        Args:
            grown: agent, epoch, the change before the first one and the last one.
        """

    @abstractmethod
    def _read(self, query: str, values: Sequence[object] = ()) -> list[Any]:
        """The rows of a query, inside a transaction or outside.

        Raises:
            InvalidFile: they cannot be read.
        """

    @abstractmethod
    def _transaction(self) -> AbstractContextManager[None]:
        """All that is written inside is committed at the end, or nothing of it; one thread at a time.

        Raises:
            InvalidFile: it is not committed.
        """

    @abstractmethod
    def _write(self, query: str, values: Sequence[object]) -> None:
        """Inside a transaction."""

    @abstractmethod
    def _begin(self, runs: Sequence[LogChanges]) -> dict[MapId, Position]:
        """The logs of these runs that are stored; only this transaction changes them until the commit."""

    @abstractmethod
    def _lock_table(self, table: str) -> None:
        """Only this transaction changes it until the commit."""

    @abstractmethod
    def _put(self, table: str, values: Sequence[object]) -> None:
        """Inside a transaction: put a row into a table, in the place of one with the same key."""

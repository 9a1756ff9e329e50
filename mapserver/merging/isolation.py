"""Isolation: maps with which the merge fails are set apart, so that all others are merged."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

from mapweave.hybridmap.ids import MapId

MAX_REASON = 200
"""Characters."""
T = TypeVar("T")


@dataclass
class _Failure:
    """The failure of one map.

    Attributes:
        reason: in words.
        count: how often the merge has failed with it.
        wait: changes of it that are still waited for.
    """

    reason: str
    count: int
    wait: int


class Isolation:
    """Which maps are set apart. One is tried again when it has changed: once, twice, four times ... .

    To find the map with which a merge fails takes many merges, so a map that fails repeatedly waits longer.
    """

    def __init__(self) -> None:
        self._failures: dict[MapId, _Failure] = {}
        self._apart: set[MapId] = set()

    @property
    def reasons(self) -> Mapping[MapId, str]:
        """Maps that are set apart, and why."""
        return {map_id: self._failures[map_id].reason for map_id in sorted(self._apart)}

    def __contains__(self, map_id: MapId) -> bool:
        return map_id in self._apart

    def add(self, map_id: MapId, reason: str) -> None:
        """Set a map apart."""
        count = self._failures[map_id].count + 1 if map_id in self._failures else 1
        self._failures[map_id] = _Failure(reason, count, 2 ** (count - 1))
        self._apart.add(map_id)

    def changed(self, maps: Iterable[MapId]) -> None:
        """Take in again, of maps that have changed, those that are to be tried again."""
        for map_id in self._apart & set(maps):
            self._failures[map_id].wait -= 1
            if self._failures[map_id].wait <= 0:
                self._apart.discard(map_id)

    def release(self, maps: Iterable[MapId]) -> None:
        """Take these in again at once."""
        self._apart -= set(maps)

    def suspicion(self, map_id: MapId) -> int:
        """How often the merge has failed with a map."""
        return self._failures[map_id].count if map_id in self._failures else 0


def leave_out(
    maps: Sequence[MapId],
    attempt: Callable[[Collection[MapId]], T],
    fatal: type[Exception] | tuple[type[Exception], ...] = (),
) -> tuple[T, dict[MapId, Exception]]:
    """Attempt something with as many maps as possible.

    All together first, else the first half and then the second, each with what works already. Of two maps
    with which it fails together the later one is left out. One bad map of N takes about 2 log2 N attempts.

    Args:
        maps: the most trusted first.
        attempt: fails by any exception.
        fatal: exceptions that are no map's fault: they are raised.

    Returns:
        The result, and the maps that were left out.

    Raises:
        Exception: it fails with no map at all.
    """
    kept: list[MapId] = []
    left_out: dict[MapId, Exception] = {}
    excluded: list[T] = []
    waiting = [list(maps)]
    while waiting:
        block = waiting.pop()
        try:
            excluded = [attempt([*kept, *block])]
        except fatal:
            raise
        except Exception as error:  # noqa: BLE001 - any error is one map's and is reported for it
            if len(block) > 1:
                waiting += [block[len(block) // 2 :], block[: len(block) // 2]]
            elif block:
                left_out[block[0]] = error
        else:
            kept += block
    return excluded[0] if excluded else attempt(kept), left_out


def reason_of(error: Exception) -> str:
    """One line for people."""
    words = " ".join(str(error).split())
    return f"the merge fails with it ({type(error).__name__}: {words})"[:MAX_REASON]

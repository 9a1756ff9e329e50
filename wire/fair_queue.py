"""A queue in which each sender waits behind its own things alone: senders take turns."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

_T = TypeVar("_T")


@dataclass
class _Lane(Generic[_T]):
    items: deque[tuple[_T, int]] = field(default_factory=deque)
    size: int = 0


class FairQueue(Generic[_T]):
    """Round robin over senders; in order for each. It has no lock of its own.

    A full queue still takes from a sender that holds less than its share of it, so that one that floods it
    loses its own things alone.
    """

    def __init__(self, most: int, most_bytes: int) -> None:
        """Start empty.

        Args:
            most: things that may wait.
            most_bytes: what they may take together.
        """
        self._most, self._most_bytes = most, most_bytes
        self._lanes: dict[str, _Lane[_T]] = {}
        self._turns: deque[str] = deque()
        self._count = self._size = 0

    def __len__(self) -> int:
        """Things that wait."""
        return self._count

    def waiting(self, sender: str) -> int:
        """Things of one sender that wait."""
        lane = self._lanes.get(sender)
        return 0 if lane is None else len(lane.items)

    def put(
        self,
        sender: str,
        item: _T,
        size: int = 0,
        *,
        bounded: bool = True,
        replaces: Callable[[_T], bool] | None = None,
    ) -> bool:
        """Add something.

        Args:
            sender: behind whose things it waits.
            item: any.
            size: bytes.
            bounded: whether it may be refused.
            replaces: whether it takes the place of the sender's last thing.

        Returns:
            False if there is no room for it.
        """
        lane = self._lanes.get(sender)
        if lane is not None and replaces is not None and replaces(lane.items[-1][0]):
            _, before = lane.items.pop()
            lane.size -= before
            self._count -= 1
            self._size -= before
        elif bounded and not self._has_room(lane, size):
            return False
        if lane is None:
            lane = self._lanes[sender] = _Lane()
            self._turns.append(sender)
        lane.items.append((item, size))
        lane.size += size
        self._count += 1
        self._size += size
        return True

    def pop(self) -> tuple[str, _T]:
        """The next thing, and whose it is; raises IndexError if there is none."""
        sender = self._turns.popleft()
        lane = self._lanes[sender]
        item, size = lane.items.popleft()
        lane.size -= size
        self._count -= 1
        self._size -= size
        if lane.items:
            self._turns.append(sender)
        else:
            del self._lanes[sender]
        return sender, item

    def clear(self) -> None:
        """Forget everything."""
        self._lanes.clear()
        self._turns.clear()
        self._count = self._size = 0

    def _has_room(self, lane: _Lane[_T] | None, size: int) -> bool:
        held, held_bytes = (0, 0) if lane is None else (len(lane.items), lane.size)
        senders = len(self._lanes) + (lane is None)
        return (self._count < self._most or (held + 1) * senders <= self._most) and (
            self._size + size <= self._most_bytes or (held_bytes + size) * senders <= self._most_bytes
        )

"""Under which keys others are alive, as one watcher knows it: bounded, whatever others declare.

A session may declare as many liveliness tokens as it likes, and declare and take back one of them without
end. So of each participant a few are known, further ones are left out and counted; and what has changed is
reported by one task a participant, however often it changes until that is done.
"""

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass, field

from mapweave.wire.dispatch import Dispatcher, guarded

log = logging.getLogger(__name__)

MOST_OF_ONE = 64
"""Keys of one participant: a robot is alive under one for its map, one for its images, one as a driver."""
MOST = 65_536
"""Keys of all together."""
LONGEST = 1024
"""Characters of a key."""


@dataclass
class _Participant:
    """Keys of a robot, a server or a robot base.

    Attributes:
        alive: now.
        reported: to the handler.
        blinked: were taken back since they were reported.
        due: whether a task is on its way to report what has changed.
    """

    alive: set[str] = field(default_factory=set)
    reported: set[str] = field(default_factory=set)
    blinked: set[str] = field(default_factory=set)
    due: bool = False


class AliveKeys:
    """Those of one watcher. Thread-safe."""

    def __init__(
        self, dispatcher: Dispatcher, handler: Callable[[str, bool], None], wanted: Callable[[], bool]
    ) -> None:
        """None is alive.

        Args:
            dispatcher: on which the handler runs.
            handler: called with each key that has changed, and whether it is alive.
            wanted: whether the handler may still be called.
        """
        self._dispatcher, self._handler, self._wanted = dispatcher, handler, wanted
        self._lock = threading.Lock()
        self._participants: dict[str, _Participant] = {}
        self._count = self._left_out = 0

    def note(self, key: str, alive: bool) -> None:
        """A key was declared or taken back; twice is no news."""
        if len(key) > LONGEST:
            return
        name = _participant(key)
        with self._lock:
            one = self._participants.get(name)
            if alive == (one is not None and key in one.alive):
                return
            if one is None:
                one = _Participant()
            if not alive:
                one.alive.discard(key)
                self._count -= 1
                one.blinked |= one.reported & {key}
            elif len(one.alive) < MOST_OF_ONE and self._count < MOST:
                self._participants[name] = one
                one.alive.add(key)
                self._count += 1
            else:
                self._left_out += 1
                # Each power of two: a flood must not become a flood of log lines.
                if self._left_out & (self._left_out - 1) == 0:
                    log.warning("%d liveliness tokens left out so far, the last of %s", self._left_out, name)
                return
            due, one.due = one.due, True
        if not due:
            self._dispatcher.presence(lambda: self._report(name), key)

    def end(self) -> None:
        """Nothing is known any more: none is alive until it is noted again."""
        with self._lock:
            keys = [key for one in self._participants.values() for key in one.alive]
        for key in keys:
            self.note(key, False)

    def _report(self, name: str) -> None:
        """Call the handler with what has changed of one participant; in the dispatcher's thread."""
        with self._lock:
            one = self._participants[name]
            again = one.blinked & one.alive
            # A robot that goes on with its next map is never away.
            news = [(key, True) for key in sorted(one.alive - one.reported)]
            news += [(key, False) for key in sorted((one.reported - one.alive) | again)]
            news += [(key, True) for key in sorted(again)]
            one.reported, one.blinked, one.due = set(one.alive), set(), False
            if not one.alive:
                del self._participants[name]
        for key, alive in news:
            if self._wanted():
                guarded(lambda key=key, alive=alive: self._handler(key, alive), key)  # type: ignore[misc]


def _participant(key: str) -> str:
    """Who is alive under a key of a fleet, such as `agent/r3`; of other keys (those of ROS 2) each itself."""
    match key.split("/"):
        case ["mapweave", _, _, kind, name, *_]:
            return f"{kind}/{name}"
        case _:
            return key

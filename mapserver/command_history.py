"""The server's record of commands: who has sent, stopped or driven which robot, when and why."""

import logging
import re
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from itertools import accumulate

from mapweave.hybridmap.agent_status import HandDrive
from mapweave.hybridmap.errors import InvalidFile, InvalidMessage, InvalidValue
from mapweave.hybridmap.limits import MAX_WORDS
from mapweave.hybridmap.map_event import History, MapEvent, MapEventKind
from mapweave.hybridmap.mission_order import AT_START, MissionOrder
from mapweave.mapserver.log.store import Store
from mapweave.wire.messages import decode, encode

log = logging.getLogger(__name__)

COMMANDS = "commands"
"""Among the results of the store."""
MOST = 1000
"""Events that are kept."""
MISSION = re.compile(r"\(mission ([^ ,)]+)(, as [^ ]+ says)?\)$")


class CommandHistory:
    """Thread-safe. What is noted is written soon, and not waited for: a robot that is to stop comes first."""

    def __init__(
        self, store: Store, time_ns: Callable[[], int], later: Callable[[Callable[[], None]], None]
    ) -> None:
        """Go on with the record of the store.

        Args:
            store: keeps the record.
            time_ns: the present time.
            later: has something done soon, and does not wait for it.
        """
        self._store, self._time_ns, self._later = store, time_ns, later
        self._lock, self._writing = threading.Lock(), threading.Lock()
        self._events: tuple[MapEvent, ...] = ()
        self._said: set[str] = set()
        self._drives: dict[str, HandDrive] = {}
        self._count = 0
        self._unwritten = self._write_is_due = self._write_fails = False
        self.reload()

    @property
    def count(self) -> int:
        """How many were noted since the start; for any thread."""
        with self._lock:
            return self._count

    @property
    def events(self) -> tuple[MapEvent, ...]:
        """All events in order; for any thread."""
        with self._lock:
            return self._events

    def reload(self) -> None:
        """Read the record, to which other servers may have added; what one has written over is kept."""
        try:
            kept = self._store.result(COMMANDS)
            stored = () if kept is None else decode(kept, History).history
        except InvalidMessage as error:
            log.warning("the record of commands is lost: %s", error)
            return
        with self._lock:
            own, known = self._events, {*map(_key, stored)}
            self._take(stored, [event for event in own if _key(event) not in known])
            self._unwritten |= bool(self._said - known)

    def order(self, order: MissionOrder, heard: bool) -> None:
        """Note a mission; the same one twice is noted once.

        Args:
            order: the mission.
            heard: whether the robot says so: then who has given it is that robot's word.
        """
        if heard and order.by == AT_START:
            return  # A person has started the agent, and not sent the robot.
        because = f': "{order.because}"' if order.because else ""
        known = f"mission {order.id}" + (f", as {order.robot} says" if heard else "")
        self._note(f"{order.robot}: {order.words}, by {order.by or 'a person'}{because} ({known})")

    def drive(self, robot: str, drive: HandDrive) -> None:
        """Note that a person begins to drive a robot by hand, or has ended, as the robot says; each once."""
        with self._lock:
            if self._drives.get(robot) == drive:
                return
            self._drives[robot] = drive
        begin = datetime.fromtimestamp(drive.begin_ns * 1e-9, UTC)
        since = f"{begin:%Y-%m-%d %H:%M:%S}.{begin.microsecond // 1000:03} UTC"
        by = f"by {drive.by or 'a person'} since {since} (as {robot} says)"
        self._note(f"{robot}: driven by hand, {by}")
        if drive.over:
            self._note(f"{robot}: the drive by hand is over, {by}")

    def write(self) -> None:
        """Write the record if there is anything new; where that fails, the next call writes it again."""
        with self._writing:
            with self._lock:
                self._write_is_due = False
                if not self._unwritten:
                    return
                events, self._unwritten = self._events, False
            try:
                self._store.put_result(COMMANDS, encode(History(events)))
            except (InvalidFile, InvalidValue) as error:
                if not self._write_fails:
                    log.warning("the record of commands is not on the disk, and is tried again: %s", error)
                with self._lock:
                    self._unwritten = self._write_fails = True
            else:
                self._write_fails = False

    def _note(self, words: str) -> None:
        words = "".join(c if c.isprintable() else " " for c in words)[:MAX_WORDS]
        with self._lock:
            event = MapEvent(self._time_ns(), MapEventKind.COMMANDED, words)
            if _key(event) in self._said:
                return
            self._take((*self._events, event))
            self._unwritten = True
            self._count += 1
            if self._write_is_due:
                return
            self._write_is_due = True
        self._later(self.write)

    def _take(self, *records: Sequence[MapEvent]) -> None:
        """Keep the newest of each robot first, so that none displaces what is said of others.

        Args:
            records: each in the order in which it was noted. A clock may have been put back meanwhile, so of
                two records an event is taken for as old as the newest before it.
        """
        dated = [
            (at, event)
            for record in records
            for at, event in zip(accumulate((one.stamp_ns for one in record), max), record, strict=True)
        ]
        events = [event for _, event in sorted(dated, key=lambda one: one[0])]
        turns, ranked = Counter[str](), []
        for place, event in reversed([*enumerate(events)]):
            robot = event.words.partition(":")[0]
            ranked.append((turns[robot], place))
            turns[robot] += 1
        kept = sorted(place for _, place in sorted(ranked, key=lambda one: one[0])[:MOST])
        self._events = tuple(events[place] for place in kept)
        self._said = {*map(_key, self._events)}


def _key(event: MapEvent) -> str:
    """What an event is about: of a mission the robot and the id."""
    robot = event.words.partition(":")[0]
    mission = MISSION.search(event.words)
    return f"{robot} {mission[1]}" if mission else event.words

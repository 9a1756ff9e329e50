"""Agents that hold a server up, if it lets them: a slow one, a frozen one and one that floods."""

import os
import signal
import threading
import time
from dataclasses import dataclass
from typing import Protocol

from mapweave.agent.replication.journal import Journal
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.query import View
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import Head, Mark
from mapweave.wire.messages import encode_view
from mapweave.wire.senders import sent_by
from mapweave.wire.zenoh_bus import ZenohBus

KINDS = ("slow", "frozen", "flooding")
SLOW = 1.0
"""Of a slow agent to answer a question for its log, s. None of its changes comes by itself."""
FLOOD = 1000.0
"""Changes a second of a flooding agent, and as many beacons: twenty times its quota of each."""
ASKERS, ANSWERED = 3, 5.0
"""Threads in which a flooding agent asks where it is without a pause; s that each waits for an answer."""
FREEZE_AFTER, THAW_BEFORE = 2.0, 1.0
"""From the start of mapping until an agent is frozen, and from when it goes on until the end, s."""


class MuteBus(ZenohBus):
    """A connection on which published changes get lost."""

    def publish(self, key: str, payload: bytes, attachment: bytes = b"") -> None:
        """Send, unless it is a change: these alone have something attached."""
        if not attachment:
            super().publish(key, payload)


class SlowJournal(Journal):
    """A journal on a slow disk."""

    def rows(self, map_id: MapId, first: int, last: int) -> list[tuple[int, bytes]]:
        """See Journal."""
        time.sleep(SLOW)
        return super().rows(map_id, first, last)


def flood(bus: ZenohBus, keys: Keys, journal: Journal, map_id: MapId, view: View, until: float) -> None:
    """Publish the newest change of a map and its beacon, and ask about a view, again and again."""
    log_id, question = journal.log_id(map_id), encode_view(view)
    where = sent_by(keys.any_relocalize(), map_id.agent)

    def publish() -> None:
        began, count = time.monotonic(), 0
        while time.monotonic() < until:
            ((sequence, change),) = journal.rows(map_id, journal.head(map_id), journal.head(map_id))
            beacon = Head(log_id, sequence, {}).encode()
            for _ in range(int((time.monotonic() - began) * FLOOD) - count):
                bus.publish(keys.change(map_id), change, Mark(sequence, log_id).encode())
                bus.publish(keys.head(map_id), beacon)
                count += 1
            time.sleep(0.02)

    def ask() -> None:
        while time.monotonic() < until:
            bus.ask(where, question, ANSWERED)

    for work in (publish, *[ask] * ASKERS):
        threading.Thread(target=work, name="flood", daemon=True).start()


class Process(Protocol):
    """A process with an agent."""

    pid: int


@dataclass
class Freeze:
    """Stops a process for a part of the time of mapping, as a machine that swaps or sleeps does."""

    process: Process
    begin: float
    end: float

    def start(self) -> None:
        """Freeze it later, and let it go on again, in a thread of its own."""
        threading.Thread(target=self._run, name="freeze", daemon=True).start()

    def _run(self) -> None:
        for at, what in (
            (self.begin + FREEZE_AFTER, signal.SIGSTOP),
            (self.end - THAW_BEFORE, signal.SIGCONT),
        ):
            time.sleep(max(0.0, at - time.monotonic()))
            os.kill(self.process.pid, what)

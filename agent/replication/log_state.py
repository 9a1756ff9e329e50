"""State of one of the agent's own logs: its length, and each server's watermark."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

from mapweave.agent.replication.journal import Journal
from mapweave.hybridmap.ids import MapId
from mapweave.wire.log_messages import Ack, Head

LATE = 30.0
"""How long a message may be on its way, s: on each of three connections (server, two routers, agent) until
the longest lease is over, which ends the connection with all that waits in it."""

MOST_SERVERS = 64
"""Of which the state is kept, and stores that they have left. No fleet has more; a client without keys, or a
server that lies, may acknowledge in any number of names."""
PUT_BACK = "{} has changes of {} that this disk has lost: begin a fresh map (--fresh)"
"""Of a disk that was put back to an older state, as by a backup."""


class SequenceRanges:
    """Changes of a log, as ranges of their numbers."""

    def __init__(self, last: int) -> None:
        """All up to the last."""
        self._ranges = [(0, last)]

    @property
    def whole(self) -> int:
        """All up to here are among them."""
        return self._ranges[0][1]

    def add(self, first: int, last: int) -> None:
        """These, too; those that were added before are mostly behind them."""
        newest_first, newest_last = self._ranges[-1]
        if newest_first <= first <= newest_last + 1:
            self._ranges[-1] = newest_first, max(newest_last, last)
            return
        joined: list[tuple[int, int]] = []
        for begin, end in sorted([*self._ranges, (first, last)]):
            if joined and begin <= joined[-1][1] + 1:
                joined[-1] = joined[-1][0], max(joined[-1][1], end)
            else:
                joined.append((begin, end))
        self._ranges = joined


@dataclass
class LogState:
    """One log.

    Attributes:
        map: whose.
        log_id: which, see mapweave.wire.log_messages.Mark.
        newest: sequence number of the newest committed change.
        acknowledged: what is on which server's disk.
        refusals: what servers have refused for good: (server, sequence) to reason.
        failure: why servers do not take this log at all; empty if they do.
        stores: by which id each server's store was known last, see mapweave.wire.log_messages.Ack.
        status_periods: that each server wants, s, likewise.
        sent: changes that others may have: those that were there when this began, and what left since.
        compared: whether a server has shown which change it has before those that follow now, or there were
            none when this began.
        put_back: whether a server has changes that have not left, or others than are here: the disk was put
            back to an older state, and what is there instead has the same numbers.
        left: when which server was first heard of with another store than this one, in the last `LATE`; s of
            the monotonic clock.
    """

    map: MapId
    log_id: int
    newest: int
    acknowledged: dict[str, int]
    refusals: dict[tuple[str, int], str] = field(default_factory=dict)
    failure: str = ""
    stores: dict[str, int] = field(default_factory=dict)
    status_periods: dict[str, float] = field(default_factory=dict)
    left: dict[tuple[str, int], float] = field(default_factory=dict)
    sent: SequenceRanges = field(init=False)
    compared: bool = field(init=False)
    put_back: bool = False

    def __post_init__(self) -> None:
        """What is on the disk may have left before."""
        self.sent = SequenceRanges(self.newest)
        self.compared = self.newest == 0

    @staticmethod
    def of(journal: Journal, map_id: MapId) -> LogState:
        """The state as the journal has it; raises InvalidValue if the map was never opened."""
        state = LogState(map_id, journal.log_id(map_id), journal.head(map_id), journal.acknowledged(map_id))
        if journal.was_put_back(map_id):
            state.lost_changes("a server")
        return state

    def settled(self, servers: Sequence[str]) -> int:
        """Up to which change all of these servers have the log; without any, the server that has most."""
        if servers:
            return min(self.acknowledged.get(server, 0) for server in servers)
        return max(self.acknowledged.values(), default=0)

    def unsettled(self, servers: Sequence[str]) -> int:
        """How many changes they still lack."""
        return max(0, self.newest - self.settled(servers))

    def head(self) -> Head:
        """The beacon."""
        return Head(self.log_id, self.newest, dict(self.acknowledged))

    def admits(self, server: str) -> bool:
        """Whether there is room for what a server acknowledges."""
        return server in self.status_periods or len(self.status_periods) < MOST_SERVERS

    def outdated(self, server: str, ack: Ack) -> bool:
        """Whether an acknowledgement comes late, of a store that the server no longer has.

        It may have the former store again, of a backup: `LATE` after it had another, what comes is new.
        """
        left = self.left.get((server, ack.store))
        return self.stores.get(server) != ack.store and left is not None and time.monotonic() < left + LATE

    def lost(self, server: str, ack: Ack) -> bool:
        """Whether a server has less than it once acknowledged: it has another store now."""
        before, now = self.stores.get(server), time.monotonic()
        if not ack.store or before == ack.store:
            return False
        self.stores[server] = ack.store
        if before is not None:
            newest = [*self.left.items()][1 - MOST_SERVERS :]
            self.left = {one: at for one, at in newest if now < at + LATE}
            self.left[server, before] = now
        return ack.watermark < self.acknowledged.get(server, 0)

    def lost_changes(self, server: str) -> bool:
        """Take note that a server has changes that this disk has lost; whether that is new."""
        if self.put_back:
            return False
        self.put_back, self.failure = True, PUT_BACK.format(server, self.map)
        return True

    def take(self, server: str, ack: Ack) -> list[str]:
        """Note the contents of an acknowledgement other than its watermark.

        Returns:
            What is new and worth a line in the log.
        """
        self.status_periods[server] = ack.status_period
        news = []
        for refusal in ack.refusals:
            if refusal.sequence <= self.newest and (server, refusal.sequence) not in self.refusals:
                self.refusals[server, refusal.sequence] = refusal.reason
                news.append(f"{server} refuses {self.map} {refusal.sequence}: {refusal.reason}")
            if refusal.sequence == 0:
                self.failure = f"{server}: {refusal.reason}"
        if self.failure.startswith(f"{server}: ") and all(refusal.sequence for refusal in ack.refusals):
            # It takes the log again, for example since it has room for it.
            self.failure = ""
        return news

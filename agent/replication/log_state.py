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

    @staticmethod
    def of(journal: Journal, map_id: MapId) -> LogState:
        """The state as the journal has it; raises InvalidValue if the map was never opened."""
        return LogState(map_id, journal.log_id(map_id), journal.head(map_id), journal.acknowledged(map_id))

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
            self.left = {one: at for one, at in self.left.items() if now < at + LATE}
            self.left[server, before] = now
        return ack.watermark < self.acknowledged.get(server, 0)

    def take(self, server: str, ack: Ack) -> list[str]:
        """Note the contents of an acknowledgement other than its watermark.

        Returns:
            What is new and worth a line in the log.
        """
        self.status_periods[server] = ack.status_period
        news = []
        for refusal in ack.refusals:
            if (server, refusal.sequence) not in self.refusals:
                self.refusals[server, refusal.sequence] = refusal.reason
                news.append(f"{server} refuses {self.map} {refusal.sequence}: {refusal.reason}")
            if refusal.sequence == 0:
                self.failure = f"{server}: {refusal.reason}"
        if self.failure.startswith(f"{server}: ") and all(refusal.sequence for refusal in ack.refusals):
            # It takes the log again, for example since it has room for it.
            self.failure = ""
        if ack.watermark > self.newest and not self.failure:
            # This disk was put back to an older state. New changes would take numbers that the server has
            # seen, and it would drop them as doubles.
            self.failure = f"{server} has more of {self.map} than this disk: begin a fresh map"
            news.append(self.failure)
        return news

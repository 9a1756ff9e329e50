"""State of one agent's log at the ingest, and when the next piece of it should be pulled."""

from __future__ import annotations

from dataclasses import dataclass, field

from mapweave.hybridmap.node import MapId
from mapweave.mapserver.log.entry import Applied, Entry
from mapweave.mapserver.log.integrity import Gap
from mapweave.wire.log_messages import MAX_REFUSALS, MAX_ROWS, LogRequest, Refusal

NEVER = float("inf")


@dataclass(frozen=True, slots=True)
class PullSettings:
    """When missing changes are pulled.

    Attributes:
        grace: how long a gap may close by itself before it is pulled, s.
        first_pause: after a pull that failed, s; doubled each time.
        longest_pause: between two pulls of one log, s.
        ahead: changes behind a gap that are kept in memory; more are pulled again.
    """

    grace: float = 0.05
    first_pause: float = 0.2
    longest_pause: float = 5.0
    ahead: int = 1024


@dataclass
class AgentLog:
    """One log. Times are of the monotonic clock, s.

    Attributes:
        map: whose.
        log_id: which, see mapweave.wire.log_messages.Mark.
        settings: when to pull.
        watermark: every change up to this one is settled.
        newest: the highest known sequence number.
        ahead: changes that came and are not settled, by sequence number.
        refusals: the newest that were refused.
        damaged: parts of the settled changes that were found damaged on the disk.
        pulling: whether a pull is under way.
        pull_at: when the next one is due.
        chunk: changes to ask for at once; smaller after an answer that could not be read.
    """

    map: MapId
    log_id: int
    settings: PullSettings
    watermark: int = 0
    newest: int = 0
    ahead: dict[int, Entry] = field(default_factory=dict)
    refusals: tuple[Refusal, ...] = ()
    damaged: list[Gap] = field(default_factory=list)
    pulling: bool = False
    pull_at: float = NEVER
    chunk: int = MAX_ROWS
    _pause: float = 0.0

    def offer(self, entry: Entry) -> None:
        """Keep a change until its turn comes, if there is room."""
        if entry.sequence == self.watermark + 1 or len(self.ahead) < self.settings.ahead:
            self.ahead[entry.sequence] = entry

    def next_run(self) -> list[Entry]:
        """The changes that follow the watermark without a gap."""
        run: list[Entry] = []
        while (entry := self.ahead.get(self.watermark + 1 + len(run))) is not None:
            run.append(entry)
        return run

    def settled(self, applied: Applied) -> None:
        """Take note of what is committed."""
        self.watermark = applied.watermark
        self.newest = max(self.newest, self.watermark)
        self.ahead = {sequence: e for sequence, e in self.ahead.items() if sequence > self.watermark}
        self.refusals = (*self.refusals, *applied.refusals)[-MAX_REFUSALS:]

    def heard(self, now: float) -> None:
        """The agent is reachable: shorten the wait for the next attempt."""
        self._pause = min(self._pause, self.settings.first_pause)
        if self.newest > self.watermark or self.damaged:
            self.pull_at = min(self.pull_at, now + self._pause)

    def missing(self, now: float) -> LogRequest | None:
        """What to pull now, if anything."""
        if self.pulling:
            return None
        if self.newest <= self.watermark and not self.damaged:
            self.pull_at = NEVER
            return None
        if self.pull_at == NEVER:
            self.pull_at = now + max(self.settings.grace, self._pause)
        if self.pull_at > now:
            return None
        self.pulling = True
        if self.newest <= self.watermark:
            _, first, last = self.damaged[0]
            return LogRequest(first, min(last, first + self.chunk - 1))
        first = self.watermark + 1
        end = min((sequence - 1 for sequence in self.ahead), default=self.newest)
        return LogRequest(first, max(first, min(end, self.newest, first + self.chunk - 1)))

    def was_damaged(self, sequence: int) -> bool:
        """Whether a settled change was found damaged on the disk."""
        return any(first <= sequence <= last for _, first, last in self.damaged)

    def pulled(self, now: float, *, gained: bool) -> None:
        """A pull is over. After one that gained nothing the pause doubles."""
        self.pulling = False
        if gained:
            self._pause = 0.0
            self.chunk = min(MAX_ROWS, self.chunk * 4)
        else:
            self._pause = min(max(2 * self._pause, self.settings.first_pause), self.settings.longest_pause)
        self.pull_at = now + self._pause

    def commit_failed(self, now: float, wait: float) -> None:
        """The commit failed: drop the changes ahead, they will be pulled."""
        self.ahead.clear()
        self._pause = wait
        self.pull_at = now + wait

"""State of one agent's log at the ingest, and when the next piece of it should be pulled."""

from collections import deque
from dataclasses import dataclass, field

from mapweave.hybridmap.ids import MapId
from mapweave.mapserver.log.entry import Applied, ReceivedChange
from mapweave.mapserver.log.integrity import Gap
from mapweave.wire.log_messages import MAX_REFUSALS, MAX_ROWS, LogRequest, Refusal

NEVER = float("inf")
MOST_ANNOUNCED = 64
"""Announcements that are kept while changes are missing; beyond, each two become one."""


@dataclass(frozen=True, slots=True)
class PullSettings:
    """When missing changes are pulled.

    Attributes:
        grace: how long a gap may close by itself before it is pulled, s.
        first_pause: after a pull that failed, s; doubled each time.
        longest_pause: between two pulls of one log, s.
        ahead: changes behind a gap that are kept in memory; more are pulled again.
        ahead_bytes: of these, likewise.
    """

    grace: float = 0.05
    first_pause: float = 0.2
    longest_pause: float = 5.0
    ahead: int = 1024
    ahead_bytes: int = 2**22


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
        unverified: settled changes that one of these may have undone, see `Store.verify`.
        pulling: whether a pull is under way.
        pull_at: when the next one is due.
        chunk: changes to ask for at once; smaller after an answer that could not be read.
        resting_until: nothing is pulled before.
        claimed: up to which change the robot knows this server to have had the log, as far as that was
            compared with the store.
    """

    map: MapId
    log_id: int
    settings: PullSettings
    watermark: int = 0
    newest: int = 0
    ahead: dict[int, ReceivedChange] = field(default_factory=dict)
    refusals: tuple[Refusal, ...] = ()
    damaged: list[Gap] = field(default_factory=list)
    unverified: Gap | None = None
    pulling: bool = False
    pull_at: float = NEVER
    chunk: int = MAX_ROWS
    resting_until: float = -NEVER
    claimed: int = 0
    _pause: float = 0.0
    _ahead_bytes: int = 0
    _announced: deque[tuple[int, float]] = field(default_factory=deque)
    _received: dict[int, float] = field(default_factory=dict)

    def announce(self, newest: int, now: float) -> None:
        """Take note that the log goes up to this sequence number."""
        if newest <= self.newest:
            return
        self.newest = newest
        self._announced.append((newest, now))
        if len(self._announced) > MOST_ANNOUNCED:
            *older, last = self._announced
            pairs = zip(older[::2], older[1::2], strict=True)
            self._announced = deque([*((later, began) for (_, began), (later, _) in pairs), last])

    def lag(self, now: float) -> float:
        """How long a change is known of that is not settled, s; 0 if all are.

        Never less than it is, and at most a few percent more.
        """
        return max(now - self._announced[0][1], 0.0) if self._announced else 0.0

    def offer(self, entry: ReceivedChange, received: float | None = None) -> None:
        """Keep a change until its turn comes, if there is room.

        Args:
            entry: the change.
            received: when it was; None if it did not come by itself.
        """
        size = self._ahead_bytes + len(entry.message)
        room = len(self.ahead) < self.settings.ahead and size <= self.settings.ahead_bytes
        if room or entry.sequence == self.watermark + 1:
            self.ahead[entry.sequence] = entry
            self._ahead_bytes = size
            if received is not None:
                self._received[entry.sequence] = received

    def forget_ahead(self) -> None:
        """Drop the changes that wait for their turn; they will be pulled."""
        self.ahead.clear()
        self._received.clear()
        self._ahead_bytes = 0

    def next_run(self, after: int) -> list[ReceivedChange]:
        """The changes that follow this sequence number without a gap."""
        run: list[ReceivedChange] = []
        while (entry := self.ahead.get(after + 1 + len(run))) is not None:
            run.append(entry)
        return run

    def settled(self, applied: Applied) -> list[float]:
        """Take note of what is committed.

        Returns:
            When those of the changes were received that came by themselves.
        """
        self.watermark = applied.watermark
        self.newest = max(self.newest, self.watermark)
        self.ahead = {sequence: e for sequence, e in self.ahead.items() if sequence > self.watermark}
        self._ahead_bytes = sum(len(entry.message) for entry in self.ahead.values())
        self.refusals = (*self.refusals, *applied.refusals)[-MAX_REFUSALS:]
        while self._announced and self._announced[0][0] <= self.watermark:
            self._announced.popleft()
        settled = [sequence for sequence in self._received if sequence <= self.watermark]
        return [self._received.pop(sequence) for sequence in settled]

    def go_back(self, watermark: int, now: float) -> None:
        """The store has lost what it had behind this change: it is missing again."""
        since = min(now, self._announced[0][1]) if self._announced else now
        self._announced.appendleft((self.watermark, since))
        self.watermark, self.pull_at = watermark, NEVER

    def heard(self, now: float) -> None:
        """The agent is reachable: shorten the wait for the next attempt."""
        self._pause = min(self._pause, self.settings.first_pause)
        if not self.complete:
            self.pull_at = min(self.pull_at, now + self._pause)

    @property
    def complete(self) -> bool:
        """Whether nothing is missing, as far as is known."""
        return self.newest <= self.watermark and not self.damaged and self.unverified is None

    @property
    def lacking(self) -> int:
        """Changes that are known of and have not come."""
        return max(self.newest - self.watermark - len(self.ahead), 0)

    def plan(self, now: float) -> None:
        """Note when to pull next, if that is not known yet."""
        if self.complete:
            self.pull_at = NEVER
        elif self.pull_at == NEVER:
            self.pull_at = now + max(self.settings.grace, self._pause)

    def missing(self, now: float, most: int = MAX_ROWS) -> LogRequest | None:
        """What to pull now, if anything: so many changes at most."""
        if self.pulling:
            return None
        self.plan(now)
        if self.pull_at > now:
            return None
        self.pulling = True
        rows = min(self.chunk, most)
        if self.newest <= self.watermark:
            _, first, last = [*self.damaged, *filter(None, [self.unverified])][0]
            return LogRequest(first, min(last, first + rows - 1))
        first = self.watermark + 1
        end = min((sequence - 1 for sequence in self.ahead), default=self.newest)
        return LogRequest(first, max(first, min(end, self.newest, first + rows - 1)))

    def was_damaged(self, sequence: int) -> bool:
        """Whether a settled change was found damaged on the disk."""
        return any(first <= sequence <= last for _, first, last in self.damaged)

    def is_unverified(self, sequence: int) -> bool:
        """Whether a settled change, and those behind it, are the next to be verified."""
        return self.unverified is not None and self.unverified.first == sequence

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
        """The commit failed: drop the changes ahead, they will be pulled.

        One is enough to find out whether the disk takes them again; more would be pulled for nothing, and
        spend what the robot may send.
        """
        self.forget_ahead()
        self.chunk = 1
        self._pause = wait
        self.pull_at = now + wait

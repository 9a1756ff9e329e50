"""Takes in what agents send: every change of every log exactly once and in order, despite losses.

    change -------> in order? -> store (commit) -> acknowledge -> on_change
    beacon -------> gap? ------> ask the agent's log for it, in chunks -> store ...

Robots take turns, a few changes each, and have quotas (mapweave.mapserver.quotas): what is beyond them is
dropped, and pulled later at the rate of the quota.

A change that does not decode when it is published is treated as lost and pulled: it may have been damaged
on the way. If it does not decode when it is pulled either, the agent's log itself has it like that, and it is
refused: kept aside with the reason, which is sent with the acknowledgement, and the log goes on after it.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Collection, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import NamedTuple

from mapweave.hybridmap.change import Change, ChangeBody
from mapweave.hybridmap.errors import InvalidFile, InvalidMessage, InvalidValue, MapweaveError
from mapweave.hybridmap.node import MapId, check_name
from mapweave.mapserver.log.agent_log import AgentLog, PullSettings
from mapweave.mapserver.log.entry import Applied, Entry
from mapweave.mapserver.log.following import settled, unseen, up_to
from mapweave.mapserver.log.inbox import Inbox
from mapweave.mapserver.log.ingest_counters import IngestCounters
from mapweave.mapserver.log.intake import Intakes
from mapweave.mapserver.log.pull_schedule import AT_ONCE, PullSchedule
from mapweave.mapserver.log.pulled import Piece, Pulled
from mapweave.mapserver.log.store import News, Store
from mapweave.mapserver.quotas import Quotas
from mapweave.wire.bus import Bus, Closing, Request, Sample
from mapweave.wire.codec import MAX_CHANGE_BYTES
from mapweave.wire.keys import Keys, robot_of
from mapweave.wire.log_messages import Ack, Head, LogRequest, Mark, NewestMap, Refusal

log = logging.getLogger(__name__)

AT_ONE_TURN = 16
"""Messages that are processed, or pulled changes of a robot, before others get their turn: some 30 ms."""
QUOTA_PAUSE = 10.0
"""s after which a log is tried again that the robot's quota has no room for."""
MOST_UNKNOWN = 1024
"""Logs of which nothing has come but beacons; of more, the one that is silent longest is forgotten."""


@dataclass(frozen=True, slots=True)
class IngestSettings:
    """How changes are taken in.

    Attributes:
        pull: when missing changes are pulled.
        ask_timeout: for a piece of a log, s.
        retry_interval: after a failed commit (disk full), s.
    """

    pull: PullSettings = field(default_factory=PullSettings)
    ask_timeout: float = 2.0
    retry_interval: float = 1.0


class Lag(NamedTuple):
    """How far the store is behind a robot.

    Attributes:
        missing: changes that are known of and not settled.
        seconds: for how long one of them is known of.
    """

    missing: int
    seconds: float


MOST_AHEAD = 10_000_000
"""Changes that a server may lack of a log: a robot makes about one a second, and a year has 3e7."""


def words_of(refusal: Refusal) -> str:
    """Which change is refused, and why."""
    return f"change {refusal.sequence} is refused ({refusal.reason})"


class Ingest:
    """Keeps a store complete. One thread applies changes; a few more wait for agents' answers."""

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        store: Store,
        server_name: str,
        on_change: Callable[[Change], None],
        settings: IngestSettings | None = None,
        replay: Callable[[Iterable[Change]], None] | None = None,
        objection: Callable[[ChangeBody], str] = lambda body: "",
        taken: Collection[MapId] = (),
        quotas: Quotas | None = None,
        retired: Callable[[], Collection[MapId]] = tuple,
        unmerged: Callable[[str], int] = lambda robot: 0,
        note_refusal: Callable[[MapId, str], None] = lambda map_id, reason: None,
        observe_ack: Callable[[float], None] = lambda seconds: None,
    ) -> None:
        """Replay the store, then listen.

        Args:
            bus: the connection; stays the caller's.
            keys: of the fleet.
            store: stays the caller's.
            server_name: under which acknowledgements go out.
            on_change: called with every change after it is committed, in order of each log: at the start with
                all that is in the store, in the caller's thread, later in the ingest's own. It should only
                take note, because the next change waits for it.
            settings: how.
            replay: called instead with all that is in the store at once, map by map.
            objection: why a change cannot be of the map whose name it has; its log is refused then.
            taken: maps that are here and not in the store: no new one may have their names.
            quotas: of robots.
            retired: maps that do not count for them.
            unmerged: how many changes of a robot were passed on and wait.
            note_refusal: called for a map of which a change was refused or is not believed, with the reason.
            observe_ack: called for each published change with the time from its receipt to its
                acknowledgement, s.

        Raises:
            InvalidFile: the store cannot be read.
        """
        self._bus, self._keys, self._store, self._name = bus, keys, store, check_name(server_name)
        self._objection, self._taken = objection, tuple(taken)
        self._quotas, self._unmerged = quotas or Quotas(clock=time.monotonic), unmerged
        self._on_change, self._note_refusal, self._observe_ack = on_change, note_refusal, observe_ack
        self._counters = IngestCounters()
        self._settings = settings or IngestSettings()
        self._logs: dict[MapId, AgentLog] = {}
        self._intakes = Intakes(store, self._quotas, retired)
        self._unknown: dict[MapId, None] = {}
        self._pulls = PullSchedule()
        self._work: Inbox[Sample | Pulled | Piece | News] = Inbox()
        self._declared: list[Closing] = []
        self._pullers = ThreadPoolExecutor(AT_ONCE, thread_name_prefix="pull")
        self._thread = threading.Thread(target=self._run, name="ingest", daemon=True)
        self._stopping, self._failure = False, ""
        positions = self._store.positions()
        maps = sorted(positions)
        stored = (change for m in maps for change in settled(store, m, positions[m]))
        for map_id in maps:
            for refusal in self._store.refusals(map_id)[:1]:
                self._note_refusal(map_id, words_of(refusal))
        if replay is not None:
            replay(stored)
        for change in stored:
            self._on_change(change)
        for map_id in maps:
            log_id, watermark = positions[map_id]
            refusals = tuple(self._store.refusals(map_id))
            self._logs[map_id] = AgentLog(
                map_id, log_id, self._settings.pull, watermark, watermark, refusals=refusals,
                damaged=self._store.damaged(map_id),
            )  # fmt: skip
            self._pulls.answers(map_id.agent)
            self._pulls.note(self._logs[map_id], time.monotonic())
        self._thread.start()
        self._declared = [
            self._bus.subscribe(self._keys.changes(), self._hear),
            self._bus.subscribe(self._keys.heads(), self._hear),
            self._bus.serve(self._keys.all_acks(self._name), self._tell_newest),
        ]

    def counters(self) -> IngestCounters:
        """Counters since the start."""
        return self._counters

    def lags(self) -> dict[str, Lag]:
        """How far the store is behind each robot, by name; from any thread."""
        now, lags = time.monotonic(), dict[str, Lag]()
        for agent_log in list(self._logs.values()):
            before = lags.get(agent_log.map.agent, Lag(0, 0.0))
            missing = max(agent_log.newest - agent_log.watermark, 0)
            lags[agent_log.map.agent] = Lag(before.missing + missing, max(before.seconds, agent_log.lag(now)))
        return lags

    @property
    def waiting(self) -> int:
        """Messages that wait for their turn."""
        return len(self._work)

    @property
    def failure(self) -> str:
        """Why the disk does not take changes at present; empty if it does."""
        return self._failure

    def follow(self, news: News) -> None:
        """Pass on what other servers have written to the store; from any thread, in the ingest's own."""
        self._work.put("", news, bounded=False)

    def close(self) -> None:
        """Stop listening; received changes are applied, missing ones will be pulled next time."""
        for declared in self._declared:
            declared.close()
        self._declared = []
        self._stopping = True
        self._work.interrupt()
        if self._thread.is_alive():
            self._thread.join()
        self._pullers.shutdown(cancel_futures=True)

    def _hear(self, sample: Sample) -> None:
        """A message has come; in the bus's thread."""
        robot = robot_of(sample.key)
        if not self._work.put(robot, sample, len(sample.payload)):
            self._quotas.hold_back(robot, "changes" if sample.attachment else "beacons")

    def _run(self) -> None:
        while not self._stopping:
            now = time.monotonic()
            for robot, items in self._work.take(AT_ONE_TURN, self._pulls.due(now) - now):
                touched: dict[MapId, AgentLog] = {}
                for item in items:
                    agent_log = self._take(robot, item)
                    if agent_log is not None:
                        touched[agent_log.map] = agent_log
                for agent_log in touched.values():
                    self._apply(agent_log, agent_log.next_run(), None)
                    self._pulls.note(agent_log, time.monotonic())
            self._start_pulls()

    def _start_pulls(self) -> None:
        while (agent_log := self._pulls.next(now := time.monotonic())) is not None:
            agent = agent_log.map.agent
            intake = self._intakes.of(agent)
            rows = intake.rows(self._unmerged(agent))
            asked = agent_log.missing(now, rows) if rows else None
            if asked is None:
                agent_log.pull_at = now + intake.pause()
                continue
            self._count(pulls=1)
            self._pulls.asks(agent)
            self._pullers.submit(self._pull, agent_log, asked)

    def _take(self, robot: str, item: Sample | Pulled | Piece | News) -> AgentLog | None:
        """Process one item of the inbox. Returns the log that may go on now."""
        try:
            if isinstance(item, Pulled):
                return self._take_pulled(item)
            if isinstance(item, Piece):
                return self._take_piece(item)
            if isinstance(item, News):
                self._take_news(item)
                return None
            if item.attachment:
                return self._take_change(item)
            return self._take_head(item)
        except InvalidMessage as error:
            self._count(damaged=1)
            self._intakes.of(robot).spend(1, 0)
            damaged = self._counters.damaged
            # Each power of two: a flood must not become a flood of log lines.
            if damaged & (damaged - 1) == 0:
                log.warning("%d invalid messages so far; the last: %s", damaged, error)
            return None

    def _take_change(self, sample: Sample) -> AgentLog | None:
        self._count(messages=1, message_bytes=len(sample.payload))
        map_id = self._keys.parse_change(sample.key)
        mark = Mark.decode(sample.attachment)
        agent_log = self._log(map_id, mark.log_id)
        if agent_log is None:
            return None
        self._believe(agent_log, mark.sequence)
        intake = self._intakes.of(map_id.agent)
        if mark.sequence <= agent_log.watermark or mark.sequence in agent_log.ahead:
            self._count(doubled=1)
            return agent_log
        if not intake.change(len(sample.payload), self._unmerged(map_id.agent)):
            return agent_log
        fits = len(sample.payload) <= MAX_CHANGE_BYTES
        entry = Entry.read(map_id, mark.sequence, sample.payload if fits else b"")
        if isinstance(entry.change, str):
            self._count(damaged=1)
            log.info("%s %d came damaged (%s), pulling it", map_id, mark.sequence, entry.change)
        else:
            intake.keep_ahead_of(agent_log)
            agent_log.offer(entry, sample.received)
        return agent_log

    def _take_head(self, sample: Sample) -> AgentLog | None:
        map_id = self._keys.parse_head(sample.key)
        if not self._intakes.of(map_id.agent).beacon():
            return None
        head = Head.decode(sample.payload)
        agent_log = self._log(map_id, head.log_id)
        if agent_log is None:
            return None
        self._believe(agent_log, head.newest)
        agent_log.heard(time.monotonic())
        # More than there is: it was another store that had it.
        if head.acknowledged.get(self._name, 0) != agent_log.watermark:
            self._acknowledge(agent_log)
        return agent_log

    def _take_pulled(self, pulled: Pulled) -> AgentLog | None:
        agent_log, first = pulled.log, pulled.asked.first
        piece, damaged = pulled.piece()
        self._count(pulled=len(piece.rows), damaged=damaged)
        self._intakes.of(agent_log.map.agent).spend(len(piece.rows), sum(len(row) for _, row in piece.rows))
        self._pulls.ends(agent_log.map.agent, answered=piece.covered >= first)
        if self._logs.get(agent_log.map) is not agent_log:
            return None
        if piece.covered < first:
            agent_log.pulled(time.monotonic(), gained=False)
        elif agent_log.was_damaged(first):
            agent_log.pulled(time.monotonic(), gained=True)
            entries = [Entry.read(agent_log.map, *row) for row in piece.rows]
            self._restore(agent_log, first, piece.covered, entries)
        else:
            self._take_piece(piece)
        return agent_log

    def _take_piece(self, piece: Piece) -> AgentLog:
        """Apply some of the changes that were pulled; the others wait for the robot's next turn."""
        agent_log, rows, later = piece.log, piece.rows[:AT_ONE_TURN], piece.rows[AT_ONE_TURN:]
        covered = later[0][0] - 1 if later else piece.covered
        if covered > agent_log.watermark:
            self._apply(agent_log, [Entry.read(agent_log.map, *row) for row in rows], covered)
        gained = agent_log.watermark >= covered
        if gained and later:
            self._work.put(agent_log.map.agent, Piece(agent_log, later, piece.covered), bounded=False)
        else:
            agent_log.pulled(time.monotonic(), gained=gained)
        return agent_log

    def _take_news(self, news: News) -> None:
        """Go on where other servers have brought the logs."""
        try:
            for map_id, (log_id, watermark) in self._store.positions(news.maps).items():
                agent_log = self._logs.get(map_id)
                if agent_log is None or (agent_log.log_id != log_id and agent_log.watermark == 0):
                    agent_log = self._logs[map_id] = AgentLog(map_id, log_id, self._settings.pull)
                if agent_log.log_id != log_id or watermark <= agent_log.watermark:
                    continue
                self._intakes.of(map_id.agent).recount()
                for change in up_to(watermark, self._store.replay(map_id, agent_log.watermark)):
                    self._pass_on([change])
                    agent_log.settled(Applied((), (), change.sequence))
                agent_log.settled(Applied((), (), watermark))
                agent_log.refusals = tuple(self._store.refusals(map_id))
                for refusal in agent_log.refusals[:1]:
                    self._note_refusal(map_id, words_of(refusal))
                self._pulls.answers(map_id.agent)
                self._pulls.note(agent_log, time.monotonic())
        except InvalidFile as error:
            # With the next news everything is looked at.
            log.warning("%s", error)

    def _restore(self, agent_log: AgentLog, first: int, covered: int, entries: list[Entry]) -> None:
        """Put damaged changes in their places again and pass them on."""
        try:
            changes = self._store.restore(agent_log.map, first, covered, entries)
        except InvalidFile as error:
            self._commit_failed(agent_log, error)
            return
        self._failure = ""
        agent_log.damaged = self._store.damaged(agent_log.map)
        log.warning("changes %d to %d of %s are whole again", first, covered, agent_log.map)
        self._count(restored=len(entries))
        self._pass_on(changes)

    def _log(self, map_id: MapId, log_id: int) -> AgentLog | None:
        """The log of this name, or None after notifying the agent that it is another's."""
        agent_log = self._logs.get(map_id)
        if agent_log is None and (reason := self._intakes.objection(map_id, self._logs)):
            self._quotas.hold_back(map_id.agent, "maps")
            self._refuse(map_id, log_id, reason)
            return None
        if agent_log is None or (agent_log.log_id != log_id and agent_log.watermark == 0):
            agent_log = self._logs[map_id] = AgentLog(map_id, log_id, self._settings.pull)
        if agent_log.log_id == log_id:
            self._remember(agent_log)
            return agent_log
        self._refuse(map_id, log_id, f"another log goes by the name {map_id} here: begin a fresh map")
        return None

    def _remember(self, agent_log: AgentLog) -> None:
        """Forget which logs were only heard of, long ago, so that names alone fill no memory."""
        self._unknown.pop(agent_log.map, None)
        if agent_log.watermark > 0:
            return
        self._unknown[agent_log.map] = None
        if len(self._unknown) > MOST_UNKNOWN:
            oldest = next(known for known in self._unknown if not self._logs[known].pulling)
            del self._unknown[oldest], self._logs[oldest]
            self._pulls.forget(oldest)

    def _believe(self, agent_log: AgentLog, newest: int) -> None:
        """Take note of a sequence number.

        Raises:
            InvalidMessage: no log is as long.
        """
        if newest > agent_log.watermark + MOST_AHEAD:
            reason = f"change {newest} is announced, where {agent_log.watermark} have come"
            self._note_refusal(agent_log.map, reason)
            raise InvalidMessage(f"{agent_log.map}: {reason}")
        agent_log.announce(newest, time.monotonic())

    def _refuse(self, map_id: MapId, log_id: int, reason: str, watermark: int = 0) -> None:
        """Notify an agent that its log is not taken, or not beyond the watermark."""
        ack = Ack(map_id, log_id, watermark, (Refusal(0, reason),), self._store.id)
        self._bus.publish(self._keys.ack(self._name, map_id.agent), ack.encode())

    def _apply(self, agent_log: AgentLog, entries: list[Entry], covered: int | None) -> None:
        """Commit, pass on, acknowledge: in this order."""
        if not entries and covered is None:
            return
        objections = (self._objection(e.change.body) for e in entries if isinstance(e.change, Change))
        if reason := next(filter(None, objections), ""):
            agent_log.commit_failed(time.monotonic(), self._settings.retry_interval)
            self._refuse(agent_log.map, agent_log.log_id, reason)
            return
        try:
            fits, full = self._intakes.of(agent_log.map.agent).fitting(entries)
            if full:
                if not fits:
                    self._rest(agent_log, full)
                    return
                covered = None if covered is None else entries[fits].sequence - 1
                entries = entries[:fits]
            applied = self._store.apply(agent_log.map, agent_log.log_id, entries, covered)
            changes = tuple(unseen(self._store, agent_log, applied))
        except (InvalidFile, InvalidValue) as error:
            # Nothing is lost: it is not acknowledged, so the agent keeps it and it is pulled later.
            self._commit_failed(agent_log, error)
            return
        self._failure = ""
        received = agent_log.settled(applied)
        self._pulls.answers(agent_log.map.agent)
        for refusal in applied.refusals:
            log.warning("refused %s %d: %s", agent_log.map, refusal.sequence, refusal.reason)
            self._note_refusal(agent_log.map, words_of(refusal))
        self._count(applied=len(applied.changes), refused=len(applied.refusals))
        self._pass_on(changes)
        # Last: a robot may ask about its changes as soon as they are acknowledged.
        self._acknowledge(agent_log)
        for at in received:
            self._observe_ack(time.monotonic() - at)
        if full:
            self._rest(agent_log, full)

    def _rest(self, agent_log: AgentLog, reason: str) -> None:
        """There is no room for more of a log now: it stays on the robot's disk."""
        self._quotas.hold_back(agent_log.map.agent, "nodes")
        agent_log.forget_ahead()
        agent_log.resting_until = time.monotonic() + QUOTA_PAUSE
        self._refuse(agent_log.map, agent_log.log_id, reason, agent_log.watermark)

    def _commit_failed(self, agent_log: AgentLog, error: MapweaveError) -> None:
        agent_log.commit_failed(time.monotonic(), self._settings.retry_interval)
        self._count(failures=1)
        if str(error) != self._failure:
            log.error("%s", error)
        self._failure = str(error)

    def _pass_on(self, changes: Iterable[Change]) -> None:
        for change in changes:
            try:
                self._on_change(change)
            except Exception:
                # The change is safe on the disk; an error in its processing must not stop the other robots'
                # logs.
                log.exception("passing on %s %d failed", change.map, change.sequence)

    def _acknowledge(self, agent_log: AgentLog) -> None:
        ack = Ack(agent_log.map, agent_log.log_id, agent_log.watermark, agent_log.refusals, self._store.id)
        self._bus.publish(self._keys.ack(self._name, agent_log.map.agent), ack.encode())

    def _tell_newest(self, request: Request) -> None:
        """Which numbers an agent must not give to a new map: it may have lost its disk."""
        _, agent = self._keys.parse_ack(request.key)
        try:
            maps = (*self._store.maps(), *self._taken)
        except InvalidFile as error:
            request.refuse(str(error))
            return
        epochs = (known.epoch for known in maps if known.agent == agent)
        request.reply(NewestMap(max(epochs, default=0)).encode())

    def _pull(self, agent_log: AgentLog, asked: LogRequest) -> None:
        """Ask for a piece of a log; in a thread of its own, because an agent may be slow."""
        replies = self._bus.ask(self._keys.log(agent_log.map), asked.encode(), self._settings.ask_timeout)
        self._work.put(agent_log.map.agent, Pulled(agent_log, asked, replies), bounded=False)

    def _count(self, **more: int) -> None:
        self._counters = self._counters.plus(**more)

"""Takes in what agents send: every change of every log exactly once and in order, despite losses.

    change -------> in order? -> store (commit) -> acknowledge -> on_change
    beacon -------> gap? ------> ask the agent's log for it, in chunks -> store ...

A change that does not decode when it is published is treated as lost and pulled: it may have been damaged
on the way. If it does not decode when it is pulled either, the agent's log itself has it like that, and it is
refused: kept aside with the reason, which is sent with the acknowledgement, and the log goes on after it.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Collection, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

from mapweave.hybridmap.change import Change, ChangeBody
from mapweave.hybridmap.errors import InvalidFile, InvalidMessage, InvalidValue, MapweaveError
from mapweave.hybridmap.node import MapId, check_name
from mapweave.mapserver.log.agent_log import NEVER, AgentLog, PullSettings
from mapweave.mapserver.log.entry import Entry
from mapweave.mapserver.log.ingest_counters import IngestCounters
from mapweave.mapserver.log.store import Store
from mapweave.wire.bus import Bus, Closing, Reply, Request, Sample
from mapweave.wire.codec import MAX_CHANGE_BYTES
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import MAX_ROWS, Ack, Head, LogAnswer, LogRequest, Mark, NewestMap, Refusal

log = logging.getLogger(__name__)

LONGEST_WAIT = 3600.0
"""Of the thread, s, when nothing is due: an infinite one cannot be given."""


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


@dataclass(frozen=True, slots=True)
class _Pulled:
    """Answer for a range of a log."""

    map: MapId
    asked: LogRequest
    replies: list[Reply]


PULLS_AT_ONCE = 4
"""Logs that are pulled at once."""
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
        note_refusal: Callable[[MapId, str], None] = lambda map_id, reason: None,
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
            note_refusal: called for a map of which a change was refused or is not believed, with the reason.

        Raises:
            InvalidFile: the store cannot be read.
        """
        self._bus = bus
        self._keys = keys
        self._store = store
        self._name = check_name(server_name)
        self._objection, self._taken = objection, tuple(taken)
        self._on_change, self._note_refusal = on_change, note_refusal
        self._settings = settings or IngestSettings()
        self._counters = IngestCounters()
        self._logs: dict[MapId, AgentLog] = {}
        self._work: queue.SimpleQueue[Sample | _Pulled | None] = queue.SimpleQueue()
        self._declared: list[Closing] = []
        self._pullers = ThreadPoolExecutor(PULLS_AT_ONCE, thread_name_prefix="pull")
        self._thread = threading.Thread(target=self._run, name="ingest", daemon=True)
        self._stopping = False
        self._failure = ""
        maps = self._store.maps()
        stored = (change for map_id in maps for change in self._store.replay(map_id))
        for map_id in maps:
            for refusal in self._store.refusals(map_id)[:1]:
                self._note_refusal(map_id, words_of(refusal))
        if replay is not None:
            replay(stored)
        for change in stored:
            self._on_change(change)
        for map_id in maps:
            watermark, log_id = self._store.watermark(map_id), self._store.log_id(map_id) or 0
            refusals = tuple(self._store.refusals(map_id))
            self._logs[map_id] = AgentLog(
                map_id, log_id, self._settings.pull, watermark, watermark, refusals=refusals,
                damaged=self._store.damaged(map_id),
            )  # fmt: skip
        self._thread.start()
        self._declared = [
            self._bus.subscribe(self._keys.changes(), self._work.put),
            self._bus.subscribe(self._keys.heads(), self._work.put),
            self._bus.serve(self._keys.all_acks(self._name), self._tell_newest),
        ]

    def counters(self) -> IngestCounters:
        """Counters since the start."""
        return self._counters

    @property
    def failure(self) -> str:
        """Why the disk does not take changes at present; empty if it does."""
        return self._failure

    def close(self) -> None:
        """Stop listening; received changes are applied, missing ones will be pulled next time."""
        for declared in self._declared:
            declared.close()
        self._declared = []
        self._stopping = True
        self._work.put(None)
        if self._thread.is_alive():
            self._thread.join()
        self._pullers.shutdown(cancel_futures=True)

    def _run(self) -> None:
        while not self._stopping:
            due = min(
                (agent_log.pull_at for agent_log in self._logs.values() if not agent_log.pulling),
                default=NEVER,
            )
            touched: dict[MapId, AgentLog] = {}
            for item in self._drain(due):
                agent_log = self._take(item)
                if agent_log is not None:
                    touched[agent_log.map] = agent_log
            now = time.monotonic()
            for agent_log in self._logs.values():
                if agent_log.map in touched:
                    self._apply(agent_log, agent_log.next_run(), None)
                if agent_log.map in touched or agent_log.pull_at <= now:
                    asked = agent_log.missing(now)
                    if asked is not None:
                        self._count(pulls=1)
                        self._pullers.submit(self._pull, agent_log.map, asked)

    def _drain(self, due: float) -> list[Sample | _Pulled]:
        """Wait for items until a pull is due; take all that wait, for one transaction a log."""
        items: list[Sample | _Pulled] = []
        try:
            item = self._work.get(timeout=min(max(0.0, due - time.monotonic()), LONGEST_WAIT))
            while item is not None:
                items.append(item)
                if len(items) == MAX_ROWS:
                    break
                item = self._work.get_nowait()
        except queue.Empty:
            pass
        return items

    def _take(self, item: Sample | _Pulled) -> AgentLog | None:
        """Process one item of the inbox. Returns the log that may go on now."""
        try:
            if isinstance(item, _Pulled):
                return self._take_pulled(item)
            if item.attachment:
                return self._take_change(item)
            return self._take_head(item)
        except InvalidMessage as error:
            self._count(damaged=1)
            log.warning("%s", error)
            return None

    def _take_change(self, sample: Sample) -> AgentLog | None:
        self._count(messages=1, message_bytes=len(sample.payload))
        map_id = self._keys.parse_change(sample.key)
        mark = Mark.decode(sample.attachment)
        agent_log = self._log(map_id, mark.log_id)
        if agent_log is None:
            return None
        self._believe(agent_log, mark.sequence)
        if mark.sequence <= agent_log.watermark or mark.sequence in agent_log.ahead:
            self._count(doubled=1)
            return agent_log
        fits = len(sample.payload) <= MAX_CHANGE_BYTES
        entry = Entry.read(map_id, mark.sequence, sample.payload if fits else b"")
        if isinstance(entry.change, str):
            self._count(damaged=1)
            log.info("%s %d came damaged (%s), pulling it", map_id, mark.sequence, entry.change)
        else:
            agent_log.offer(entry)
        return agent_log

    def _take_head(self, sample: Sample) -> AgentLog | None:
        map_id = self._keys.parse_head(sample.key)
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

    def _take_pulled(self, pulled: _Pulled) -> AgentLog | None:
        agent_log = self._logs[pulled.map]
        entries, covered = self._read_answer(agent_log, pulled)
        self._count(pulled=len(entries))
        first = pulled.asked.first
        damaged = agent_log.was_damaged(first)
        gained = covered >= first if damaged else covered > agent_log.watermark
        agent_log.pulled(time.monotonic(), gained=gained)
        if gained and damaged:
            self._restore(agent_log, first, covered, entries)
        elif gained:
            self._apply(agent_log, entries, covered)
        return agent_log

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

    def _read_answer(self, agent_log: AgentLog, pulled: _Pulled) -> tuple[list[Entry], int]:
        """The changes that were pulled and how far they reach; (nothing, 0) if no answer is of use."""
        asked = pulled.asked
        for reply in pulled.replies:
            if reply.error:
                log.info(
                    "%s does not give %s from %d: %s",
                    agent_log.map.agent,
                    agent_log.map,
                    asked.first,
                    reply.error,
                )
                continue
            try:
                answer = LogAnswer.decode(reply.payload)
            except InvalidMessage as error:
                self._count(damaged=1)
                log.warning("%s from %d: %s", agent_log.map, asked.first, error)
                if asked.first == asked.last:
                    # It was asked for alone and does not fit into a message.
                    return [Entry(asked.first, b"", str(error))], asked.first
                agent_log.chunk = max(1, (asked.last - asked.first + 1) // 4)
                continue
            if answer.log_id == agent_log.log_id and answer.first == asked.first:
                entries = [Entry.read(agent_log.map, *change) for change in answer.changes]
                entries = [entry for entry in entries if entry.sequence <= asked.last]
                return entries, min(answer.covered, asked.last)
        return [], 0

    def _log(self, map_id: MapId, log_id: int) -> AgentLog | None:
        """The log of this name, or None after notifying the agent that it is another's."""
        agent_log = self._logs.get(map_id)
        if agent_log is None or (agent_log.log_id != log_id and agent_log.watermark == 0):
            agent_log = self._logs[map_id] = AgentLog(map_id, log_id, self._settings.pull)
        if agent_log.log_id == log_id:
            return agent_log
        self._refuse(map_id, log_id, f"another log goes by the name {map_id} here: begin a fresh map")
        return None

    def _believe(self, agent_log: AgentLog, newest: int) -> None:
        """Take note of a sequence number.

        Raises:
            InvalidMessage: no log is as long.
        """
        if newest > agent_log.watermark + MOST_AHEAD:
            reason = f"change {newest} is announced, where {agent_log.watermark} have come"
            self._note_refusal(agent_log.map, reason)
            raise InvalidMessage(f"{agent_log.map}: {reason}")
        agent_log.newest = max(agent_log.newest, newest)

    def _refuse(self, map_id: MapId, log_id: int, reason: str) -> None:
        """Notify an agent that its log is not taken."""
        ack = Ack(map_id, log_id, 0, (Refusal(0, reason),), self._store.id)
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
            applied = self._store.apply(agent_log.map, agent_log.log_id, entries, covered)
        except (InvalidFile, InvalidValue) as error:
            # Nothing is lost: it is not acknowledged, so the agent keeps it and it is pulled later.
            self._commit_failed(agent_log, error)
            return
        self._failure = ""
        agent_log.settled(applied)
        for refusal in applied.refusals:
            log.warning("refused %s %d: %s", agent_log.map, refusal.sequence, refusal.reason)
            self._note_refusal(agent_log.map, words_of(refusal))
        self._count(applied=len(applied.changes), refused=len(applied.refusals))
        self._pass_on(applied.changes)
        # Last: a robot may ask about its changes as soon as they are acknowledged.
        self._acknowledge(agent_log)

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
        maps = (*self._store.maps(), *self._taken)
        epochs = (known.epoch for known in maps if known.agent == agent)
        request.reply(NewestMap(max(epochs, default=0)).encode())

    def _pull(self, map_id: MapId, asked: LogRequest) -> None:
        """Ask for a piece of a log; in a thread of its own, because an agent may be slow."""
        replies = self._bus.ask(self._keys.log(map_id), asked.encode(), self._settings.ask_timeout)
        self._work.put(_Pulled(map_id, asked, replies))

    def _count(self, **more: int) -> None:
        self._counters = self._counters.plus(**more)

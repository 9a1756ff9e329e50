"""Takes in what agents send: every change of every log exactly once and in order, despite losses.

    change -------> in order? -> store (commit) -> on_change -> acknowledge
    beacon -------> gap? ------> ask the agent's log for it, in chunks -> store ...

What has come of all robots is committed at once (mapweave.mapserver.log.group_commit). Robots take turns, and
have quotas (mapweave.mapserver.quotas): what is beyond them is dropped, and pulled later at the rate of the
quota.

A change that does not decode when it is published is treated as lost and pulled: it may have been damaged
on the way. If it does not decode when it is pulled either, the agent's log itself has it like that, and it is
refused: kept aside with the reason, which is sent with the acknowledgement, and the log goes on after it.
"""

import logging
import threading
import time
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

from mapweave.hybridmap.change import Change, ChangeBody
from mapweave.hybridmap.errors import InvalidFile, InvalidMessage, MapweaveError
from mapweave.hybridmap.ids import MapId, NodeId, check_name
from mapweave.mapserver.log.acknowledgements import Acknowledgements
from mapweave.mapserver.log.agent_log import AgentLog
from mapweave.mapserver.log.entry import ReceivedChange, words_of
from mapweave.mapserver.log.following import Follower, settled, unseen
from mapweave.mapserver.log.group_commit import GroupCommit, NextRun
from mapweave.mapserver.log.inbox import Inbox
from mapweave.mapserver.log.ingest_counters import IngestCounters
from mapweave.mapserver.log.ingest_settings import IngestSettings
from mapweave.mapserver.log.intake import Full, Intakes
from mapweave.mapserver.log.known_logs import KnownLogs, Lag
from mapweave.mapserver.log.pulled import Pieces, Pulled, PulledChanges
from mapweave.mapserver.log.puller import Puller
from mapweave.mapserver.log.recovery import recover
from mapweave.mapserver.log.store import News, Store
from mapweave.mapserver.quotas import Quotas
from mapweave.storage.full_disks import logged
from mapweave.wire.bus import Bus, Closing, Sample
from mapweave.wire.codec import MAX_CHANGE_BYTES
from mapweave.wire.dispatch import Failures
from mapweave.wire.keys import Keys, robot_of
from mapweave.wire.log_messages import Head, Mark

log = logging.getLogger(__name__)

AT_ONE_TURN = 64
"""Messages that are processed and committed together: some 30 ms."""
QUOTA_PAUSE = 10.0
"""s after which a log is tried again that the robot's quota has no room for."""
MOST_AHEAD = 10_000_000
"""Changes that a server may lack of a log: a robot makes about one a second, and a year has 3e7."""


class Reminder(NamedTuple):
    """A log that is acknowledged once more, though nothing new has come: for what else is said with it."""

    map: MapId


class Ingest:
    """Keeps a store complete. One thread applies changes; a few more wait for agents' answers.

    Attributes:
        busy: whether what has come is being committed now.
        broken: why nothing is taken in any more, in one line; empty while it is.
    """

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
        note_disbelief: Callable[[MapId, str], None] = lambda map_id, reason: None,
        observe_ack: Callable[[float], None] = lambda seconds: None,
        status_period: Callable[[str], float] = lambda robot: 0.0,
        pruned: Callable[[NodeId], bool] = lambda node: False,
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
            note_refusal: called for a map of which a change was refused, with the reason.
            note_disbelief: called for a map of which a sequence number is not believed, with the reason.
            observe_ack: called for each published change with the time from its receipt to its
                acknowledgement, s.
            status_period: of a robot's statuses, s; 0: its own.
            pruned: whether a node has left the map for good, since it was superseded.

        Raises:
            InvalidFile: the store cannot be read.
        """
        self._bus, self._keys, self._store, self._name = bus, keys, store, check_name(server_name)
        self._objection = objection
        self._refusals, self._damages = Failures(), Failures()
        self._quotas, self._unmerged = quotas or Quotas(clock=time.monotonic), unmerged
        self._on_change, self._observe_ack = on_change, observe_ack
        self._note_refusal, self._note_disbelief = note_refusal, note_disbelief
        self._counters = IngestCounters()
        self._settings = s = settings or IngestSettings()
        self._logs = KnownLogs()
        self._intakes = Intakes(store, self._quotas, retired)
        self._group = GroupCommit(store, self._intakes)
        self._acks = Acknowledgements(bus, keys, server_name, store, taken, status_period, pruned)
        self._pieces = Pieces()
        self._puller = Puller(
            bus, keys, self._intakes, unmerged, store.newest_change, s.ask_timeout, self._put_pulled
        )
        self._pulls = self._puller.schedule
        # Logs that are acknowledged once more; and whether the robot does not know how far it was.
        self._unaware: dict[MapId, tuple[AgentLog, bool]] = {}
        self._work: Inbox[Sample | Pulled | PulledChanges | News | Reminder] = Inbox()
        self._follower = Follower(
            store, self._logs, self._intakes, self._pulls, s.pull, self._pass_on, note_refusal
        )
        self._declared: list[Closing] = []
        self._thread = threading.Thread(target=self._run, name="ingest", daemon=True)
        self._stopping, self.busy, self._failure, self.broken = False, False, "", ""
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
        self._logs.restore(store, positions, s.pull)
        for agent_log in self._logs.values():
            self._pulls.answers(agent_log.map.agent)
            self._pulls.note(agent_log, time.monotonic())
        self._thread.start()
        self._declared = [
            self._bus.subscribe(self._keys.changes(), self._hear, direct=True),
            self._bus.subscribe(self._keys.heads(), self._hear, direct=True),
            self._acks.serve(),
        ]

    def counters(self) -> IngestCounters:
        """Counters since the start, from any thread."""
        return replace(self._counters)

    def lags(self) -> dict[str, Lag]:
        """How far the store is behind each robot, by name; from any thread."""
        return self._logs.lags()

    @property
    def waiting(self) -> int:
        """Messages that wait for their turn."""
        return len(self._work)

    @property
    def failure(self) -> str:
        """Why the disk does not take changes at present; empty if it does."""
        return self.broken or self._failure or self._group.delay

    def follow(self, news: News) -> None:
        """Pass on what other servers have written to the store; from any thread, in the ingest's own."""
        self._work.put("", news, bounded=False)

    def remind(self, map_id: MapId) -> None:
        """Have a log acknowledged once more, from any thread, if all of it is settled and there is room.

        Returns at once.
        """
        reminder = Reminder(map_id)
        self._work.put(map_id.agent, reminder, replaces=lambda last: last == reminder)

    def close(self) -> None:
        """Stop listening; received changes are applied, missing ones will be pulled next time."""
        for declared in self._declared:
            declared.close()
        self._declared = []
        self._stopping = True
        self._work.interrupt()
        if self._thread.is_alive():
            self._thread.join()
        self._puller.close()

    def _hear(self, sample: Sample) -> None:
        """A message has come; in the bus's thread."""
        robot = robot_of(sample.key)

        def replaces(last: Sample | Pulled | PulledChanges | News | Reminder) -> bool:
            """A newer beacon of the same log says all that the one before it did."""
            return isinstance(last, Sample) and not last.attachment and last.key == sample.key

        newer = None if sample.attachment else replaces
        if not self._work.put(robot, sample, len(sample.payload), replaces=newer):
            self._quotas.hold_back(robot, "changes" if sample.attachment else "beacons")

    def _run(self) -> None:
        try:
            self._take_turns()
        except Exception as error:
            # Half a turn cannot be taken back here. What is on the disk is whole, and the next process reads
            # it; robots keep the rest.
            if not isinstance(error, MemoryError):
                log.exception("nothing is taken in any more")
            words = "not enough memory" if isinstance(error, MemoryError) else type(error).__name__
            self.broken = f"changes cannot be taken in any more ({words}); none that is acknowledged is lost"
            self.busy = False

    def _take_turns(self) -> None:
        while not self._stopping:
            now = time.monotonic()
            touched: dict[MapId, AgentLog] = {}
            turn = self._work.take(AT_ONE_TURN, self._pulls.due(now) - now)
            self.busy = True
            for robot, item in [(robot, item) for robot, items in turn for item in items]:
                if (agent_log := self._take(robot, item)) is not None:
                    touched[agent_log.map] = agent_log
            self._settle([run for one in touched.values() if (run := self._next_run(one)) is not None])
            for agent_log in touched.values():
                now = time.monotonic()
                if later := self._pieces.end(agent_log, now):
                    self._put_pulled(later)
                self._pulls.note(agent_log, now)
            self._counters.add(pulls=self._puller.start())
            self.busy = False

    def _take(self, robot: str, item: Sample | Pulled | PulledChanges | News | Reminder) -> AgentLog | None:
        """Process one item of the inbox. Returns the log that may go on now."""
        try:
            if isinstance(item, Pulled):
                return self._take_pulled(item)
            if isinstance(item, PulledChanges):
                return self._take_piece(item)
            if isinstance(item, News):
                self._follower.take(item)
                return None
            if isinstance(item, Reminder):
                reminded = self._logs.get(item.map)
                # What is not settled is acknowledged, or refused, anyway.
                if reminded is not None and reminded.newest <= reminded.watermark:
                    self._unaware.setdefault(item.map, (reminded, False))
                return None
            if item.attachment:
                return self._take_change(item)
            return self._take_head(item)
        except InvalidMessage as error:
            self._counters.add(damaged=1)
            self._intakes.of(robot).spend(1, 0)
            damaged = self._counters.damaged
            # Each power of two: a flood must not become a flood of log lines.
            if damaged & (damaged - 1) == 0:
                log.warning("%d invalid messages so far; the last: %s", damaged, error)
            return None

    def _take_change(self, sample: Sample) -> AgentLog | None:
        self._counters.add(messages=1, message_bytes=len(sample.payload))
        map_id = self._keys.parse_change(sample.key)
        mark = Mark.decode(sample.attachment)
        agent_log = self._log(map_id, mark.log_id)
        if agent_log is None:
            return None
        self._believe(agent_log, mark.sequence)
        intake = self._intakes.of(map_id.agent)
        if mark.sequence <= agent_log.watermark or mark.sequence in agent_log.ahead:
            self._counters.add(doubled=1)
            return agent_log if intake.repeat() else None
        in_turn = mark.sequence == agent_log.watermark + 1
        lacking = 1 if in_turn else agent_log.lacking
        if not intake.change(len(sample.payload), self._unmerged(map_id.agent), lacking):
            return agent_log
        fits = len(sample.payload) <= MAX_CHANGE_BYTES
        entry = ReceivedChange.read(map_id, mark.sequence, sample.payload if fits else b"")
        if isinstance(entry.change, str):
            self._counters.add(damaged=1)
            if (also := self._damages.count_of(map_id.agent)) is not None:
                log.info("%s %d came damaged (%s), pulling it%s", map_id, mark.sequence, entry.change, also)
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
        # More than there is: it was another store that had it, or this one is of a copy of before.
        if (had := head.acknowledged.get(self._name, 0)) != agent_log.watermark:
            self._compare_if_older(agent_log, had)
            # Behind the commit of this turn, which may be acknowledged anyway.
            self._unaware[agent_log.map] = agent_log, True
        return agent_log

    def _compare_if_older(self, agent_log: AgentLog, acknowledged: int) -> None:
        """Compare a log with its robot's if the robot knows this server to have had more of it."""
        if acknowledged <= max(agent_log.watermark, agent_log.claimed):
            return
        try:
            # A server that shares its store may be behind it.
            if self._store.watermark(agent_log.map) < acknowledged:
                self._store.doubt(agent_log.map, acknowledged)
                agent_log.unverified = self._store.unverified(agent_log.map)
        except InvalidFile as error:  # the next beacon says it once more
            self._commit_failed(agent_log, error)
            return
        agent_log.claimed = acknowledged

    def _take_pulled(self, pulled: Pulled) -> AgentLog | None:
        agent_log, first = pulled.log, pulled.asked.first
        piece, damaged = pulled.piece(self._damages)
        self._counters.add(pulled=len(piece.rows), damaged=damaged)
        self._intakes.of(agent_log.map.agent).spend(len(piece.rows), sum(len(row) for _, row in piece.rows))
        self._pulls.ends(agent_log.map.agent, answered=piece.covered >= first)
        if self._logs.get(agent_log.map) is not agent_log:
            return None
        if piece.covered < first:
            agent_log.pulled(time.monotonic(), gained=False)
        elif agent_log.was_damaged(first) or agent_log.is_unverified(first):
            agent_log.pulled(time.monotonic(), gained=True)
            self._recover(agent_log, first, piece)
        else:
            self._take_piece(piece)
        return agent_log

    def _take_piece(self, piece: PulledChanges) -> AgentLog | None:
        """Have some of the changes that were pulled committed in this turn."""
        if self._logs.get(piece.log.map) is not piece.log:
            return None
        self._pieces.put(piece)
        return piece.log

    def _next_run(self, agent_log: AgentLog) -> NextRun | None:
        """What may be committed of a log: what was pulled, and what follows it."""
        piece = self._pieces.now(agent_log)
        if piece is None:
            run = NextRun(agent_log, agent_log.next_run(agent_log.watermark))
        else:
            pulled = [ReceivedChange.read(agent_log.map, *row) for row in piece.rows]
            run = NextRun(agent_log, [*pulled, *agent_log.next_run(piece.covered)], piece.covered)
        if not run.entries and run.covered is None:
            return None
        objections = (self._objection(e.change.body) for e in run.entries if isinstance(e.change, Change))
        if reason := next(filter(None, objections), ""):
            agent_log.commit_failed(time.monotonic(), self._settings.retry_interval)
            self._acknowledge_unaware([agent_log])
            self._acks.refuse(agent_log.map, agent_log.log_id, reason)
            return None
        try:
            run = self._group.fitting(run)
        except InvalidFile as error:
            self._commit_failed(agent_log, error)
            return None
        if run.full is not None and not run.entries:
            self._rest(agent_log, run.full)
            return None
        return run

    def _settle(self, runs: Sequence[NextRun]) -> None:
        """Commit, pass on, acknowledge: in this order."""
        done: list[tuple[NextRun, list[float]]] = []
        for run, result in zip(runs, self._group.commit(runs) if runs else [], strict=True):
            try:
                if isinstance(result, MapweaveError):
                    raise result
                changes = tuple(unseen(self._store, run.log, result))
            except MapweaveError as error:
                # Nothing is lost: it is not acknowledged, so the agent keeps it and it is pulled later.
                self._commit_failed(run.log, error)
                continue
            self._failure = ""
            done.append((run, run.log.settled(result)))
            self._pulls.answers(run.log.map.agent)
            for refusal in result.refusals:
                if (also := self._refusals.count_of(run.log.map.agent)) is not None:
                    log.warning("refused %s %d: %s%s", run.log.map, refusal.sequence, refusal.reason, also)
                self._note_refusal(run.log.map, words_of(refusal))
            self._counters.add(applied=len(result.changes), refused=len(result.refusals))
            self._pass_on(changes)
        # Last: a robot may ask about its changes as soon as they are acknowledged.
        for run, received in done:
            self._unaware.pop(run.log.map, None)
            self._acks.acknowledge(run.log)
            for at in received:
                self._observe_ack(time.monotonic() - at)
            if run.full is not None:
                self._rest(run.log, run.full)
        self._acknowledge_unaware([agent_log for agent_log, _ in self._unaware.values()])

    def _acknowledge_unaware(self, logs: Iterable[AgentLog]) -> None:
        """Before a refusal, which an acknowledgement behind it would take back."""
        for agent_log in logs:
            if (unaware := self._unaware.pop(agent_log.map, None)) is not None:
                try:
                    self._acks.acknowledge(*unaware)
                except InvalidFile as error:  # the next beacon asks once more
                    self._commit_failed(agent_log, error)

    def _recover(self, agent_log: AgentLog, first: int, piece: PulledChanges) -> None:
        """Put damaged changes in their places again, or verify others, and pass on what that changes."""
        try:
            changes, restored = recover(self._store, agent_log, first, piece)
        except InvalidFile as error:
            self._commit_failed(agent_log, error)
            return
        self._failure = ""
        self._counters.add(restored=restored)
        self._pass_on(changes)

    def _log(self, map_id: MapId, log_id: int) -> AgentLog | None:
        """The log of this name, or None after notifying the agent that it is another's."""
        agent_log = self._logs.get(map_id)
        if agent_log is None and (reason := self._intakes.objection(map_id, self._logs)):
            self._quotas.hold_back(map_id.agent, "maps")
            self._acks.refuse(map_id, log_id, reason)
            return None
        if agent_log is None or (agent_log.log_id != log_id and agent_log.watermark == 0):
            unverified = agent_log.unverified if agent_log is not None else None
            agent_log = AgentLog(map_id, log_id, self._settings.pull)
            agent_log.unverified = unverified
            self._logs.add(agent_log)
        if agent_log.log_id == log_id:
            if forgotten := self._logs.heard(agent_log):
                self._pulls.forget(forgotten)
            return agent_log
        self._acks.refuse(map_id, log_id, f"another log goes by the name {map_id} here: begin a fresh map")
        return None

    def _believe(self, agent_log: AgentLog, newest: int) -> None:
        """Take note of a sequence number.

        Raises:
            InvalidMessage: no log is as long.
        """
        if newest > agent_log.watermark + MOST_AHEAD:
            reason = f"change {newest} is announced, where {agent_log.watermark} have come"
            self._note_disbelief(agent_log.map, reason)
            raise InvalidMessage(f"{agent_log.map}: {reason}")
        agent_log.announce(newest, time.monotonic())

    def _rest(self, agent_log: AgentLog, full: Full) -> None:
        """There is no room for more of a log now: it stays on the robot's disk."""
        self._acknowledge_unaware([agent_log])
        self._quotas.hold_back(agent_log.map.agent, full.what)
        agent_log.forget_ahead()
        agent_log.resting_until = time.monotonic() + QUOTA_PAUSE
        self._acks.refuse(agent_log.map, agent_log.log_id, full.reason, agent_log.watermark)

    def _commit_failed(self, agent_log: AgentLog, error: MapweaveError) -> None:
        agent_log.commit_failed(time.monotonic(), self._settings.retry_interval)
        self._counters.add(failures=1)
        if not logged(error) and str(error) != self._failure:
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

    def _put_pulled(self, pulled: Pulled | PulledChanges) -> None:
        """Something that was pulled waits for its robot's turn; from any thread."""
        self._work.put(pulled.log.map.agent, pulled, bounded=False)

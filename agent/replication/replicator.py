"""Carries an agent's changes to its disk and from there to the servers, beside the robot's loop.

The loop only hands changes over. One thread does the rest, in this order: commit to the journal, publish
best-effort, and let servers pull what got lost. Lossless is not the publishing but the
beacon, which tells servers how long the log is, and the log itself, which answers for any range. That goes
for every map in the journal: one that was left for a fresh map before a server had it is still handed over.
"""

import logging
import queue
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from mapweave.agent.replication.beacon_timer import RAREST, BeaconTimer
from mapweave.agent.replication.journal import Draft, Journal
from mapweave.agent.replication.log_state import LogState
from mapweave.hybridmap.agent_status import FIRST_STATUS_PERIOD
from mapweave.hybridmap.change import ChangeBody, NodeRetired
from mapweave.hybridmap.counted import counted
from mapweave.hybridmap.errors import InvalidFile, InvalidMessage, InvalidValue, MapweaveError
from mapweave.hybridmap.ids import MapId, NodeId, check_name
from mapweave.storage.full_disks import logged
from mapweave.wire.bus import Bus, Request, Sample
from mapweave.wire.codec import wrap_body
from mapweave.wire.dispatch import Failures
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import MAX_ROWS, Ack, LogAnswer, LogRequest, Mark, StoredChange

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ReplicationSettings:
    """How changes are carried.

    Attributes:
        beacon_interval: shortest time from a change to the beacon of a map of which servers lack something,
            s; see BeaconTimer.
        answer_bytes: a log answer ends after so many bytes, since a link may be slow.
        retry_interval: after a failed commit (disk full), s.
    """

    beacon_interval: float = 0.5
    answer_bytes: int = 1 << 20
    retry_interval: float = 1.0


@dataclass(frozen=True, slots=True)
class ReplicationStatus:
    """How far replication is, for the status line.

    Attributes:
        newest: sequence number of the newest committed change of the map that is being made.
        waiting: changes that are not yet on the own disk.
        unacknowledged: committed changes, of all maps, that are not on every required server's disk.
        refused: changes that a server has refused for good.
        failure: why nothing is committed or taken at present; empty if all is well.
    """

    newest: int
    waiting: int
    unacknowledged: int
    refused: int
    failure: str


COMPACTED = 1000
"""After so many further changes that servers have, what later ones undo is dropped from the disk."""
LOOK = 0.1
"""Between two looks whether a wait for acknowledgements is still worthwhile, s."""
MOST_AT_ONCE = 256
"""Messages that are taken before changes are committed again: a flood of them must not hold those up."""
MOST_WAITING = 4096
"""Messages of servers that wait for the thread; more of them are dropped, or refused."""
BUSY = 1.0
"""After this a question that was refused may be asked again, s."""


@dataclass(frozen=True, slots=True)
class _Retirement:
    """The retirement of nodes of a map that was left."""

    map: MapId
    drafts: Sequence[Draft]


class Replicator:
    """Replicates the logs of one agent; changes are added to one of them."""

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        journal: Journal,
        map_id: MapId,
        servers: Sequence[str] = (),
        settings: ReplicationSettings | None = None,
    ) -> None:
        """Start. The bus and the journal stay the caller's, and are closed after the replicator.

        Args:
            bus: the connection; may be down.
            keys: of the fleet.
            journal: where changes are committed.
            map_id: the map that is being made; it must be open.
            servers: which must have a change before it counts as acknowledged. Without any, one server that
                has acknowledged will do.
            settings: how.

        Raises:
            InvalidValue: the map was never opened, or a server's name is none.
        """
        self._bus = bus
        self._keys = keys
        self._journal = journal
        self._map = map_id
        self._servers = tuple(check_name(server) for server in servers)
        self._settings = settings or ReplicationSettings()
        self._changed = threading.Condition()
        self._current = LogState.of(journal, map_id)
        self._logs = {m: LogState.of(journal, m) for m in journal.maps()} | {map_id: self._current}
        self._submitted = 0
        self._committed = 0
        self._disk_failure = ""
        # Only the thread touches these.
        self._unnoted = False
        self._pending: list[Draft] = []
        self._retry_at = 0.0
        self._beacons = BeaconTimer(self._settings.beacon_interval)
        self._compacted = 0
        for state in self._logs.values():
            self._compact(state)
        self._work: queue.SimpleQueue[list[Draft] | _Retirement | Sample | Request | bool | None] = (
            queue.SimpleQueue()
        )
        self._failures = Failures()
        self._thread = threading.Thread(target=self._run, name=f"replicate-{map_id}", daemon=True)
        self._thread.start()
        self._declared = [
            bus.subscribe(keys.acks(map_id.agent), self._hear, direct=True),
            bus.serve(keys.logs(map_id.agent), self._take_question),
            bus.watch(keys.servers_alive(), self._see_server),
        ]

    @property
    def map_id(self) -> MapId:
        """The map whose changes are taken."""
        return self._map

    @property
    def shared(self) -> bool:
        """Whether any server has anything of the map whose changes are taken."""
        with self._changed:
            return any(self._current.acknowledged.values())

    @property
    def status_period(self) -> float:
        """The least time between two statuses that servers want now, s: they have many robots; else 0.

        `FIRST_STATUS_PERIOD` until one has acknowledged something.
        """
        return self._wanted_period(FIRST_STATUS_PERIOD)

    def submit(self, bodies: Iterable[ChangeBody], stamp_ns: int) -> None:
        """Hand over changes. Encodes them, and waits for neither disk nor network.

        Raises:
            InvalidValue: a change cannot be encoded or belongs to another map; none of them was taken.
        """
        drafts = [Draft.of(body, stamp_ns) for body in bodies]
        for draft in drafts:
            if draft.map != self._map:
                raise InvalidValue(f"a change of {draft.map} does not belong into the log of {self._map}")
        with self._changed:
            self._submitted += len(drafts)
            self._work.put(drafts)

    def retire(self, map_id: MapId, nodes: Iterable[NodeId], stamp_ns: int) -> None:
        """Have all nodes of a map that was left retired. Waits for neither disk nor network.

        Once its servers have that, the nodes are dropped from the disk.

        Raises:
            InvalidValue: the map is the one that is being made, or none of the journal's when this began.
        """
        if map_id == self._map or map_id not in self._logs:
            raise InvalidValue(f"map {map_id} was not left")
        self._work.put(_Retirement(map_id, [Draft.of(NodeRetired(node), stamp_ns) for node in nodes]))

    def flush(self, timeout: float) -> bool:
        """Wait until all that was submitted is on the own disk; False if the time is over first."""
        with self._changed:
            goal = self._submitted
            return self._changed.wait_for(lambda: self._committed >= goal, timeout)

    def wait_acknowledged(self, timeout: float, worthwhile: Callable[[], bool] = lambda: True) -> bool:
        """Wait until every map is on every required server's disk; False if the time is over first.

        Beacons do not wait for overdue acknowledgements meanwhile.

        Args:
            timeout: s.
            worthwhile: asked about ten times a second whether to wait on.
        """
        pause, now = self._settings.beacon_interval, time.monotonic()
        beacon, end = now + pause, now + timeout
        with self._changed:
            goal = self._submitted
            while not self._changed.wait_for(
                lambda: self._committed >= goal and self._unacknowledged() == 0,
                max(0.0, min(LOOK, beacon - now, end - now)),
            ):
                now = time.monotonic()
                if now >= end or not worthwhile():
                    return False
                if now >= beacon:
                    self._work.put(False)
                    pause = min(2 * pause, RAREST * self._settings.beacon_interval)
                    beacon = now + pause
        return True

    def status(self) -> ReplicationStatus:
        """Where things stand."""
        with self._changed:
            return ReplicationStatus(
                newest=self._current.newest,
                waiting=self._submitted - self._committed,
                unacknowledged=self._unacknowledged(),
                refused=sum(len(state.refusals) for state in self._logs.values()),
                failure=self._disk_failure or self._current.failure,
            )

    def unacknowledged(self) -> int:
        """Changes that were submitted and are not yet on every required server's disk."""
        with self._changed:
            return self._unacknowledged() + self._submitted - self._committed

    def refusals(self) -> dict[tuple[str, int], str]:
        """What servers have refused for good of the map that is being made: (server, sequence) to reason."""
        with self._changed:
            return dict(self._current.refusals)

    def close(self) -> None:
        """Commit what was submitted and stop. Idempotent."""
        for declared in self._declared:
            declared.close()
        self._work.put(None)
        self._thread.join()

    def _unacknowledged(self) -> int:
        # One that no server takes any more is not waited for, once it was left.
        waits = [one for one in self._logs.values() if one is self._current or not one.put_back]
        return sum(state.unsettled(self._servers) for state in waits)

    def _wanted_period(self, unknown: float) -> float:
        """The longest status period that a server wants; `unknown` as long as none has said it."""
        with self._changed:
            return max(self._current.status_periods.values(), default=unknown)

    def _run(self) -> None:
        stop = False
        while not stop:
            questions: list[Request] = []
            try:
                for count in range(MOST_AT_ONCE):
                    left = max(0.0, self._next_turn() - time.monotonic())
                    item = self._work.get_nowait() if count else self._work.get(timeout=left)
                    if item is None:
                        stop = True
                    elif isinstance(item, list):
                        self._pending += item
                    elif isinstance(item, _Retirement):
                        self._retire(item)
                    elif isinstance(item, Sample):
                        self._take_ack(item)
                    elif isinstance(item, bool):
                        (self._beacons.server_came if item else self._beacons.hasten)(time.monotonic())
                    else:
                        questions.append(item)
            except queue.Empty:
                pass
            now = time.monotonic()
            if self._pending and (stop or now >= self._retry_at):
                self._commit()
            for question in questions:
                self._answer(question)
            if now >= self._beacons.due:
                self._send_beacons(now)
        if self._pending:
            log.error("%s: %d changes never reached the disk", self._map, len(self._pending))

    def _hear(self, sample: Sample) -> None:
        if self._has_room():
            self._work.put(sample)

    def _take_question(self, question: Request) -> None:
        if self._has_room():
            self._work.put(question)
        else:
            question.refuse(f"{self._map.agent} is asked too much at once", BUSY)

    def _see_server(self, key: str, alive: bool) -> None:
        del key
        if alive and self._has_room():
            self._work.put(True)

    def _has_room(self) -> bool:
        """Whether messages may wait; what is lost of them, servers send after the next beacon."""
        return self._work.qsize() < MOST_WAITING

    def _next_turn(self) -> float:
        return min(self._beacons.due, self._retry_at) if self._pending else self._beacons.due

    def _commit(self) -> None:
        """Disk first, then the network: a change that was sent is safe."""
        drafts, self._pending = self._pending, []
        try:
            first = self._journal.write(self._map, drafts)
        except InvalidFile as error:
            # A full disk can be emptied: keep the changes and try again, and log it once.
            self._pending = drafts
            self._retry_at = time.monotonic() + self._settings.retry_interval
            with self._changed:
                if not logged(error) and not self._disk_failure and not self._unnoted:
                    log.error("%s; %s in memory", error, counted(len(drafts), "change"))
                self._disk_failure = str(error)
            return
        with self._changed:
            self._current.newest = first + len(drafts) - 1
            self._committed += len(drafts)
            self._disk_failure = ""
            self._changed.notify_all()
        self._publish(self._current, first, drafts)

    def _retire(self, retirement: _Retirement) -> None:
        state = self._logs[retirement.map]
        try:
            first = self._journal.write(retirement.map, retirement.drafts)
        except InvalidFile as error:
            # The nodes only take more room until they are asked about again.
            if not logged(error):
                log.warning("%s", error)
            return
        with self._changed:
            state.newest = first + len(retirement.drafts) - 1
        self._publish(state, first, retirement.drafts)

    def _publish(self, state: LogState, first: int, drafts: Sequence[Draft]) -> None:
        if not state.compared:
            # Published, they might follow others of the same numbers unnoticed. Who asks for them shows which
            # change it has before them.
            self._beacons.hasten(time.monotonic())
            return
        if state is self._current:
            self._beacons.published(first, time.monotonic())
        self._beacons.changed(time.monotonic())
        if state.put_back:
            return
        leaves = self._bus.connected()
        for sequence, draft in enumerate(drafts, start=first):
            change = wrap_body(sequence, draft.stamp_ns, draft.encoded)
            self._bus.publish(self._keys.change(state.map), change, Mark(sequence, state.log_id).encode())
        if leaves or self._bus.connected():
            state.sent.add(first, first + len(drafts) - 1)

    def _send_beacons(self, now: float) -> None:
        everyone = self._beacons.all_due(now, self._wanted_period(0.0))
        unsettled = False
        for state in self._logs.values():
            lacking = state.unsettled(self._servers) > 0 and not state.put_back
            unsettled |= lacking
            if (everyone or lacking) and not state.put_back:
                self._bus.publish(self._keys.head(state.map), state.head().encode())
        self._beacons.sent(now, unsettled)

    def _take_ack(self, sample: Sample) -> None:
        try:
            server, _ = self._keys.parse_ack(sample.key)
            ack = Ack.decode(sample.payload)
        except InvalidMessage as error:
            if (also := self._failures.count(sample.key)) is not None:
                log.warning("%s%s", error, also)
            return
        state = self._logs.get(ack.map)
        if state is None or ack.log_id != state.log_id or state.outdated(server, ack):
            return
        if server not in self._servers and not state.admits(server):
            return
        try:
            contradicted = self._contradicts(state, ack.stored)
        except InvalidFile as error:
            # Nothing is acknowledged by what cannot be compared: the next beacon asks again.
            if not logged(error):
                log.warning("%s", error)
            return
        with self._changed:
            news = state.take(server, ack)
            lost = state.lost(server, ack)
        for line in news:
            log.warning("%s", line)
        # New changes have numbers that the server has seen, and it drops them as doubles.
        if contradicted or ack.watermark > state.sent.whole:
            self._note_put_back(state, server)
        if state.put_back:
            return
        state.compared |= ack.stored is not None
        if lost:
            # It is to know how much it had: what was retired meanwhile may have been dropped here.
            self._bus.publish(self._keys.head(state.map), state.head().encode())
            if (also := self._failures.count_of(server)) is not None:
                words = "%s has lost what it had of %s after %d: it gets it again%s"
                log.warning(words, server, state.map, ack.watermark, also)
        elif not state.acknowledged.get(server, 0) < ack.watermark <= state.newest:
            return
        servers = [server, *self._sharing(server, ack)]
        try:
            for name in servers:
                self._journal.acknowledge(name, state.map, ack.watermark, reset=lost and name == server)
        except InvalidFile as error:
            # The server sends it again, because the next beacon shows that it was not noted; a full disk is
            # one line meanwhile.
            if not logged(error) and not self._unnoted and not self._disk_failure:
                log.error("%s", error)
            self._unnoted = True
            return
        except MapweaveError as error:
            log.warning("%s", error)
            return
        self._unnoted = False
        with self._changed:
            state.acknowledged |= {
                name: ack.watermark
                for name in servers
                if name == server or ack.watermark > state.acknowledged.get(name, 0)
            }
            self._changed.notify_all()
        if state is self._current and state.settled(self._servers) - self._compacted >= COMPACTED:
            self._compact(state)
        if state is not self._current and not state.unsettled(self._servers):
            # Nothing but retirements is added to a map that was left.
            self._compact(state)
        if state is self._current:
            self._beacons.settled(state.settled(self._servers), time.monotonic())
        if state.unsettled(self._servers):
            self._beacons.some_settled(time.monotonic())

    def _contradicts(self, state: LogState, stored: StoredChange | None) -> bool:
        return stored is not None and self._journal.contradicts(state.map, stored)

    def _note_put_back(self, state: LogState, server: str) -> None:
        """A server has changes that this disk has lost: all that is here may have left by the next start."""
        with self._changed:
            if not state.lost_changes(server):
                return
        log.warning("%s", state.failure)
        try:
            self._journal.note_put_back(state.map)
        except InvalidFile as error:
            if not logged(error):
                log.error("%s", error)

    def _compact(self, state: LogState) -> None:
        """Drop from the disk what later changes of a log undo."""
        if state is self._current:
            self._compacted = state.settled(self._servers)
        try:
            self._journal.prune(state.map, self._servers)
        except InvalidFile as error:
            # It only takes more room until the next time.
            if not logged(error):
                log.warning("%s", error)

    def _sharing(self, server: str, ack: Ack) -> list[str]:
        """Other servers with the same store: what one acknowledges, all of them have.

        As far as they are known: each has acknowledged something since this program began.
        """
        known = {
            name
            for state in self._logs.values()
            for name, store in state.stores.items()
            if store == ack.store
        }
        return sorted(known - {server}) if ack.store else []

    def _answer(self, question: Request) -> None:
        try:
            asked = LogRequest.decode(question.payload)
            state = self._logs.get(self._keys.parse_log(question.key))
            if state is None:
                raise InvalidMessage(f"{question.key}: no such log")
            if self._contradicts(state, asked.stored):
                self._note_put_back(state, "a server")
            if state.put_back or asked.first > state.sent.whole + 1:
                # Who has all before that has it from a disk of before; its acknowledgement is awaited.
                raise InvalidMessage(f"{question.key}: this disk has other changes before {asked.first}")
            last = min(asked.last, asked.first + MAX_ROWS - 1, state.newest)
            rows = self._journal.rows(state.map, asked.first, last)
        except MapweaveError as error:
            question.refuse(str(error))
            return
        state.compared = True
        if state is self._current:
            self._beacons.asked_for(asked.first, last)
        total = 0
        for count, (_, change) in enumerate(rows):
            total += len(change)
            if total > self._settings.answer_bytes and count > 0:
                # The last one that fits is how far the answer reaches.
                rows, last = rows[:count], rows[count - 1][0]
                break
        answer = LogAnswer(state.log_id, asked.first, max(last, asked.first - 1), tuple(rows))
        if last >= asked.first:
            state.sent.add(asked.first, last)
        question.reply(answer.encode())

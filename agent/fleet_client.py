"""A robot's link to its fleet: status out, missions in, questions asked without waiting."""

import logging
import math
import queue
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from mapweave.agent.mission import AnswerContent, Driven, Question, ServerAnswer, WhereAmI, WhoIsNear
from mapweave.agent.mission_control import MissionControl
from mapweave.agent.replication.queries import best, decode_answer, encode_query, settles
from mapweave.agent.teleoperation import Teleoperation
from mapweave.hybridmap.agent_status import AgentStatus, Status, one_line
from mapweave.hybridmap.drive_request import DriveAnswer, DriveRequest
from mapweave.hybridmap.errors import InvalidValue, MapweaveError
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.mission_order import MissionOrder
from mapweave.hybridmap.portal import PortalDone
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import RelocalizeAnswer
from mapweave.wire.bus import Bus, BusClient, Reply, Request
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import encode_record
from mapweave.wire.messages import decode, encode
from mapweave.wire.patience import BusyServers
from mapweave.wire.senders import serve_senders
from mapweave.wire.traffic_meter import TrafficMeter

log = logging.getLogger(__name__)


class Trouble(NamedTuple):
    """A kind of question that has no answer.

    Attributes:
        words: the newest reason.
        since: when it began, on the monotonic clock, s.
        unheard: whether no server has answered at all; else one has refused.
    """

    words: str
    since: float
    unheard: bool


class Troubles:
    """What holds at present, by kind of question; beginnings and ends are logged. Thread-safe.

    A trouble ends with the next answer to a question of its kind. That no server answers also ends with any
    answer, and when a server comes. All end with the mission in which the robot asked.
    """

    def __init__(self) -> None:
        """Begin without any."""
        self._turn = threading.Lock()
        self._holding: dict[type[Question], Trouble] = {}
        self._mission: object = None

    def begin(self, question: type[Question], words: str, unheard: bool) -> None:
        """A question has no answer.

        Args:
            question: its kind.
            words: why.
            unheard: whether no server has answered at all.
        """
        words, now = one_line(words), time.monotonic()
        with self._turn:
            before = self._holding.pop(question, None)
            self._holding[question] = Trouble(words, now if before is None else before.since, unheard)
        if before is None or before.unheard is not unheard:
            log.warning("a question to the fleet has no answer: %s", words)

    def answered(self, question: type[Question]) -> None:
        """A question of this kind has an answer."""
        self._end([kind for kind, one in self._holding.copy().items() if kind is question or one.unheard])

    def server_is_there(self) -> None:
        """A server has come."""
        self._end([kind for kind, one in self._holding.copy().items() if one.unheard])

    def mission(self, holding: object) -> None:
        """Another mission holds than before, or its state is another one: what was asked for it is over.

        Args:
            holding: compares equal while nothing changes.
        """
        if holding != self._mission:
            self._mission = holding
            self._end([*self._holding.copy()])

    def newest(self) -> tuple[str, float]:
        """What holds, in words, and for how long, s; empty and 0 without any. Of several the newest."""
        with self._turn:
            if not self._holding:
                return "", 0.0
            trouble = [*self._holding.values()][-1]
        return trouble.words, time.monotonic() - trouble.since

    def _end(self, kinds: list[type[Question]]) -> None:
        now = time.monotonic()
        with self._turn:
            over = [one for kind in kinds if (one := self._holding.pop(kind, None)) is not None]
        for one in over:
            log.info("over after %.0f s: %s", now - one.since, one.words)


NO_REPORT = "the robot's base reports nothing"
NO_ANSWER = "no map server answered"
FAILED = "failed"
"""In place of the certainty of an answer."""
FAILOVER = 1.0
"""s behind the loss of a server or router in which a question without an answer is asked again: a session is
at the next router in some 10 ms, and routers that lose one find another way between them in 0.1 s."""
ASK_AGAIN = 0.05
"""s before that."""


class FleetClient(BusClient):
    """Runs beside the robot's loop, which never waits for it unless it asks to.

    Attributes:
        asked: questions that were sent, by their type.
        relocalized: answers where a view was taken, by certainty; `failed` where none came.
    """

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        map_id: MapId,
        missions: MissionControl,
        answer_timeout: float = 3.0,
        unsent: Callable[[], int] = lambda: 0,
        placed: Callable[[], int] = lambda: 0,
        teleoperation: Teleoperation | None = None,
        limits: tuple[float, float] = (0.0, 0.0),
        failure: Callable[[], str] = lambda: "",
    ) -> None:
        """Announce the agent and listen for missions.

        Args:
            bus: the connection.
            keys: of the fleet.
            map_id: the map that the agent makes.
            missions: takes orders.
            answer_timeout: how long a question may take, s.
            unsent: counts the changes that it has not acknowledged; called from any thread.
            placed: counts the nodes of the map with a merged pose; likewise.
            teleoperation: takes the commands of a person who drives; it outlives this map.
            limits: of the robot's speeds, m/s and rad/s, for that person.
            failure: why nothing is saved or taken at present, empty if all is well; called from any thread.
        """
        self._bus = bus
        self._keys = keys
        self._map = map_id
        self._agent = map_id.agent
        self._servers: set[str] = set()
        self._server_lost_at = -math.inf
        self._status = Status("starting", "nothing sensed yet", 0, 0, Pose2(), False)
        self._stamp_ns = self._skipped = 0
        self._battery: float | None = None
        self._silent, self._silent_since = "", math.inf
        self._troubles = Troubles()
        self._missions = missions
        self._unsent, self._placed, self._failure = unsent, placed, failure
        self._timeout = answer_timeout
        self._teleoperation, self._limits = teleoperation or Teleoperation(), limits
        self._asked: queue.SimpleQueue[Question | None] = queue.SimpleQueue()
        self._answered: queue.SimpleQueue[ServerAnswer] = queue.SimpleQueue()
        self._open_questions = 0
        self.asked: Counter[type[Question]] = Counter()
        self.relocalized: Counter[str] = Counter()
        self._closing = [
            *serve_senders(bus, keys.mission(map_id.agent), self._take_mission),
            *serve_senders(bus, keys.drive(map_id.agent), self._take_drive),
            *serve_senders(bus, keys.portal(map_id.agent), self._take_portal),
            bus.serve(keys.agent_status(map_id.agent), self._tell_status),
            bus.watch(keys.servers_alive(), self._see_server),
            bus.announce(keys.agent_alive(map_id)),
        ]
        self._asker = threading.Thread(target=self._ask_all, name="questions", daemon=True)
        self._asker.start()

    def driven(self) -> Driven | None:
        """The command of a person who drives the robot now; None if no one does."""
        return self._teleoperation.driven()

    def server_in_reach(self) -> bool:
        """Whether a map server is known to be reachable in both directions."""
        return bool(self._servers) and self._bus.connected()

    def report(
        self,
        status: Status,
        stamp_ns: int,
        battery: float | None = None,
        publish: bool = True,
        skipped: int = 0,
        silent: str = "",
    ) -> None:
        """Publish the robot's status: on request and, best effort, to subscribers.

        Args:
            status: of the pipeline.
            stamp_ns: time of the observation that it describes.
            battery: charge, as a share, if it is known.
            publish: send it now; else only answer questions with it.
            skipped: images that were skipped so far.
            silent: why the robot's base does not answer; empty while it does.
        """
        self._status, self._silent, self._silent_since = status, silent, math.inf
        self._stamp_ns, self._battery, self._skipped = stamp_ns, battery, skipped
        mission = self._missions.report
        self._troubles.mission(None if mission is None else (mission.order.id, mission.state))
        if publish:
            self._bus.publish(self._keys.agent_status(self._agent), encode(self.status()))

    def base_silent(self, seconds: float) -> None:
        """Publish that the base has not reported for some time, s, while the loop waits for it.

        The status is that of its last report. Over with the next `report`; called from any thread.
        """
        self._silent_since = time.monotonic() - seconds
        self._bus.publish(self._keys.agent_status(self._agent), encode(self.status()))

    def stands(self, why: str) -> None:
        """Publish that the robot stands, and why, while nothing is sensed: the status of before is old."""
        self._status = replace(self._status, doing="standing", detail=why, located=False)
        self._bus.publish(self._keys.agent_status(self._agent), encode(self.status()))

    def ask(self, question: Question) -> None:
        """Send a question; its answer comes with a later `answers`."""
        self._open_questions += 1
        self.asked[type(question)] += 1
        self._asked.put(question)

    def answers(self, wait: bool = False) -> tuple[ServerAnswer, ...]:
        """Answers that have come.

        Args:
            wait: until every question has its answer or its time is over. A simulation in lock-step waits,
                so that its result does not depend on the machine's speed; a robot never does.
        """
        out: list[ServerAnswer] = []
        while self._open_questions and (wait or not self._answered.empty()):
            out.append(self._answered.get())
            self._open_questions -= 1
        return tuple(out)

    def close(self) -> None:
        """Withdraw from the fleet."""
        self._asked.put(None)
        super().close()
        self._asker.join(self._timeout + 1.0)

    def status(self) -> AgentStatus:
        """The status as others receive it; from any thread."""
        traffic = self._bus.traffic if isinstance(self._bus, TrafficMeter) else 0
        # What fails now comes before a question that once had no answer, and first what the robot drives by.
        silent = max(time.monotonic() - self._silent_since, 0.0)
        failure = one_line(NO_REPORT if silent else self._silent or self._failure())
        trouble, age = (failure, silent) if failure else self._troubles.newest()
        status = self._status
        return AgentStatus(
            replace(status, doing=one_line(status.doing), detail=one_line(status.detail)),
            self._stamp_ns,
            self._agent,
            self._map.epoch,
            self._unsent(),
            traffic,
            self.server_in_reach(),
            self._placed(),
            self._missions.report,
            self._battery,
            trouble,
            age,
            self._skipped,
            self._teleoperation.drive,
        )

    def _tell_status(self, request: Request) -> None:
        request.reply(encode(self.status()))

    def _see_server(self, key: str, alive: bool) -> None:
        if alive:
            self._servers.add(key)
            self._troubles.server_is_there()
        else:
            self._servers.discard(key)
            self._server_lost_at = time.monotonic()

    def _take_mission(self, request: Request, who: str) -> None:
        order = decode(request.payload, MissionOrder)
        report = self._missions.take(replace(order, by=who or order.by))
        # A mission ends the wait for a person who has fallen silent.
        self._teleoperation.release()
        request.reply(encode(report))

    def _take_portal(self, request: Request, who: str) -> None:
        try:
            done = decode(request.payload, PortalDone)
            request.reply(encode_record({"said": self._missions.portal_done(who or done.by)}))
        except MapweaveError as refused:
            request.refuse(str(refused))

    def _take_drive(self, request: Request, who: str) -> None:
        asked = decode(request.payload, DriveRequest)
        answer_ns = self._teleoperation.take(replace(asked, by=who or asked.by))
        request.reply(encode(DriveAnswer(self.status(), answer_ns, *self._limits)))

    def _ask_all(self) -> None:
        while (question := self._asked.get()) is not None:
            answer = self._answer(question)
            if isinstance(question, WhereAmI):
                where = answer.content
                outcome = str(where.certainty) if isinstance(where, RelocalizeAnswer) else FAILED
                self.relocalized[outcome] += 1
            self._answered.put(answer)

    def _answer(self, question: Question) -> ServerAnswer:
        # An older server does not answer that: the robot maps as without one.
        optional = isinstance(question, WhoIsNear)
        if optional and not self.server_in_reach():
            return ServerAnswer(question.number, None, NO_ANSWER)
        try:
            key, payload = encode_query(self._keys, question, self._agent)
        except InvalidValue as unspeakable:
            return ServerAnswer(question.number, None, str(unspeakable))
        answers: list[AnswerContent] = []
        error, retry_after = NO_ANSWER, 0.0

        def enough(reply: Reply) -> bool:
            nonlocal error, retry_after
            if reply.error:
                error, retry_after = reply.error, reply.retry_after or retry_after
                return False
            try:
                answers.append(decode_answer(question, reply.payload))
            except MapweaveError as refused:
                error = str(refused)
                return False
            return settles(answers[-1])

        end = time.monotonic() + self._timeout
        servers = BusyServers(self._bus, key, payload, enough)
        while not servers.ask(max(end - time.monotonic(), ASK_AGAIN)):
            # No reply: a server or router may have died with the question. Without any it is not repeated.
            now = time.monotonic()
            if optional or now >= end or not (self._servers or now - self._server_lost_at < FAILOVER):
                break
            time.sleep(ASK_AGAIN)
        if answers:
            self._troubles.answered(type(question))
            return ServerAnswer(question.number, best(answers))
        if not optional:
            self._troubles.begin(type(question), error, error == NO_ANSWER)
        return ServerAnswer(question.number, None, error, retry_after)

"""A robot's link to its fleet: changes and status out, missions in, questions asked without waiting."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable

from mapweave.agent.mission import Answer, Carried, Driven, Explore, GoTo, Idle, Mission, Question
from mapweave.agent.pipeline import Status
from mapweave.agent.replication.queries import decode_answer, encode_query
from mapweave.agent.status_message import AgentStatus, DriveAnswer, encode_agent_status, encode_drive_answer
from mapweave.agent.teleoperation import DriveRequest, Teleoperation
from mapweave.hybridmap.errors import InvalidMessage, InvalidValue, MapweaveError
from mapweave.hybridmap.node import MapId, NodeId
from mapweave.hybridmap.pose import Pose2
from mapweave.wire.bus import Bus, Request
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import decode_record, encode_record
from mapweave.wire.traffic_meter import TrafficMeter

NO_ANSWER = "no map server answered"


def encode_mission(mission: Mission) -> bytes:
    """An operator's command as a message."""
    name = type(mission).__name__.lower()
    node = str(mission.node) if isinstance(mission, GoTo) else ""
    return encode_record({"mission": name, "node": node})


def decode_mission(payload: bytes) -> Mission:
    """Read an operator's command.

    Raises:
        InvalidMessage: it is not a command.
    """
    message = decode_record(payload)
    name, node = str(message.get("mission", "")), str(message.get("node", ""))
    plain: dict[str, Mission] = {"idle": Idle(), "explore": Explore(), "carried": Carried()}
    if name in plain:
        return plain[name]
    if name == "goto":
        try:
            return GoTo(NodeId.parse(node))
        except InvalidValue as error:
            raise InvalidMessage(str(error)) from None
    raise InvalidMessage(f"no mission {name!r}; known are idle, explore, carried and goto")


class FleetClient:
    """Runs beside the robot's loop, which never waits for it unless it asks to."""

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        map_id: MapId,
        answer_timeout: float = 3.0,
        server: str = "s0",
        unsent: Callable[[], int] = lambda: 0,
        placed: Callable[[], int] = lambda: 0,
        teleoperation: Teleoperation | None = None,
        limits: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Announce the agent and listen for missions.

        Args:
            bus: the connection.
            keys: of the fleet.
            map_id: the map that the agent makes.
            answer_timeout: how long a question may take, s.
            server: the map server of `server_in_reach`.
            unsent: counts the changes that it has not acknowledged; called from any thread.
            placed: counts the nodes of the map with a merged pose; likewise.
            teleoperation: takes the commands of a person who drives; it outlives this map.
            limits: of the robot's speeds, m/s and rad/s, for that person.
        """
        self._bus = bus
        self._keys = keys
        self._map = map_id
        self._agent = map_id.agent
        self._server = server
        self._server_alive = False
        self._status = Status("starting", "nothing sensed yet", 0, 0, Pose2(), False)
        self._stamp_ns = 0
        self._unsent, self._placed = unsent, placed
        self._timeout = answer_timeout
        self._teleoperation, self._limits = teleoperation or Teleoperation(), limits
        self._missions: queue.SimpleQueue[Mission] = queue.SimpleQueue()
        self._asked: queue.SimpleQueue[Question | None] = queue.SimpleQueue()
        self._answered: queue.SimpleQueue[Answer] = queue.SimpleQueue()
        self._open_questions = 0
        self._closing = [
            bus.serve(keys.mission(map_id.agent), self._take_mission),
            bus.serve(keys.drive(map_id.agent), self._take_drive),
            bus.serve(keys.agent_status(map_id.agent), self._tell_status),
            bus.watch(keys.server_alive(server), self._see_server),
            bus.announce(keys.agent_alive(map_id)),
        ]
        self._asker = threading.Thread(target=self._ask_all, name="questions", daemon=True)
        self._asker.start()

    def missions(self) -> list[Mission]:
        """Commands that came since the last call."""
        out: list[Mission] = []
        while not self._missions.empty():
            out.append(self._missions.get())
        return out

    def driven(self) -> Driven | None:
        """The command of a person who drives the robot now; None where nobody does."""
        return self._teleoperation.driven()

    def server_in_reach(self) -> bool:
        """Whether the map server is known to be reachable in both directions."""
        return self._server_alive and self._bus.connected()

    def report(self, status: Status, stamp_ns: int, publish: bool = True) -> None:
        """Publish the robot's status: on request and, best effort, to subscribers.

        Args:
            status: of the pipeline.
            stamp_ns: time of the observation that it describes.
            publish: send it now; else only answer questions with it.
        """
        self._status, self._stamp_ns = status, stamp_ns
        if publish:
            self._bus.publish(self._keys.agent_status(self._agent), encode_agent_status(self._now()))

    def ask(self, question: Question) -> None:
        """Send a question; its answer comes with a later `answers`."""
        self._open_questions += 1
        self._asked.put(question)

    def answers(self, wait: bool = False) -> tuple[Answer, ...]:
        """Answers that have come.

        Args:
            wait: until every question has its answer or its time is over. A simulation in lock-step waits,
                so that its result does not depend on the machine's speed; a robot never does.
        """
        out: list[Answer] = []
        while self._open_questions and (wait or not self._answered.empty()):
            out.append(self._answered.get())
            self._open_questions -= 1
        return tuple(out)

    def close(self) -> None:
        """Withdraw from the fleet."""
        self._asked.put(None)
        for closing in self._closing:
            closing.close()
        self._asker.join(self._timeout + 1.0)

    def _now(self) -> AgentStatus:
        traffic = self._bus.traffic if isinstance(self._bus, TrafficMeter) else 0
        return AgentStatus(
            self._status,
            self._stamp_ns,
            self._map.epoch,
            self._unsent(),
            traffic,
            self.server_in_reach(),
            self._placed(),
        )

    def _tell_status(self, request: Request) -> None:
        request.reply(encode_agent_status(self._now()))

    def _see_server(self, key: str, alive: bool) -> None:
        del key
        self._server_alive = alive

    def _take_mission(self, request: Request) -> None:
        mission = decode_mission(request.payload)
        self._missions.put(mission)
        # A mission ends the wait for a person who has fallen silent.
        self._teleoperation.release()
        request.reply(b"ok")

    def _take_drive(self, request: Request) -> None:
        answer_ns = self._teleoperation.take(DriveRequest.decode(request.payload))
        request.reply(encode_drive_answer(DriveAnswer(self._now(), answer_ns, *self._limits)))

    def _ask_all(self) -> None:
        while (question := self._asked.get()) is not None:
            self._answered.put(self._answer(question))

    def _answer(self, question: Question) -> Answer:
        try:
            key, payload = encode_query(self._keys, question)
        except InvalidValue as unspeakable:
            return Answer(question.number, None, str(unspeakable))
        replies = self._bus.ask(key, payload, self._timeout)
        error, retry_after = NO_ANSWER if not replies else "", 0.0
        for reply in replies:
            if reply.error:
                error, retry_after = reply.error, reply.retry_after or retry_after
                continue
            try:
                return Answer(question.number, decode_answer(question, reply.payload))
            except MapweaveError as refused:
                error = str(refused)
        return Answer(question.number, None, error, retry_after)

"""The link to the fleet: missions, status, and questions that may stay without an answer."""

import threading
import time
from collections.abc import Iterator

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave.agent.fleet_client import NO_ANSWER, FleetClient
from mapweave.agent.mission import (
    MayIDrive,
    Question,
    ServerAnswer,
    WhatIsKnown,
    WhereAmI,
    WhichWay,
    WhoIsNear,
)
from mapweave.agent.mission_control import MissionControl
from mapweave.hybridmap.agent_status import MAX_STATUS_WORDS, AgentStatus, Status
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.mission_order import MissionKind, MissionOrder, MissionReport, MissionState
from mapweave.hybridmap.nearby import NearbyAnswer, NearbyRequest
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import (
    MAX_BLOCKED,
    Certainty,
    KnownAnswer,
    KnownRequest,
    RelocalizeAnswer,
    ReserveAnswer,
    RouteAnswer,
    RouteRequest,
    View,
)
from mapweave.wire.bus import Request
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.messages import decode, decode_view, encode
from mapweave.wire.senders import sent_by_any
from mapweave.wire.traffic_meter import TrafficMeter
from tests.waiting import eventually

KEYS = Keys("fleet")
MAP = MapId("r0", 1)
HERE, THERE = NodeId("r0", 1, 3), NodeId("r1", 1, 9)
VIEW = View(
    np.array([[10.0, 20.0], [30.0, 40.0]], np.float32),
    np.arange(64, dtype=np.uint8).reshape(2, 32),
    Camera(320, 240, 277.0, 277.0, 159.5, 119.5, 0.3),
)


@pytest.fixture
def other(hub: MemoryHub) -> Iterator[MemoryBus]:
    """The rest of the fleet."""
    bus = MemoryBus(hub)
    yield bus
    bus.close()


@pytest.fixture
def link(hub: MemoryHub) -> Iterator[FleetClient]:
    bus = MemoryBus(hub)
    link = FleetClient(bus, KEYS, MAP, MissionControl("r0"), answer_timeout=20.0)
    yield link
    link.close()
    bus.close()


def test_an_order_is_acknowledged_and_reported(link: FleetClient, other: MemoryBus):
    order = MissionOrder("a1", "r0", MissionKind.GO, 7, "anna", THERE)
    for _ in range(2):
        (reply,) = other.ask(KEYS.mission("r0"), encode(order), 2.0)
        assert decode(reply.payload, MissionReport) == MissionReport(order, MissionState.RUNNING)
    (reply,) = other.ask(KEYS.agent_status("r0"), b"", 2.0)
    assert decode(reply.payload, AgentStatus).mission == MissionReport(order, MissionState.RUNNING)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"kind": "fly"}, "Invalid enum value 'fly'"),
        ({"kind": "go"}, "give node"),
        ({"node": ["r0", 1, 2]}, "takes no node"),
        ({"stamp_ns": -1}, "stamp_ns"),
        ({"id": "No Name"}, "id"),
        ({"robot": "r1"}, "a mission of r1 came to r0"),
    ],
)
def test_invalid_orders_are_refused_without_effect(
    link: FleetClient, other: MemoryBus, change: dict[str, object], said: str
):
    fields = msgpack.unpackb(encode(MissionOrder("a1", "r0", MissionKind.STOP, 7, "anna")))
    (reply,) = other.ask(KEYS.mission("r0"), msgpack.packb(fields | change), 2.0)
    assert said in reply.error
    (reply,) = other.ask(KEYS.agent_status("r0"), b"", 2.0)
    assert decode(reply.payload, AgentStatus).mission is None


def test_the_fleet_receives_the_robots_status(link: FleetClient, other: MemoryBus):
    received: list[AgentStatus] = []
    other.subscribe(
        KEYS.agent_statuses(), lambda sample: received.append(decode(sample.payload, AgentStatus))
    )
    status = Status("turning", "why", 3, 40, Pose2(1, 2, 3), False, "goto", THERE, Pose2(0.1, 0, 0), 4)
    link.report(status, 123)
    eventually(lambda: received == [AgentStatus(status, 123, "r0", MAP.epoch)])


@given(st.text(), st.integers(1, 400))
def test_any_status_can_be_sent(text: str, times: int):
    """A status quotes servers and drivers: line breaks and long texts must not end the robot's loop."""
    bus = MemoryBus(MemoryHub())
    link = FleetClient(bus, KEYS, MAP, MissionControl("r0"))
    link.report(Status("looking", text * times, 0, 0, Pose2(), False), 0)
    (reply,) = bus.ask(KEYS.agent_status("r0"), b"", 2.0)
    message = decode(reply.payload, AgentStatus).status.detail
    link.close()
    bus.close()
    assert message.isprintable()
    assert len(message) == min(len(text) * times, MAX_STATUS_WORDS)
    assert all(c == d for c, d in zip(text * times, message, strict=False) if c.isprintable())


def test_the_status_is_current(hub: MemoryHub, other: MemoryBus):
    """Also when nothing was published: what waits for the server, what has gone over the network."""
    bus, waiting = TrafficMeter(MemoryBus(hub)), [3]
    failure = ["r0.sqlite: the disk\nis full"]
    link = FleetClient(
        bus, KEYS, MAP, MissionControl("r0"), unsent=lambda: waiting[0], failure=lambda: failure[0]
    )

    def asked() -> AgentStatus:
        (reply,) = other.ask(KEYS.agent_status("r0"), b"", 1.0)
        return decode(reply.payload, AgentStatus)

    first = asked()
    assert first.status.doing == "starting"
    assert (first.unsent, first.linked, first.epoch) == (3, False, MAP.epoch)
    assert (first.last_error, first.error_age) == ("r0.sqlite: the disk is full", 0.0)
    failure[0] = ""
    status = Status("turning", "why", 3, 40, Pose2(1, 2, 3), False)
    received: list[bytes] = []
    other.subscribe(KEYS.agent_statuses(), lambda sample: received.append(sample.payload))
    link.report(status, 5, publish=False)
    waiting[0] = 0
    token = other.announce(KEYS.server_alive("s0"))
    eventually(lambda: asked().linked)
    second = asked()
    assert (second.status, second.stamp_ns, second.unsent) == (status, 5, 0)
    assert second.traffic > first.traffic > 0 and second.last_error == ""
    failure[0] = "r0.sqlite: the disk is full"
    link.report(status, 6, publish=False, silent="/dev/ttyUSB0: the port is gone")
    assert asked().last_error == "/dev/ttyUSB0: the port is gone", "without it the robot does nothing else"
    link.report(status, 7, publish=False)
    assert asked().last_error == failure[0]
    token.close()
    eventually(lambda: not asked().linked)
    assert not received
    link.close()
    bus.close()


def test_the_agent_is_alive_until_it_goes(hub: MemoryHub, other: MemoryBus):
    seen: list[tuple[str, bool]] = []
    other.watch(KEYS.agents_alive(), lambda key, alive: seen.append((key, alive)))
    bus = MemoryBus(hub)
    link = FleetClient(bus, KEYS, MAP, MissionControl("r0"))
    eventually(lambda: seen == [(KEYS.agent_alive(MAP), True)])
    link.close()
    eventually(lambda: seen[-1] == (KEYS.agent_alive(MAP), False))
    assert other.ask(KEYS.mission("r0"), b"", 0.2) == []
    bus.close()


QUESTIONS: list[Question] = [WhereAmI(7, VIEW), WhichWay(7, HERE, THERE), WhatIsKnown(7, MAP, 1.0, 2.0, 9.0)]


@pytest.mark.parametrize("question", QUESTIONS, ids=["where", "way", "known"])
def test_without_a_server_the_answer_has_the_reason(link: FleetClient, question: Question):
    link.ask(question)
    (answer,) = link.answers(wait=True)
    assert (answer.number, answer.content, answer.error) == (7, None, NO_ANSWER)
    assert link.answers(wait=True) == (), "nothing is open: there is nothing to wait for"


def test_the_servers_answers_come_with_their_numbers(link: FleetClient, other: MemoryBus):
    asked: list[object] = []

    def relocalize(request) -> None:
        asked.append(decode_view(request.payload))
        request.reply(encode(RelocalizeAnswer(Certainty.UNKNOWN, (), "never seen")))

    def route(request) -> None:
        asked.append(decode(request.payload, RouteRequest))
        request.reply(encode(RouteAnswer((), "no way")))

    other.serve(sent_by_any(KEYS.relocalize("s0")), relocalize)
    other.serve(sent_by_any(KEYS.route("s0")), route)
    link.ask(WhereAmI(1, VIEW))
    link.ask(WhichWay(2, HERE, THERE, Pose2(0.25, -0.5, 1.0), ((HERE, THERE),)))
    first, second = link.answers(wait=True)
    assert isinstance(first.content, RelocalizeAnswer)
    assert (first.number, first.content.certainty, first.content.reason) == (
        1,
        Certainty.UNKNOWN,
        "never seen",
    )
    assert isinstance(second.content, RouteAnswer)
    assert (second.number, second.content.reason, second.error) == (2, "no way", "")
    view, request = asked
    assert np.allclose(view.pixels, VIEW.pixels, atol=0.1)
    assert np.array_equal(view.codes, VIEW.codes)
    assert (request.start, request.goal, request.blocked) == (HERE, THERE, ((HERE, THERE),))
    assert request.start_from_robot == Pose2(0.25, -0.5, 1.0)


def test_who_is_near_is_asked_only_of_a_server_that_is_there(link: FleetClient, other: MemoryBus):
    """A robot that maps alone asks for ever: that is no trouble to report."""
    who = WhoIsNear(-2, ((HERE, Pose2(0.5, 0.0, 0.1)),), 0.01, 0.02, 0.16, 0.3, 0.25)
    asked: list[NearbyRequest] = []

    def nearby(request) -> None:
        asked.append(decode(request.payload, NearbyRequest))
        request.reply(encode(NearbyAnswer((), "alone")))

    other.serve(sent_by_any(KEYS.nearby("s0")), nearby)
    link.ask(who)
    (answer,) = link.answers(wait=True)
    assert (answer.content, asked) == (None, [])
    (reply,) = other.ask(KEYS.agent_status("r0"), b"", 2.0)
    assert decode(reply.payload, AgentStatus).last_error == ""
    other.announce(KEYS.server_alive("s0"))
    eventually(link.server_in_reach)
    link.ask(who)
    (answer,) = link.answers(wait=True)
    assert answer.content == NearbyAnswer((), "alone")
    assert asked == [NearbyRequest("r0", who.starts, 0.01, 0.02, 0.16, 0.3, 0.25)]


def test_it_gets_what_others_have_mapped(link: FleetClient, other: MemoryBus):
    asked: list[KnownRequest] = []

    def known(request) -> None:
        asked.append(decode(request.payload, KnownRequest))
        request.reply(encode(KnownAnswer(np.array([[1.0, 2.0, 0.5, 0.5]]), "one view")))

    other.serve(sent_by_any(KEYS.known("s0")), known)
    link.ask(WhatIsKnown(-1, MAP, 1.5, -2.0, 9.0))
    (answer,) = link.answers(wait=True)
    assert asked == [KnownRequest(MAP, 1.5, -2.0, 9.0)]
    assert isinstance(answer.content, KnownAnswer)
    assert answer.content.views.tolist() == [[1.0, 2.0, 0.5, 0.5]]


def test_a_robot_never_waits(link: FleetClient, other: MemoryBus):
    release = threading.Event()

    def slow(request) -> None:
        release.wait(60)
        request.reply(encode(RouteAnswer((), "at last")))

    other.serve(sent_by_any(KEYS.route("s0")), slow)
    begin = time.monotonic()
    link.ask(WhichWay(1, HERE, THERE))
    assert link.answers() == ()
    assert time.monotonic() - begin < 20
    release.set()
    got: list[ServerAnswer] = []
    eventually(lambda: got.extend(link.answers()) or got)
    assert [answer.number for answer in got] == [1]


def test_waiting_ends_when_the_time_is_over(hub: MemoryHub, other: MemoryBus):
    release, bus = threading.Event(), MemoryBus(hub)
    link = FleetClient(bus, KEYS, MAP, MissionControl("r0"), answer_timeout=0.5)
    other.serve(sent_by_any(KEYS.route("s0")), lambda request: release.wait(60))
    begin = time.monotonic()
    for number in (1, 2):
        link.ask(WhichWay(number, HERE, THERE))
    answers = link.answers(wait=True)
    assert time.monotonic() - begin < 20
    assert [(a.number, a.content) for a in answers] == [(1, None), (2, None)]
    release.set()
    link.close()
    bus.close()


def answering(other: MemoryBus, server: str, answer: object) -> None:
    what = {
        RelocalizeAnswer: KEYS.relocalize, RouteAnswer: KEYS.route, KnownAnswer: KEYS.known,
        ReserveAnswer: KEYS.reserve,
    }[type(answer)]  # fmt: skip
    other.serve(sent_by_any(what(server)), lambda request: request.reply(encode(answer)))


@pytest.mark.parametrize("busy", [0, 2], ids=["at once", "after it was busy"])
def test_a_server_that_knows_the_place_is_not_waited_past(link: FleetClient, hub: MemoryHub, busy: int):
    """As in benchmarks.chaos: the other one still worked on the robot's last question."""
    frozen, other, release = MemoryBus(hub), MemoryBus(hub), threading.Event()
    frozen.serve(sent_by_any(KEYS.relocalize("s0")), lambda request: release.wait(60))
    refusals = iter(range(busy))

    def answer(request: Request) -> None:
        if next(refusals, None) is None:
            request.reply(encode(RelocalizeAnswer(Certainty.FOUND, (), "seen before")))
        else:
            request.refuse("busy", 0.1)

    other.serve(sent_by_any(KEYS.relocalize("s1")), answer)
    link.ask(WhereAmI(1, VIEW))
    begin = time.monotonic()
    (answer,) = link.answers(wait=True)
    assert isinstance(answer.content, RelocalizeAnswer) and answer.content.reason == "seen before"
    assert time.monotonic() - begin < 15, "less than the time of a question"
    release.set()
    frozen.close()
    other.close()


@pytest.mark.parametrize(
    ("question", "worse", "better"),
    [
        (
            WhereAmI(1, VIEW),
            RelocalizeAnswer(Certainty.UNKNOWN, (), "no map here"), RelocalizeAnswer(Certainty.FOUND, (), ""),
        ),
        (
            WhatIsKnown(1, MAP, 0.0, 0.0, 9.0),
            KnownAnswer(np.zeros((0, 4), np.float32), ""), KnownAnswer(np.zeros((1, 4), np.float32), ""),
        ),
        (
            MayIDrive(1, HERE, Pose2(), (HERE, THERE)),
            ReserveAnswer(2, "", None, ""), ReserveAnswer(1, "r7", None, "r7 is there"),
        ),
        (
            MayIDrive(1, HERE, Pose2(), (HERE, THERE)),
            ReserveAnswer(0, "r7", None, ""), ReserveAnswer(0, "", None, "closed", closed=True),
        ),
    ],
    ids=["where", "known", "right of way", "closed"],
)  # fmt: skip
@pytest.mark.parametrize("first", ["worse", "better"])
def test_of_two_servers_the_one_that_knows_more_is_believed(
    link: FleetClient, other: MemoryBus, question: Question, worse: object, better: object, first: str
):
    """One of them may be new, or get its store again; and a robot drives only where both let it."""
    for server, answer in zip(("s0", "s1"), (worse, better)[:: 1 if first == "worse" else -1], strict=True):
        answering(other, server, answer)
    link.ask(question)
    (answer,) = link.answers(wait=True)
    assert answer.content is not None and encode(answer.content) == encode(better)


def test_a_question_that_a_server_took_along_is_asked_again(link: FleetClient, hub: MemoryHub):
    """A server dies with the question; the other one takes its place a moment later."""
    dying, other = MemoryBus(hub), MemoryBus(hub)
    asked = threading.Event()
    dying.announce(KEYS.server_alive("s0"))
    dying.serve(sent_by_any(KEYS.route("s0")), lambda request: asked.set())
    eventually(link.server_in_reach)
    link.ask(WhichWay(1, HERE, THERE))
    assert asked.wait(30)
    other.announce(KEYS.server_alive("s1"))
    dying.close()
    answering(other, "s1", RouteAnswer((), "from s1"))
    (answer,) = link.answers(wait=True)
    assert isinstance(answer.content, RouteAnswer) and answer.content.reason == "from s1"
    other.close()


def test_a_refusal_is_quoted_and_another_servers_answer_is_used(link: FleetClient, other: MemoryBus):
    other.serve(sent_by_any(KEYS.route("s0")), lambda request: request.refuse("no such node"))
    link.ask(WhichWay(1, HERE, THERE))
    (answer,) = link.answers(wait=True)
    assert answer.content is None
    assert "no such node" in answer.error
    other.serve(sent_by_any(KEYS.route("s1")), lambda request: request.reply(b"garbage"))
    link.ask(WhichWay(2, HERE, THERE))
    (answer,) = link.answers(wait=True)
    assert answer.content is None
    assert answer.error
    other.serve(sent_by_any(KEYS.route("s2")), lambda request: request.reply(encode(RouteAnswer((), "yes"))))
    link.ask(WhichWay(3, HERE, THERE))
    (answer,) = link.answers(wait=True)
    assert isinstance(answer.content, RouteAnswer)


def test_a_question_that_cannot_be_sent_is_answered_and_the_next_one_is_asked(
    link: FleetClient, other: MemoryBus
):
    """A robot that stood before very many closed doors must not lose its voice, nor stop a lock-step."""
    other.serve(sent_by_any(KEYS.route("s0")), lambda request: request.reply(encode(RouteAnswer((), "yes"))))
    link.ask(WhichWay(1, HERE, THERE, Pose2(), ((HERE, THERE),) * (MAX_BLOCKED + 1)))
    link.ask(WhichWay(2, HERE, THERE))
    got: list[ServerAnswer] = []
    eventually(lambda: got.extend(link.answers()) or len(got) == 2)
    assert got[0].content is None
    assert "length <= 256 - at `$.blocked`" in got[0].error
    assert isinstance(got[1].content, RouteAnswer)


def test_closing_twice_is_no_error(hub: MemoryHub):
    bus = MemoryBus(hub)
    link = FleetClient(bus, KEYS, MAP, MissionControl("r0"))
    link.close()
    link.close()
    bus.close()


def test_a_trouble_is_in_the_status_only_while_it_holds(hub: MemoryHub, other: MemoryBus, caplog):
    caplog.set_level("INFO", "mapweave.agent.fleet_client")
    bus, missions = MemoryBus(hub), MissionControl("r0")
    link = FleetClient(bus, KEYS, MAP, missions, answer_timeout=0.1)

    def trouble() -> str:
        return link.status().last_error

    def ask(question: Question) -> None:
        link.ask(question)
        link.answers(wait=True)

    where, way = QUESTIONS[:2]
    ask(where)
    time.sleep(0.05)
    ask(where)
    assert trouble() == NO_ANSWER and link.status().error_age >= 0.05, "since it began"
    # A server that comes ends it, without another question.
    token = other.announce(KEYS.server_alive("s0"))
    eventually(lambda: trouble() == "")
    assert [record.message for record in caplog.records] == [
        f"a question to the fleet has no answer: {NO_ANSWER}", f"over after 0 s: {NO_ANSWER}"
    ]  # fmt: skip

    refusing = ["full"]

    def relocalize(request) -> None:
        if refusing:
            request.refuse(refusing[0])
        else:
            request.reply(encode(RelocalizeAnswer(Certainty.UNKNOWN, (), "never seen")))

    other.serve(sent_by_any(KEYS.relocalize("s0")), relocalize)
    ask(where)
    ask(way)
    assert trouble() == NO_ANSWER, "the newest of two: it has no routes"
    other.serve(
        sent_by_any(KEYS.route("s0")), lambda request: request.reply(encode(RouteAnswer((), "no way")))
    )
    ask(way)
    assert "full" in trouble(), "answers of another kind do not end a refusal"
    refusing.clear()
    ask(where)
    assert trouble() == "" and link.status().error_age == 0.0
    # What was asked for a mission is over with it.
    status = Status("turning", "why", 3, 40, Pose2(1, 2, 3), False)
    link.report(status, 1)
    refusing.append("full")
    ask(where)
    link.report(status, 2)
    assert "full" in trouble()
    missions.take(MissionOrder.new("r0", MissionKind.STOP, "anna"))
    link.report(status, 3)
    assert trouble() == ""
    token.close()
    link.close()
    bus.close()

"""Teleoperation, the robot's side: the newest command, the dead man, who may drive."""

import math
from dataclasses import replace

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave import Command, MapId
from mapweave.agent.fleet_client import FleetClient
from mapweave.agent.mission import Driven
from mapweave.agent.mission_control import MissionControl
from mapweave.agent.teleoperation import Teleoperation
from mapweave.hybridmap.agent_status import HandDrive
from mapweave.hybridmap.drive_request import DriveAnswer, DriveRequest
from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.mission_order import MissionKind, MissionOrder
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.messages import decode, encode
from mapweave.wire.senders import sent_by

SPEED = st.floats(-1000.0, 1000.0)
KEYS = Keys("hand")


class Clock:
    """A clock that is set."""

    def __init__(self) -> None:
        self.ns = 5_000_000_000

    def __call__(self) -> int:
        return self.ns

    def wait(self, seconds: float) -> None:
        self.ns += round(seconds * 1e9)


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def robot(clock: Clock) -> Teleoperation:
    return Teleoperation(clock)


@given(st.integers(0, 2**53), SPEED, SPEED, st.integers(0, 2**63 - 1), st.booleans())
def test_a_request_survives_the_wire(session, forward, turn, answer_ns, release):
    request = DriveRequest(session, forward, turn, answer_ns, release)
    assert decode(encode(request), DriveRequest) == request


@pytest.mark.parametrize("wrong", [{"forward": 1e7}, {"turn": math.nan}, {"session": -1}, {"answer_ns": -5}])
def test_a_request_that_is_none_is_refused(wrong: dict[str, float]):
    good = {"v": 1, "session": 1, "forward": 0.1, "turn": 0.0, "answer_ns": 0, "release": False}
    assert decode(msgpack.packb(good), DriveRequest) == DriveRequest(1, 0.1)
    with pytest.raises(InvalidMessage, match="drive request: "):
        decode(msgpack.packb(good | wrong), DriveRequest)


def test_the_newest_command_holds_for_half_a_second(robot: Teleoperation, clock: Clock):
    assert robot.driven() is None
    answer = robot.take(DriveRequest(1, 0.1, 0.2))
    assert robot.driven() == Driven(Command()), "a first request follows no answer: it stops"
    for speed in (0.1, 0.2):
        answer = robot.take(DriveRequest(1, speed, 0.2, answer))
        assert robot.driven() == Driven(Command(speed, 0.2))
        clock.wait(0.4)
        assert robot.driven() == Driven(Command(speed, 0.2))
    clock.wait(0.2)
    assert robot.driven() == Driven(Command(), pytest.approx(0.6)), "it stands, and the mission waits"
    clock.wait(100.0)
    assert robot.driven() == Driven(Command(), pytest.approx(100.6))
    robot.take(DriveRequest(1, 0.3, 0.0, answer))
    assert robot.driven() == Driven(Command()), "what was given 100 s after its answer was held up on its way"


@pytest.mark.parametrize("delay", [0.9, 1.1])
def test_a_command_that_was_held_up_stops(robot: Teleoperation, clock: Clock, delay: float):
    answer = robot.take(DriveRequest(1, 0.0, 0.0))
    clock.wait(delay)
    robot.take(DriveRequest(1, 0.2, 0.0, answer))
    assert robot.driven() == Driven(Command(0.2) if delay < 1.0 else Command())
    robot.take(DriveRequest(1, 0.2, 0.0, clock.ns + 1))
    assert robot.driven() == Driven(Command()), "an answer of the future is none of this agent"


def test_one_drives_and_gives_the_wheels_back(robot: Teleoperation, clock: Clock):
    answer = robot.take(DriveRequest(1, 0.0, 0.0))
    answer = robot.take(DriveRequest(1, 0.2, 0.0, answer))
    with pytest.raises(InvalidValue, match="another"):
        robot.take(DriveRequest(2, -0.2, 0.0, answer))
    assert robot.driven() == Driven(Command(0.2))
    clock.wait(0.6)
    answer = robot.take(DriveRequest(2, -0.1, 0.0, answer))
    assert robot.driven() == Driven(Command(-0.1)), "who has fallen silent drives no longer"
    robot.take(DriveRequest(2, 0.0, 0.0, answer, release=True))
    assert robot.driven() is None


def test_the_fleet_client_answers_with_its_status_and_a_mission_ends_the_wait(clock: Clock):
    hub = MemoryHub()
    bus, person, robot = MemoryBus(hub), MemoryBus(hub), Teleoperation(clock)
    link = FleetClient(
        bus, KEYS, MapId("r0", 3), MissionControl("r0"), teleoperation=robot, limits=(0.3, 0.8)
    )
    try:
        (reply,) = person.ask(KEYS.drive("r0"), encode(DriveRequest(7, 0.0, 0.0)), 5.0)
        answer = decode(reply.payload, DriveAnswer)
        assert (answer.report.epoch, answer.max_forward, answer.max_turn) == (3, 0.3, 0.8)
        (reply,) = person.ask(KEYS.drive("r0"), encode(DriveRequest(7, 0.2, 0.0, answer.answer_ns)), 5.0)
        assert link.driven() == Driven(Command(0.2))
        (reply,) = person.ask(KEYS.drive("r0"), encode(DriveRequest(8, 0.0, 0.0)), 5.0)
        assert "another `mapweave drive`" in reply.error
        (reply,) = person.ask(KEYS.drive("r0"), b"garbage", 5.0)
        assert reply.error
        clock.wait(3.0)
        assert link.driven() == Driven(Command(), pytest.approx(3.0))
        person.ask(KEYS.mission("r0"), encode(MissionOrder.new("r0", MissionKind.STOP, "a test")), 5.0)
        assert link.driven() is None
    finally:
        link.close()
        person.close()
        bus.close()


def test_who_drives_is_in_the_status(clock: Clock):
    """The name in the key holds, and a drive that has ended is still there."""
    hub = MemoryHub()
    bus, person = MemoryBus(hub), MemoryBus(hub)
    robot = Teleoperation(clock, time_ns=lambda: 7)
    link = FleetClient(bus, KEYS, MapId("r0", 3), MissionControl("r0"), teleoperation=robot)
    try:
        assert link.status().drive is None
        request, key = DriveRequest(7, by="eve"), KEYS.drive("r0")
        (reply,) = person.ask(sent_by(key, "anna"), encode(request), 5.0)
        assert link.status().drive == HandDrive("anna", 7) == decode(reply.payload, DriveAnswer).report.drive
        person.ask(sent_by(key, "anna"), encode(replace(request, release=True)), 5.0)
        assert link.status().drive == HandDrive("anna", 7, over=True)
        person.ask(key, encode(replace(request, session=8)), 5.0)
        assert link.status().drive == HandDrive("eve", 7)
    finally:
        link.close()
        person.close()
        bus.close()


def test_no_one_drives_a_recording(clock: Clock):
    recording = Teleoperation(clock, "a recording takes no orders")
    with pytest.raises(InvalidValue, match="a recording takes no orders"):
        recording.take(DriveRequest(1, 0.2, 0.0))
    assert recording.driven() is None

"""A drive by gamepad or keys: `mapweave drive` at one end, the agent's commands at the other."""

import os
import pty
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from mapweave.agent.fleet_client import FleetClient
from mapweave.agent.mission import Driven
from mapweave.agent.mission_control import MissionControl
from mapweave.agent.observation import Command
from mapweave.agent.teleoperation import Teleoperation
from mapweave.commands.drive import _by_gamepad, _by_keyboard
from mapweave.hybridmap.errors import DeviceError
from mapweave.hybridmap.ids import MapId
from mapweave.teleoperation.gamepad import Gamepad
from mapweave.teleoperation.keyboard import Keyboard, RawTerminal
from mapweave.teleoperation.session import Session
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from tests.mapweave.teleoperation.test_inputs import event
from tests.waiting import eventually

KEYS = Keys("test")


@pytest.fixture
def ends() -> Iterator[tuple[MemoryBus, FleetClient]]:
    """The person's bus and the agent."""
    hub = MemoryHub()
    person, bus = MemoryBus(hub), MemoryBus(hub)
    robot = FleetClient(
        bus, KEYS, MapId("r0", 3), MissionControl("r0"), teleoperation=Teleoperation(), limits=(0.3, 0.8)
    )
    yield person, robot
    robot.close()
    person.close()
    bus.close()


def stands(robot: FleetClient) -> bool:
    driven = robot.driven()
    return driven is not None and driven.command == Command()


def test_a_gamepad_that_is_unplugged_stops_the_robot_and_its_mission_does_not_go_on(
    ends: tuple[MemoryBus, FleetClient], tmp_path: Path
):
    """The wheels were given back: a robot that explores drove on, and no person had asked for it."""
    person, robot = ends
    device = tmp_path / "js0"
    os.mkfifo(device)
    pad = Gamepad(device, 1.0)
    failed: list[DeviceError] = []

    def drive() -> None:
        try:
            with Session(person, KEYS, "r0") as session:
                _by_gamepad(session, "r0", pad, threading.Event())
        except DeviceError as error:
            failed.append(error)

    with device.open("wb", buffering=0) as kernel:
        thread = threading.Thread(target=drive)
        thread.start()
        kernel.write(event(0, 0x82, 0) + event(0, 0x82, 1))
        kernel.write(event(-32767, 0x02, 1))
        eventually(lambda: robot.driven() == Driven(Command(0.3)))
    unplugged = time.monotonic()
    eventually(lambda: stands(robot))
    assert time.monotonic() - unplugged < 0.5
    thread.join()
    pad.close()
    assert "it is gone. r0 stands until someone drives it and quits, or gives it a mission" in str(failed[0])
    assert stands(robot)


@pytest.mark.parametrize("signalled", [False, True])
def test_a_terminal_that_is_lost_stops_the_robot_too(
    signalled: bool, ends: tuple[MemoryBus, FleetClient], monkeypatch: pytest.MonkeyPatch
):
    """As where a connection by ssh breaks: the end of the terminal was taken for Ctrl-C."""
    person, robot = ends
    master, slave = pty.openpty()
    with os.fdopen(slave) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        stop = threading.Event()
        failed: list[DeviceError] = []

        def drive() -> None:
            try:
                with Session(person, KEYS, "r0") as session, RawTerminal() as terminal:
                    _by_keyboard(session, "r0", terminal, Keyboard(1.0), stop)
            except DeviceError as error:
                failed.append(error)

        thread = threading.Thread(target=drive)
        thread.start()

        def pressed() -> bool:
            os.write(master, b"w")
            return robot.driven() == Driven(Command(0.3))

        eventually(pressed)
        os.close(master)
        if signalled:
            stop.set()
        thread.join()
    assert str(failed[0]).startswith("the terminal is gone. r0 stands until someone drives it")
    assert stands(robot)


def test_the_mission_goes_on_when_a_person_has_quit(ends: tuple[MemoryBus, FleetClient]):
    person, robot = ends
    with Session(person, KEYS, "r0") as session:
        session.want(0.5, 0.0)
        eventually(lambda: robot.driven() == Driven(Command(0.15)))
    assert robot.driven() is None

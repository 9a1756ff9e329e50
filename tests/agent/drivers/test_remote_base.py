"""The driver `remote` against a base that is written from docs/wire.md by hand, over a real router."""

import json
import struct
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import zenoh

from mapweave import Command, Observation, Robot
from mapweave.agent.drivers.checked import CheckedRobot
from mapweave.agent.drivers.remote import RemoteRobot
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.zenoh_bus import ZenohBus
from tests.agent.drivers.contract import (
    ANSWERS_WITHIN,
    HEIGHT,
    WIDTH,
    RobotContract,
    drive_until,
    drive_way,
    until,
)
from tests.agent.drivers.emulators import TwoWheels
from tests.waiting import free_port

ROOT = "mapweave/1/demo/robot/r0"
TICK, AXLE, SILENCE = 0.1, 0.24, 0.5
"""s from answer to answer; m; s without a step after which a base stops the wheels."""
BEARINGS = [-0.5, 0.0, 0.5]
CHILD = """
import sys
from pathlib import Path
from mapweave.agent.drivers.remote import RemoteRobot
from mapweave.agent.observation import Command
from mapweave.settings import load_settings
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.zenoh_bus import ZenohBus
network = load_settings(Path(sys.argv[1])).network
robot = RemoteRobot(ZenohBus(BusSettings(endpoints=network.endpoints)), network.fleet, "r0")
while True:
    robot.sense()
    robot.act(Command(0.2, 0.0))
    print("driving", flush=True)
"""


class Base:
    """A real robot's computer: its wheels, its images of noise, and a session of its own.

    Attributes:
        wheels: what drives.
        stalled: whether it answers nothing.
        endpoint: of the router, which stays when the base goes.
    """

    def __init__(self, folder: Path) -> None:
        self.endpoint, self.wheels, self.stalled = f"tcp/127.0.0.1:{free_port()}", TwoWheels(), False
        self._router = ZenohBus(BusSettings(mode="router", listen=(self.endpoint,)))
        self._noise, self._lock = np.random.default_rng(0), threading.Lock()
        self._session: zenoh.Session | None = None
        self._closing = False
        self.plug_in()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def plug_in(self) -> None:
        """It starts: the wheels stand, and it knows no step."""
        self.wheels.set(0.0, 0.0)
        self._number, self._answer = 0, b""
        self._way, self._stepped, self._due = self.wheels.way(), 0.0, 0.0
        self._drivers = set[str]()
        self._held: list[zenoh.Query] = []
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", json.dumps([self.endpoint]))
        self._session = session = zenoh.open(config)
        self._declared = [
            session.declare_queryable(f"{ROOT}/describe", self._describe),
            session.declare_queryable(f"{ROOT}/step", self._step),
            session.liveliness().declare_subscriber(f"{ROOT}/driver/*", self._driver, history=True),
        ]

    def unplug(self) -> None:
        """It loses its supply: its wheels stand, and its keys are gone."""
        assert self._session is not None
        session, self._session = self._session, None
        session.close()  # type: ignore[no-untyped-call]
        self.wheels.set(0.0, 0.0)

    def close(self) -> None:
        self._closing = True
        self._thread.join()
        if self._session is not None:
            self.unplug()
        self._router.close()

    def _describe(self, query: zenoh.Query) -> None:
        camera = struct.pack("<HH6d", WIDTH, HEIGHT, 60.0, 60.0, 32.0, 24.0, 0.3, 0.0)
        base = {
            "v": 1, "camera": camera, "radius": 0.16, "axle": AXLE, "max_forward": 0.3, "max_turn": 0.8,
            "ranger_bearings": BEARINGS, "ranger_reach": 2.0, "tick": TICK,
        }  # fmt: skip
        query.reply(f"{ROOT}/describe", msgpack.packb(base))

    def _step(self, query: zenoh.Query) -> None:
        if self.stalled:
            self._held.append(query)  # a query that is let go counts as answered
            return
        assert query.payload is not None
        asked = msgpack.unpackb(query.payload.to_bytes())
        with self._lock:
            if asked["q"] != self._number:
                forward, turn = asked["c"]
                self._stepped = time.monotonic()
                self.wheels.set(forward - turn * AXLE / 2, forward + turn * AXLE / 2)
                time.sleep(max(self._due - time.monotonic(), 0.0))
                self._due = max(self._due, time.monotonic()) + TICK
                self._number, self._answer = asked["q"], msgpack.packb(self._seen())
        query.reply(f"{ROOT}/step", self._answer)

    def _seen(self) -> dict[str, Any]:
        before, self._way = self._way, self.wheels.way()
        left, right = (b - a for a, b in zip(before, self._way, strict=True))
        image = self._noise.integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)
        return {
            "v": 1, "t": time.time_ns(), "u": [(left + right) / 2, (right - left) / AXLE],
            "r": [1.0, 2.0, 1.5], "b": False, "s": [HEIGHT, WIDTH], "encoding": "raw", "i": image.tobytes(),
        }  # fmt: skip

    def _driver(self, sample: zenoh.Sample) -> None:
        alive = sample.kind == zenoh.SampleKind.PUT
        (self._drivers.add if alive else self._drivers.discard)(str(sample.key_expr))
        if not self._drivers:
            self.wheels.set(0.0, 0.0)

    def _watch(self) -> None:
        while not self._closing:
            silent = time.monotonic() - self._stepped > SILENCE
            if silent and self.wheels.speeds != (0.0, 0.0):
                self.wheels.set(0.0, 0.0)
            time.sleep(0.002)


class TestRemote(RobotContract):
    """As of all drivers, but for a line that fails: a step is one question, and the base has the clock.

    A simulated base is silent while it waits for other robots, and its time stands still meanwhile. So the
    driver waits, and makes up no observation; the base stops the wheels by itself.
    """

    DRIVER = "remote"
    EMULATOR = Base
    CHILD = CHILD
    SPEED_STEP = 1e-9
    COUNT = 0.002
    """The first odometry is of the time before it."""

    @pytest.fixture
    def settings(self, emulator: Any, tmp_path: Path) -> Path:
        path = tmp_path / "robot.toml"
        path.write_text(f'[network]\nendpoints = ["{emulator.endpoint}"]\n')
        return path

    @pytest.fixture
    def robot(self, emulator: Base) -> Iterator[Robot]:
        bus = ZenohBus(BusSettings(endpoints=(emulator.endpoint,)))
        robot = CheckedRobot(RemoteRobot(bus, "demo", "r0"))
        try:
            robot.describe()
            yield robot
        finally:
            robot.close()
            bus.close()

    def test_it_comes_back_when_the_port_has_vanished(self, robot: Robot, emulator: Any):
        """The base has the last command no more; the driver does not give it again, but lets it stand."""
        drive_until(robot, Command(0.2, 0.0), lambda: emulator.wheels.speeds[0] > 0.1)
        emulator.unplug()
        robot.act(Command(0.2, 0.0))
        seen: list[Observation | None] = []
        waiting = threading.Thread(target=lambda: seen.append(robot.sense()), daemon=True)
        waiting.start()
        # Longer than the driver asks under the old command.
        waiting.join(3.0)
        assert waiting.is_alive() and not seen, "no observation is made up"
        before = len(emulator.wheels.commanded)
        emulator.plug_in()
        waiting.join(10.0)
        assert seen and seen[0] is not None
        assert seen[0].odometry.forward == pytest.approx(0.0, abs=1e-9)
        assert {*emulator.wheels.commanded[before:]} == {(0.0, 0.0)}
        drive_until(robot, Command(0.2, 0.0), lambda: emulator.wheels.speeds[0] > 0.1)
        back = drive_way(robot, Command(0.2, 0.0), 0.05)
        assert len(back[-1].proximity) == len(robot.describe().ranger_bearings)

    def test_a_stalled_line_holds_up_nothing(self, robot: Robot, emulator: Any):
        """Nothing but the next observation: commands are taken, the wheels stop, and it can be closed."""
        drive_until(robot, Command(0.2, 0.0), lambda: emulator.wheels.speeds[0] > 0.1)
        emulator.stalled = True
        begin = time.monotonic()
        seen: list[Observation | None] = []
        waiting = threading.Thread(target=lambda: seen.append(robot.sense()), daemon=True)
        waiting.start()
        acts = []
        for _ in range(12):
            asked = time.monotonic()
            robot.act(Command(0.1, 0.0))
            acts.append(time.monotonic() - asked)
        assert np.median(acts) < ANSWERS_WITHIN
        until(lambda: emulator.wheels.speeds == (0.0, 0.0), 1.5)
        assert emulator.wheels.stopped_at - begin < SILENCE + 0.1
        emulator.stalled = False
        waiting.join(10.0)
        assert seen and seen[0] is not None
        drive_until(robot, Command(0.1, 0.0), lambda: emulator.wheels.speeds[0] > 0.05)
        emulator.stalled = True
        waiting = threading.Thread(target=lambda: seen.append(robot.sense()), daemon=True)
        waiting.start()
        time.sleep(0.2)
        robot.close()
        waiting.join(5.0)
        assert seen[1:] == [None], "closing it ends the wait"

"""A bridge in a thread, agents that drive in threads, and a simulation without physics."""

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave import Camera, Command, Observation, Odometry, RobotDescription
from mapweave.agent.drivers.remote import RemoteRobot
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.sim.bridge import SimBridge
from mapweave.sim.floorplan import BuildingPlan, Rectangle
from mapweave.sim.ground_truth_client import SimControl
from mapweave.sim.keys import SimKeys
from mapweave.wire.memory import MemoryBus, MemoryHub

KEYS = SimKeys("test")
TICK_NS = 100_000_000
CAMERA = Camera(width=32, height=24, fx=27.0, fy=27.0, cx=15.5, cy=11.5, mount_height=0.3)
PLAN = BuildingPlan(
    rooms=(Rectangle.spanning(0, 0, 4, 3, "office"),),
    walls=(Rectangle.spanning(0, -0.1, 4, 0), Rectangle(1.0, 3.0, 2.0, 0.1, 0.3, "slanted")),
    furniture=(Rectangle(2.0, 1.0, 0.5, 0.4, 1.2, "desk"),),
)


@dataclass(frozen=True)
class FakeWorld:
    plan: BuildingPlan = PLAN


@dataclass
class FakeSimulation:
    """Points that obey exactly; it checks that only one thread touches it."""

    robots: tuple[str, ...] = ("r0", "r1")
    world: FakeWorld = field(default_factory=FakeWorld)
    tick: int = 0
    seconds: dict[str, float] = field(default_factory=lambda: {"physics": 0.5})
    calls: list[tuple[str, object]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._poses = {name: [Pose2(float(k), 0.0, 0.0)] for k, name in enumerate(self.robots)}
        self._seen = dict.fromkeys(self.robots, 0.0)
        self._driven = dict.fromkeys(self.robots, 0.0)
        self._busy = threading.Lock()

    @property
    def stamp_ns(self) -> int:
        return self.tick * TICK_NS

    def describe(self, name: str) -> RobotDescription:
        del name
        return RobotDescription(camera=CAMERA)

    def advance(self, commands: Mapping[str, Command]) -> None:
        assert self._busy.acquire(blocking=False)
        self.calls.append(("advance", dict(commands)))
        assert list(commands) == sorted(commands)
        for name in self.robots:
            command = commands.get(name, Command())
            self._driven[name] += command.forward * 0.1
            step = Pose2(command.forward * 0.1, 0.0, command.turn * 0.1)
            self._poses[name].append(self._poses[name][-1] @ step)
        self.tick += 1
        self._busy.release()

    def observe(self, name: str) -> Observation:
        assert self._busy.acquire(blocking=False)
        self.calls.append(("observe", name))
        forward = self._driven[name] - self._seen[name]
        self._seen[name] = self._driven[name]
        image = np.full((24, 32), self.tick % 256, np.uint8)
        self._busy.release()
        return Observation(self.stamp_ns, Odometry(forward, 0.0), image)

    def kidnap(self, name: str, pose: Pose2) -> None:
        self.calls.append(("kidnap", name))
        self._poses[name][-1] = pose

    def truth(self, name: str) -> Pose2:
        return self._poses[name][-1]

    def truth_at(self, name: str, stamp_ns: int) -> Pose2:
        if not 0 <= stamp_ns <= self.stamp_ns:
            raise InvalidValue(f"{stamp_ns} ns was not simulated")
        return self._poses[name][stamp_ns // TICK_NS]

    def trajectory(self, name: str) -> tuple[NDArray[np.int64], Array]:
        stamps = np.arange(self.tick + 1, dtype=np.int64) * TICK_NS
        return stamps, np.array([pose.vector for pose in self._poses[name]])

    def collisions(self, name: str) -> int:
        return self.robots.index(name)


class Stage:
    """A bridge that runs in a thread, and buses for its clients."""

    def __init__(self) -> None:
        self.hub = MemoryHub()
        self.buses: list[MemoryBus] = []
        self.stop = threading.Event()
        self.thread: threading.Thread | None = None
        self.bridge: SimBridge | None = None

    def join(self) -> MemoryBus:
        self.buses.append(MemoryBus(self.hub))
        return self.buses[-1]

    def start(self, simulation: Any, patience: float = 20.0, farewell: float = 0.02) -> SimControl:
        self.bridge = SimBridge(simulation, self.join(), "test", patience, farewell)
        self.thread = threading.Thread(target=self.bridge.run, args=(self.stop,))
        self.thread.start()
        return SimControl(self.join(), "test")

    def robot(self, name: str, patience: float = 10.0) -> RemoteRobot:
        return RemoteRobot(self.join(), "test", name, patience)

    def end(self) -> None:
        self.stop.set()
        if self.thread is not None:
            self.thread.join(30.0)
            assert not self.thread.is_alive()
        if self.bridge is not None:
            self.bridge.close()
        for bus in self.buses:
            bus.close()


class Driver(threading.Thread):
    """An agent: drives by what it sees, at its own pace."""

    def __init__(self, robot: RemoteRobot, ticks: int, pause: Callable[[int], float]) -> None:
        super().__init__()
        self.robot = robot
        self.ticks = ticks
        self.pause = pause
        self.seen: list[Observation] = []
        self.ended = False

    def run(self) -> None:
        for number in range(self.ticks):
            observation = self.robot.sense()
            if observation is None:
                self.ended = True
                return
            self.seen.append(observation)
            time.sleep(self.pause(number))
            # What it does depends on what it sees, so that a wrong order would show.
            turn = 0.1 * (observation.stamp_ns // TICK_NS % 5) - 5.0 * observation.odometry.forward
            self.robot.act(Command(0.05 + 0.02 * (number % 7), turn))

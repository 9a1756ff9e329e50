"""The lock-step over the bus: agents in threads, a simulation without physics, and once with them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.drivers.messages import ENDED, StepRequest, encode_step
from agent.drivers.remote import RemoteRobot
from agent.observation import Command, Observation, Odometry, RobotDescription
from hybridmap.camera import Camera
from hybridmap.errors import InvalidValue, NotConnected
from hybridmap.pose import Array, Pose2
from sim.bridge import SimBridge
from sim.control import SimControl
from sim.floorplan import FloorPlan, Rectangle
from sim.simulated import Simulated
from sim.simulation import Simulation
from sim.worlds.office import make_office
from wire.keys import Keys
from wire.memory import MemoryBus, MemoryHub

KEYS = Keys("test")
TICK_NS = 100_000_000
CAMERA = Camera(width=32, height=24, fx=27.0, fy=27.0, cx=15.5, cy=11.5, mount_height=0.3)
PLAN = FloorPlan(
    rooms=(Rectangle.spanning(0, 0, 4, 3, "office"),),
    walls=(Rectangle.spanning(0, -0.1, 4, 0), Rectangle(1.0, 3.0, 2.0, 0.1, 0.3, "slanted")),
    furniture=(Rectangle(2.0, 1.0, 0.5, 0.4, 1.2, "desk"),),
)


@dataclass(frozen=True)
class FakeWorld:
    plan: FloorPlan = PLAN


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
    """A bridge that runs in a thread, and buses for whoever plays with it."""

    def __init__(self) -> None:
        self.hub = MemoryHub()
        self.buses: list[MemoryBus] = []
        self.stop = threading.Event()
        self.thread: threading.Thread | None = None
        self.bridge: SimBridge | None = None

    def join(self) -> MemoryBus:
        self.buses.append(MemoryBus(self.hub))
        return self.buses[-1]

    def start(
        self,
        simulation: Simulated,
        patience: float = 20.0,
        expected: int | None = None,
        farewell: float = 0.02,
    ) -> SimControl:
        self.bridge = SimBridge(simulation, self.join(), "test", patience, expected, farewell)
        self.thread = threading.Thread(target=self.bridge.run, args=(self.stop,))
        self.thread.start()
        return SimControl(self.join(), "test")

    def robot(self, name: str, patience: float = 10.0) -> RemoteRobot:
        return RemoteRobot(self.join(), "test", name, patience)

    def end(self) -> None:
        self.stop.set()
        if self.thread is not None:
            self.thread.join(5.0)
            assert not self.thread.is_alive()
        if self.bridge is not None:
            self.bridge.close()
        for bus in self.buses:
            bus.close()


@pytest.fixture
def stage() -> Iterator[Stage]:
    made = Stage()
    yield made
    made.end()


def until(true: Callable[[], bool], seconds: float = 5.0) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.005)


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


def race(paces: Mapping[str, Callable[[int], float]], ticks: int = 30) -> tuple[list[object], int]:
    """What a simulation goes through with agents of these paces, and how far they were apart at most."""
    stage = Stage()
    simulation = FakeSimulation()
    apart = 0
    try:
        stage.start(simulation)
        drivers = [Driver(stage.robot(name), ticks, pace) for name, pace in paces.items()]
        for driver in drivers:
            driver.start()
        while any(driver.is_alive() for driver in drivers):
            counts = [len(driver.seen) for driver in drivers]
            apart = max(apart, max(counts) - min(counts))
            time.sleep(0.0005)
        for driver in drivers:
            driver.join()
            assert [o.stamp_ns for o in driver.seen] == [TICK_NS * (k + 1) for k in range(ticks)]
    finally:
        stage.end()
    return [*simulation.calls, *(tuple(simulation.truth(name).vector) for name in simulation.robots)], apart


def test_agents_go_in_step_and_their_speed_changes_nothing() -> None:
    rng = np.random.default_rng(3)
    uneven = rng.uniform(0, 0.006, (2, 30))
    even, apart = race({"r0": lambda _: 0.0, "r1": lambda _: 0.0})
    slow_first, apart_slow = race({"r0": lambda k: float(uneven[0, k]), "r1": lambda _: 0.0})
    slow_second, apart_second = race({"r1": lambda k: float(uneven[1, k]), "r0": lambda _: 0.001})
    assert even == slow_first == slow_second
    assert max(apart, apart_slow, apart_second) <= 1
    assert even.count(("observe", "r0")) == even.count(("observe", "r1")) == 30


def test_the_first_observation_comes_after_one_tick_in_which_nothing_moves(stage: Stage) -> None:
    simulation = FakeSimulation(robots=("r0",))
    stage.start(simulation)
    robot = stage.robot("r0")
    assert robot.describe() == RobotDescription(camera=CAMERA)
    first = robot.sense()
    assert first is not None
    assert first.stamp_ns == TICK_NS
    assert first.odometry == Odometry(0.0, 0.0)
    robot.act(Command(0.2, 0.0))
    second = robot.sense()
    assert second is not None
    assert second.odometry.forward == pytest.approx(0.02)
    assert second.image is not None
    assert (second.image == 2).all()


def test_a_command_beyond_the_limits_is_clipped_by_the_body_too(stage: Stage) -> None:
    simulation = FakeSimulation(robots=("r0",))
    stage.start(simulation)
    stage.join().ask(KEYS.robot_step("r0"), encode_step(StepRequest(1, Command(50.0, -50.0))), 5.0)
    assert simulation.calls[0] == ("advance", {"r0": Command(0.3, -0.8)})


def test_a_repeated_step_gets_the_same_bytes_and_does_not_advance(stage: Stage) -> None:
    simulation = FakeSimulation(robots=("r0",))
    stage.start(simulation)
    bus, key = stage.join(), KEYS.robot_step("r0")
    step = encode_step(StepRequest(1, Command(0.1, 0.0)))
    first, again = bus.ask(key, step, 5.0), bus.ask(key, step, 5.0)
    assert len(first) == 1
    assert first == again
    assert simulation.tick == 1
    assert bus.ask(key, encode_step(StepRequest(2, Command())), 5.0)[0].payload != first[0].payload
    assert simulation.tick == 2


def test_a_broken_step_is_refused(stage: Stage) -> None:
    simulation = FakeSimulation(robots=("r0",))
    stage.start(simulation)
    (reply,) = stage.join().ask(KEYS.robot_step("r0"), b"nonsense", 5.0)
    assert reply.error.startswith("step: ")
    assert simulation.tick == 0


def test_a_silent_agent_blocks_the_others_only_for_the_patience(
    stage: Stage, caplog: pytest.LogCaptureFixture
) -> None:
    simulation = FakeSimulation()
    stage.start(simulation, patience=0.6)
    silent = Driver(stage.robot("r1"), 2, lambda _: 0.0)
    lively = Driver(stage.robot("r0"), 20, lambda _: 0.0)
    silent.start()
    lively.start()
    lively.join(10.0)
    assert len(lively.seen) == 20
    assert simulation.tick == 20
    assert [r.message for r in caplog.records] == [
        "robot r1 has not asked for 0.6 s: it stands still until it asks again"
    ]
    # Without a command it stands still.
    assert simulation.truth_at("r1", 3 * TICK_NS) == simulation.truth("r1")
    # It is welcome again.
    silent.join()
    lively.ticks, late = 1, silent.robot
    both = [Driver(late, 1, lambda _: 0.0), Driver(lively.robot, 1, lambda _: 0.0)]
    for driver in both:
        driver.start()
    for driver in both:
        driver.join()
        assert driver.seen[0].stamp_ns == 21 * TICK_NS


@pytest.mark.parametrize("end", ["close", "cut"])
def test_a_dead_agent_blocks_nobody(stage: Stage, end: str) -> None:
    simulation = FakeSimulation()
    stage.start(simulation, patience=60.0)
    bus = stage.join()
    mortal = Driver(RemoteRobot(bus, "test", "r1"), 2, lambda _: 0.0)
    lively = Driver(stage.robot("r0", patience=30.0), 12, lambda _: 0.0)
    mortal.start()
    lively.start()
    mortal.join()
    assert lively.is_alive()
    if end == "close":
        bus.close()
    else:
        stage.hub.cut(bus)
    lively.join(5.0)
    assert not lively.is_alive()
    assert simulation.tick == 12


def test_nothing_happens_until_the_expected_robots_have_asked(stage: Stage) -> None:
    simulation = FakeSimulation(robots=("r0", "r1", "r2"))
    control = stage.start(simulation, expected=2)
    early = Driver(stage.robot("r2"), 1, lambda _: 0.0)
    early.start()
    until(lambda: control.status().robots["r2"].active)
    time.sleep(0.15)
    assert control.status().tick == 0
    second = Driver(stage.robot("r0"), 1, lambda _: 0.0)
    second.start()
    early.join()
    second.join()
    assert simulation.calls == [
        ("advance", {"r0": Command(), "r2": Command()}), ("observe", "r0"), ("observe", "r2"),
    ]  # fmt: skip


def test_control_is_answered_while_nobody_drives(stage: Stage) -> None:
    simulation = FakeSimulation()
    control = stage.start(simulation)
    status = control.status()
    assert (status.tick, status.stamp_ns) == (0, 0)
    assert {name: (r.world_from_robot, r.collisions, r.active) for name, r in status.robots.items()} == {
        "r0": (Pose2(0.0), 0, False),
        "r1": (Pose2(1.0), 1, False),
    }
    assert status.wall["physics"] == 0.5
    assert set(status.wall) == {"physics", "waiting", "replying", "control"}
    assert control.plan() == PLAN
    control.kidnap("r1", Pose2(3.0, 2.0, -1.0))
    assert control.status().robots["r1"].world_from_robot == Pose2(3.0, 2.0, -1.0)


def test_truth_of_the_past(stage: Stage) -> None:
    simulation = FakeSimulation()
    control = stage.start(simulation)
    drivers = [Driver(stage.robot(name), 8, lambda _: 0.0) for name in simulation.robots]
    for driver in drivers:
        driver.start()
    for driver in drivers:
        driver.join()
    stamps, poses = control.trajectory("r1")
    expected_stamps, expected_poses = simulation.trajectory("r1")
    np.testing.assert_array_equal(stamps, expected_stamps)
    np.testing.assert_array_equal(poses, expected_poses)
    asked = [7 * TICK_NS, 0, 3 * TICK_NS]
    assert control.truth_at("r1", asked) == [simulation.truth_at("r1", stamp) for stamp in asked]
    assert control.truth_at("r1", []) == []
    with pytest.raises(InvalidValue, match="was not simulated"):
        control.truth_at("r1", [9 * TICK_NS])
    with pytest.raises(InvalidValue, match="no robot 'r9'; there are r0, r1"):
        control.trajectory("r9")
    (reply,) = stage.join().ask(KEYS.sim_control(), b"\x81", 5.0)
    assert reply.error.startswith("control: ")


def test_a_kidnapped_robot_is_elsewhere_in_the_next_tick_and_its_wheels_know_nothing(stage: Stage) -> None:
    simulation = FakeSimulation(robots=("r0",))
    control = stage.start(simulation)
    robot = stage.robot("r0")
    robot.sense()
    control.kidnap("r0", Pose2(2.0, 2.0, 0.0))
    observation = robot.sense()
    assert observation is not None
    assert observation.odometry == Odometry(0.0, 0.0)
    assert simulation.truth("r0") == Pose2(2.0, 2.0, 0.0)


def test_stop_ends_the_run_and_tells_every_agent(stage: Stage) -> None:
    simulation = FakeSimulation()
    control = stage.start(simulation, farewell=2.0)
    waiting = Driver(stage.robot("r0"), 10**6, lambda _: 0.0)
    thinking = Driver(stage.robot("r1"), 10**6, lambda k: 0.3 if k == 4 else 0.0)
    waiting.start()
    thinking.start()
    until(lambda: simulation.tick == 5)
    control.stop()
    assert stage.thread is not None
    assert stage.bridge is not None
    stage.thread.join(5.0)
    stage.bridge.close()
    for driver in (waiting, thinking):
        driver.join(5.0)
        assert driver.ended
    assert simulation.tick == 5
    with pytest.raises(NotConnected, match=r"sim/control: nobody answers; .*mapweave sim"):
        SimControl(stage.join(), "test", timeout=0.5).status()


def test_who_asks_between_end_and_close_is_refused(stage: Stage) -> None:
    stage.start(FakeSimulation())
    stage.stop.set()
    assert stage.thread is not None
    stage.thread.join(5.0)
    assert stage.robot("r0").sense() is None
    (reply,) = stage.join().ask(KEYS.sim_control(), b"", 1.0)
    assert reply.error == ENDED


def test_the_simulator_is_alive_while_it_serves(stage: Stage) -> None:
    news: list[tuple[str, bool]] = []
    stage.join().watch(KEYS.sim_alive(), lambda key, alive: news.append((key, alive)))
    stage.start(FakeSimulation())
    until(lambda: news == [(KEYS.sim_alive(), True)])
    stage.end()


def drive_real(pace: float) -> list[object]:
    """What two agents see in ten ticks of the real simulation, and where they end."""
    stage = Stage()
    with Simulation(make_office(2, 3), ["r0", "r1"], 2) as simulation:
        try:
            stage.start(simulation)
            drivers = [Driver(stage.robot("r0"), 10, lambda _: pace)]
            drivers.append(Driver(stage.robot("r1"), 10, lambda _: 0.0))
            for driver in drivers:
                driver.start()
            for driver in drivers:
                driver.join()
        finally:
            stage.end()
        seen = [
            (o.stamp_ns, o.odometry, o.proximity.tolist(), None if o.image is None else o.image.tobytes())
            for driver in drivers
            for o in driver.seen
        ]
        return [*seen, simulation.truth("r0"), simulation.truth("r1")]


def test_the_real_simulation_repeats_itself_over_the_bus_whatever_the_agents_speed() -> None:
    first, second = drive_real(0.0), drive_real(0.02)
    assert len(first) == 22
    assert first == second

"""The lock-step over the bus: agents in threads, a simulation without physics, and once with them."""

import time
from collections.abc import Callable, Mapping

import numpy as np
import pytest

from mapweave.agent.drivers.messages import StepRequest, encode_step
from mapweave.agent.drivers.remote import RemoteRobot
from mapweave.agent.observation import Command, Odometry, RobotDescription
from mapweave.sim.simulation import Simulation
from mapweave.sim.worlds.catalog import make_world
from tests.sim.stage import CAMERA, KEYS, TICK_NS, Driver, FakeSimulation, Stage
from tests.waiting import eventually


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


def test_agents_go_in_step_and_their_speed_changes_nothing():
    rng = np.random.default_rng(3)
    uneven = rng.uniform(0, 0.006, (2, 30))
    even, apart = race({"r0": lambda _: 0.0, "r1": lambda _: 0.0})
    slow_first, apart_slow = race({"r0": lambda k: float(uneven[0, k]), "r1": lambda _: 0.0})
    slow_second, apart_second = race({"r1": lambda k: float(uneven[1, k]), "r0": lambda _: 0.001})
    assert even == slow_first == slow_second
    assert max(apart, apart_slow, apart_second) <= 1
    assert even.count(("observe", "r0")) == even.count(("observe", "r1")) == 30


def test_the_first_observation_comes_after_one_tick_in_which_nothing_moves(stage: Stage):
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


def test_a_command_beyond_the_limits_is_clipped_by_the_base_too(stage: Stage):
    simulation = FakeSimulation(robots=("r0",))
    stage.start(simulation)
    stage.join().ask(KEYS.robot_step("r0"), encode_step(StepRequest(1, Command(50.0, -50.0))), 5.0)
    assert simulation.calls[0] == ("advance", {"r0": Command(0.3, -0.8)})


def test_a_repeated_step_gets_the_same_bytes_and_does_not_advance(stage: Stage):
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


def test_a_broken_step_is_refused(stage: Stage):
    simulation = FakeSimulation(robots=("r0",))
    stage.start(simulation)
    (reply,) = stage.join().ask(KEYS.robot_step("r0"), b"nonsense", 5.0)
    assert reply.error.startswith("step: ")
    assert simulation.tick == 0


def test_a_silent_agent_blocks_the_others_only_for_the_patience(stage: Stage, caplog):
    simulation = FakeSimulation()
    stage.start(simulation, patience=1.5)
    silent = Driver(stage.robot("r1"), 2, lambda _: 0.0)
    lively = Driver(stage.robot("r0"), 20, lambda _: 0.0)
    silent.start()
    lively.start()
    lively.join(30.0)
    assert len(lively.seen) == 20
    assert simulation.tick == 20
    assert [r.message for r in caplog.records] == [
        "robot r1 has not asked for 1.5 s: it stands still until it asks again"
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
def test_a_dead_agent_blocks_no_other(stage: Stage, end: str):
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
    lively.join(30.0)
    assert not lively.is_alive()
    assert simulation.tick == 12


def test_nothing_happens_until_all_robots_have_asked(stage: Stage):
    simulation = FakeSimulation(robots=("r0", "r2"))
    control = stage.start(simulation)
    early = Driver(stage.robot("r2"), 1, lambda _: 0.0)
    early.start()
    eventually(lambda: control.status().robots["r2"].active)
    time.sleep(0.15)
    assert control.status().tick == 0
    second = Driver(stage.robot("r0"), 1, lambda _: 0.0)
    second.start()
    early.join()
    second.join()
    assert simulation.calls == [
        ("advance", {"r0": Command(), "r2": Command()}), ("observe", "r0"), ("observe", "r2"),
    ]  # fmt: skip


def drive_real(pace: float) -> list[object]:
    """What two agents see in ten ticks of the real simulation, and where they end."""
    stage = Stage()
    with Simulation(make_world("office", 2, rooms=3), ["r0", "r1"], 2) as simulation:
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


def test_the_simulation_repeats_over_the_bus_at_any_speed_of_the_agents():
    first, second = drive_real(0.0), drive_real(0.02)
    assert len(first) == 22
    assert first == second

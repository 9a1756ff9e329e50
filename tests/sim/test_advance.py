"""Time that passes only on request, and rendezvous of robots between two ticks."""

import threading
import time

import pytest

from mapweave import Command, Pose2
from mapweave.sim.bridge import SimBridge
from mapweave.sim.ground_truth_client import SimControl
from mapweave.sim.lockstep_robot import LockstepRobot
from mapweave.sim.simulation import Simulation
from mapweave.wire.memory import MemoryBus, MemoryHub
from tests.waiting import eventually


class Table:
    """A held simulation on a bare floor, and robots that drive in threads of their own."""

    def __init__(self, world, names):
        self.hub = MemoryHub()
        self.simulation = Simulation(world, names, 0, [Pose2(0.0, 2.0 * k) for k in range(len(names))])
        self.bridge = SimBridge(self.simulation, MemoryBus(self.hub), "test", farewell=0.02, held=True)
        self.stop = threading.Event()
        self.thread = threading.Thread(target=self.bridge.run, args=(self.stop,))
        self.thread.start()
        self.control = SimControl(MemoryBus(self.hub), "test")
        self.events = []
        self.threads = []
        self.meet = set()

    def drive(self, name, pause=0.0):
        robot = LockstepRobot(MemoryBus(self.hub), "test", name)

        def run():
            while (observation := robot.sense()) is not None:
                tick = observation.stamp_ns // 100_000_000
                robot.act(Command(0.1, 0.0))
                time.sleep(pause)
                self.events.append((name, tick, "done"))
                if (name, tick) in self.meet:
                    robot.rendezvous()
                    self.events.append((name, tick, "met"))

        self.threads.append(threading.Thread(target=run))
        self.threads[-1].start()
        # Time passes without a driver that the simulation does not know of yet.
        eventually(lambda: self.control.status().robots[name].active)
        return robot

    def end(self):
        self.stop.set()
        for thread in [self.thread, *self.threads]:
            thread.join(30.0)
            assert not thread.is_alive()
        self.bridge.close()
        self.simulation.close()


@pytest.fixture
def table(bare):
    made = Table(bare, ["r0", "r1"])
    yield made
    made.end()


def test_time_passes_only_on_request(table):
    table.drive("r0")
    table.drive("r1", 0.01)
    time.sleep(0.15)
    assert table.simulation.tick == 0
    assert table.events == []
    for tick in (3, 4, 9):
        assert table.control.advance(tick, 30.0)
        assert table.simulation.tick == tick
        # Every robot has finished with the tick, the slow one too.
        assert {e for e in table.events if e[1] == tick} == {("r0", tick, "done"), ("r1", tick, "done")}
    time.sleep(0.15)
    assert table.simulation.tick == 9
    assert table.control.advance(9, 30.0)


def test_a_client_may_ask_again_after_a_timeout(table):
    table.drive("r0")
    table.drive("r1", 0.05)
    assert not table.control.advance(8, 0.01)
    assert table.control.advance(8, 30.0)
    assert table.simulation.tick == 8


def test_without_any_driver_time_passes_all_the_same(table):
    first = table.drive("r0")
    second = table.drive("r1")
    assert table.control.advance(2, 30.0)
    first.close()
    second.close()
    eventually(lambda: not any(robot.active for robot in table.control.status().robots.values()))
    assert table.control.advance(12, 30.0)
    # They go on by what they wanted last for no tick: who is not driven stands still.
    assert table.control.truth_at("r0", [1_200_000_000])[0].x == pytest.approx(
        table.control.truth_at("r0", [900_000_000])[0].x, abs=1e-3
    )


def test_a_rendezvous_waits_for_the_others_without_time_passing(table):
    table.meet = {("r0", 2), ("r0", 4), ("r1", 4)}
    table.drive("r0")
    table.drive("r1", 0.03)
    assert table.control.advance(6, 30.0)
    for tick in (2, 4):
        mine = table.events.index(("r0", tick, "met"))
        assert table.events.index(("r1", tick, "done")) < mine
        later = [k for k, event in enumerate(table.events) if event[1] > tick]
        assert min(later) > mine
    assert ("r1", 4, "met") in table.events
    stamps, _ = table.simulation.trajectory("r0")
    assert len(stamps) == 7

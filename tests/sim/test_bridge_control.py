"""Who controls the simulation from outside: status, truth, kidnapping, the end."""

import numpy as np
import pytest

from mapweave import Odometry, Pose2, PoseGaussian
from mapweave.agent.drivers.messages import ENDED
from mapweave.hybridmap.errors import InvalidValue, NotConnected
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Landmarks, Node
from mapweave.sim.camera import WEBCAM
from mapweave.sim.ground_truth_client import SimControl
from tests.sim.stage import KEYS, PLAN, TICK_NS, Driver, FakeSimulation, Stage
from tests.waiting import eventually


def node_at(name: tuple[str, int, int], stamp_ns: int) -> Node:
    pose = PoseGaussian.from_sigmas(Pose2(), 0.1, 0.1)
    return Node(NodeId(*name), stamp_ns, pose, WEBCAM, Landmarks.empty())


def test_control_is_answered_without_a_driver(stage: Stage):
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


def test_truth_of_the_past(stage: Stage):
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
    made = [node_at(("r1", 1, 2), 7 * TICK_NS), node_at(("r0", 1, 1), 0), node_at(("r1", 2, 1), 3 * TICK_NS)]
    truth = {node.id: simulation.truth_at(node.id.agent, node.stamp_ns) for node in made}
    assert control.truth_of(made) == truth
    assert control.truth_of([]) == {}
    with pytest.raises(InvalidValue, match="was not simulated"):
        control.truth_at("r1", [9 * TICK_NS])
    with pytest.raises(InvalidValue, match="no robot 'r9'; there are r0, r1"):
        control.trajectory("r9")
    (reply,) = stage.join().ask(KEYS.control(), b"\x81", 5.0)
    assert reply.error.startswith("control: ")


def test_a_kidnapped_robot_is_elsewhere_in_the_next_tick_without_odometry(stage: Stage):
    simulation = FakeSimulation(robots=("r0",))
    control = stage.start(simulation)
    robot = stage.robot("r0")
    robot.sense()
    control.kidnap("r0", Pose2(2.0, 2.0, 0.0))
    observation = robot.sense()
    assert observation is not None
    assert observation.odometry == Odometry(0.0, 0.0)
    assert simulation.truth("r0") == Pose2(2.0, 2.0, 0.0)


def test_every_agent_is_notified_of_the_end(stage: Stage):
    simulation = FakeSimulation()
    stage.start(simulation, farewell=2.0)
    waiting = Driver(stage.robot("r0"), 10**6, lambda _: 0.0)
    thinking = Driver(stage.robot("r1"), 10**6, lambda k: 0.3 if k == 4 else 0.0)
    waiting.start()
    thinking.start()
    eventually(lambda: simulation.tick == 5)
    stage.stop.set()
    assert stage.thread is not None
    assert stage.bridge is not None
    stage.thread.join(30.0)
    stage.bridge.close()
    for driver in (waiting, thinking):
        driver.join(30.0)
        assert driver.ended
    assert simulation.tick == 5
    with pytest.raises(NotConnected, match=r"sim/ground_truth_client: no answer; .*mapweave sim"):
        SimControl(stage.join(), "test", timeout=0.5).status()


def test_questions_between_end_and_close_are_refused(stage: Stage):
    stage.start(FakeSimulation())
    stage.stop.set()
    assert stage.thread is not None
    stage.thread.join(30.0)
    assert stage.robot("r0").sense() is None
    (reply,) = stage.join().ask(KEYS.control(), b"", 1.0)
    assert reply.error == ENDED


def test_the_simulator_is_alive_while_it_serves(stage: Stage):
    news: list[tuple[str, bool]] = []
    stage.join().watch(KEYS.sim_alive(), lambda key, alive: news.append((key, alive)))
    stage.start(FakeSimulation())
    eventually(lambda: news == [(KEYS.sim_alive(), True)])
    stage.end()

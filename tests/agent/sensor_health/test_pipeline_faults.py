"""The whole robot with a sensor that fails: it stands, says which, and goes on by itself when it is back."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from mapweave import Command, HybridMap, MapId, NodeId, Observation, Odometry, Pose2
from mapweave.agent.mapping_monitor import MappingMonitor
from mapweave.agent.mission import Explore, GoTo, ServerAnswer
from mapweave.agent.mission_control import MissionControl
from mapweave.agent.pipeline import Pipeline, TickResult
from mapweave.agent.runner import Runner
from mapweave.agent.sensor_health.sensor_monitor import FIRST_TRIAL, TRIAL_SIDE, SensorFault
from mapweave.hybridmap.agent_status import Status
from mapweave.hybridmap.portal import PortalMeans, PortalStop, PortalWait
from mapweave.sim.simulation import Simulation
from mapweave.sim.worlds.catalog import make_world
from tests.agent.ranged_body import BODY, on, rangers

Break = Callable[[Observation], Observation]
HOUR_NS = 3600 * 10**9


class Frozen:
    """A camera that gives its first image for ever."""

    def __init__(self) -> None:
        self._image: np.ndarray | None = None

    def __call__(self, seen: Observation) -> Observation:
        if self._image is None:
            self._image = seen.image
        return replace(seen, image=self._image)


def run(
    walls, pipeline: Pipeline, pose: Pose2, tick: int, ticks: int, broken: Break
) -> tuple[Pose2, list[TickResult]]:
    """Go on from a pose and a tick. No server answers."""
    steps: list[TickResult] = []
    moved, answers = Odometry(0.0, 0.0), tuple[ServerAnswer, ...]()
    for k in range(tick, tick + ticks):
        seen = Observation(HOUR_NS + k * 100_000_000, moved, walls.render(pose), rangers(pose))
        steps.append(pipeline.step(broken(seen), answers))
        answers = tuple(ServerAnswer(question.number, None, "no answer") for question in steps[-1].questions)
        command = steps[-1].command
        moved = Odometry(command.forward * BODY.tick, command.turn * BODY.tick)
        pose = pose @ moved.motion()
    return pose, steps


@pytest.mark.parametrize(("mission", "broken", "sensor"), [
    (Explore(), Frozen(), "camera"),
    (GoTo(NodeId("r1", 1, 1)), Frozen(), "camera"),
    (Explore(), lambda seen: replace(seen, odometry=Odometry(0.0, 0.0)), "encoders"),
    (Explore(), lambda seen: replace(seen, stamp_ns=seen.stamp_ns - HOUR_NS), "clock"),
], ids=["frozen exploring", "frozen navigating", "dead encoders", "clock jumps back"])  # fmt: skip
def test_it_stands_says_which_and_goes_on(walls, mission, broken, sensor):
    pipeline = on(mission)
    pose, moving = run(walls, pipeline, Pose2(), 0, 12, lambda seen: seen)
    assert any(step.command != Command() for step in moving)
    pose, faulty = run(walls, pipeline, pose, 12, 30, broken)
    first = next(k for k, step in enumerate(faulty) if step.fault is not None)
    assert first <= 20 and faulty[first].fault.sensor == sensor
    assert faulty[first].status.doing == "standing still"
    assert faulty[first].fault.words in faulty[first].status.detail
    standing = [step.command for step in faulty[first:] if step.fault is not None]
    assert set(standing) == {Command()}, "the first trial turn comes later"
    wait = round((FIRST_TRIAL + 3.0 * TRIAL_SIDE) / BODY.tick) + 15
    pose, after = run(walls, pipeline, pose, 42, wait, lambda seen: seen)
    assert after[-1].fault is None and any(step.command != Command() for step in after)


def test_a_robot_whose_encoders_fail_keeps_what_it_has_done_of_its_mission(walls):
    """Before, it waited again at the portal through which it had been taken."""
    entry, beyond, goal = (NodeId("r1", 1, number) for number in (1, 3, 5))
    portal = PortalStop("east lift", PortalMeans.LIFT, entry, beyond, "2", "")
    pipeline = on(GoTo(goal, portal=PortalWait(portal)))
    pose, steps = run(walls, pipeline, Pose2(), 0, 3, lambda seen: seen)
    assert steps[-1].status.portal == PortalWait(portal)
    pipeline.taken_through()
    pose, steps = run(walls, pipeline, pose, 3, 1, lambda seen: replace(seen, odometry=Odometry(5.0, 0.0)))
    assert steps[-1].fault is not None and steps[-1].fault.sensor == "encoders"
    assert steps[-1].status.portal == PortalWait(portal, done=True)


def drive(how: str, seed: int) -> tuple[Pipeline, dict[int, Pose2], list[TickResult], Simulation]:
    """Exploring an office; a sensor fails from 20 s to 30 s."""
    with Simulation(make_world("office", seed, rooms=1), ["r0"], seed) as simulation:
        description, frozen = simulation.describe("r0"), Frozen()
        half = description.axle / 2
        pipeline = Pipeline(MapId("r0", 1), description)
        pipeline.set_mission(Explore())
        command, truth, steps = Command(), dict[int, Pose2](), list[TickResult]()
        for tick in range(450):
            simulation.advance({"r0": command})
            seen = simulation.observe("r0")
            if 200 <= tick < 300:
                o = seen.odometry
                right = o.forward + half * o.turn
                seen = {
                    "frozen": lambda seen=seen: frozen(seen),
                    "dead": lambda seen=seen: replace(seen, odometry=Odometry(0.0, 0.0)),
                    "left": lambda seen=seen, w=right: replace(seen, odometry=Odometry(w / 2, w / 2 / half)),
                }[how]()
            steps.append(pipeline.step(seen))
            command = steps[-1].command
            truth[seen.stamp_ns] = simulation.truth("r0")
        assert simulation.collisions("r0") == 0
    return pipeline, truth, steps, simulation


@pytest.mark.slow
@pytest.mark.parametrize("how", ["frozen", "dead", "left"])
def test_a_simulated_robot_keeps_its_map_sound(how):
    pipeline, truth, steps, _ = drive(how, 1)
    assert not any(step.fault for step in steps[:200]), "no false alarm"
    first = next(k for k, step in enumerate(steps) if step.fault is not None)
    assert first <= 220, "2 s, of which the robot may have stood for one"
    last = steps[first].status.nodes
    assert {step.status.nodes for step in steps[first:300]} == {last}, "no node by what cannot be believed"
    assert steps[-1].fault is None and steps[-1].status.nodes > last
    nodes = pipeline.map.nodes
    for edge in pipeline.map.edges.values():
        true = truth[nodes[edge.a].stamp_ns].inverse() @ truth[nodes[edge.b].stamp_ns]
        # 99.9 % point of chi-square for 3 degrees of freedom.
        assert edge.a_from_b.mahalanobis2(true) < 16.3


class Scripted:
    """A pipeline whose faults are given, and the rest of a robot that does nothing."""

    def __init__(self, *faults: SensorFault | None) -> None:
        self.faults = list(faults)
        self.map = HybridMap()

    def step(self, *_: object) -> TickResult:
        return TickResult(Command(), (), (), Status("idle", "", 0, 0, Pose2(), False), self.faults.pop(0))

    def server_in_reach(self) -> bool:
        return False

    status_period = 0.0

    def driven(self) -> None:
        return None

    def answers(self) -> tuple[object, ...]:
        return ()

    def report(self, *_: object) -> None:
        return None


def test_the_log_has_one_line_when_a_sensor_fails_and_one_when_it_is_back():
    frozen, dead = SensorFault("camera", "it is frozen"), SensorFault("encoders", "they do not count")
    robot, lines = Scripted(None, frozen, frozen, dead, None, None), list[str]()
    parts = MissionControl("r0"), MappingMonitor(BODY)
    runner = Runner(robot, robot, robot, *parts, print_line=lines.append)  # type: ignore[arg-type]
    for tick in range(6):
        runner.tick(Observation(tick * 100_000_000, Odometry(0.0, 0.0)))
    assert lines == ["it is frozen", "they do not count", "believes its encoders again"]

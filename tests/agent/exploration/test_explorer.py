"""Exploration: what others have mapped is not mapped again, and the paper's way by chance."""

import math
from itertools import pairwise

import numpy as np
import pytest

from mapweave import Camera, Edge, EdgeKind, HybridMap, MapId, NodeId, Pose2, PoseGaussian
from mapweave.agent.exploration.behaviours import Phase
from mapweave.agent.exploration.explorer import Explorer
from mapweave.agent.exploration.viewpoint_selection import REACH
from mapweave.agent.mission import Explore, ServerAnswer, WhatIsKnown
from mapweave.agent.observation import Observation, Odometry, RobotDescription
from mapweave.agent.pipeline import Pipeline, TickResult
from mapweave.agent.settings import AgentSettings, ExplorerSettings
from mapweave.hybridmap.query import KnownAnswer
from synthetic.maps import changes_of
from tests.agent.exploration.test_behaviours import View
from tests.agent.test_submap_grid import ROBOT, drawn, drifting_node, drive
from tests.quick import first_quick

MAP = MapId("r0", 1)
BEARINGS = tuple(np.linspace(-math.pi, math.pi, 24, endpoint=False).tolist())
BODY = RobotDescription(
    Camera(320, 240, 277.0, 277.0, 159.5, 119.5, mount_height=0.3), ranger_bearings=BEARINGS, ranger_reach=3.0
)
"""The robot of the photographs, with rangers."""
ALL_AROUND = np.array([[0.1, 0.1, heading, 0.5] for heading in np.arange(-math.pi, math.pi, 0.7)])


def live(
    walls, settings: ExplorerSettings, ticks: int, result: dict[int, ServerAnswer], seed: int = 0
) -> list[TickResult]:
    """Let a pipeline explore a wide room with pictures ahead, with given answers at some ticks."""
    pipeline = Pipeline(MAP, BODY, AgentSettings(exploration=settings, seed=seed))
    pipeline.set_mission(Explore())
    pose, moved, steps = Pose2(), Odometry(0.0, 0.0), []
    # Rangers that always say the same are frozen.
    distances = np.random.default_rng(seed).normal(2.0, 0.01, (ticks, len(BEARINGS)))
    for tick in range(ticks):
        seen = Observation(tick * 100_000_000, moved, walls.render(pose), distances[tick])
        step = pipeline.step(seen, (result[tick],) if tick in result else ())
        moved = Odometry(step.command.forward * BODY.tick, step.command.turn * BODY.tick)
        pose = pose @ moved.motion()
        steps.append(step)
    return steps


def doings(steps: list[TickResult]) -> list[str]:
    """What it did, in order, without repetitions."""
    lines = [step.status.doing for step in steps]
    return [b for a, b in zip([None, *lines], lines, strict=False) if a != b]


def questions(steps: list[TickResult]) -> list[WhatIsKnown]:
    return [q for step in steps for q in step.questions if isinstance(q, WhatIsKnown)]


def test_it_asks_about_its_own_map_and_nothing_waits_for_the_answer(walls):
    steps = live(walls, ExplorerSettings(), 40, {})
    (first, *_) = questions(steps)
    assert (first.map, first.x, first.y) == (MAP, pytest.approx(0.0), pytest.approx(0.0))
    assert first.reach > REACH
    assert first.number < 0, "the navigator's questions are positive"
    silent = live(walls, ExplorerSettings(ask_fleet=False), 40, {})
    assert questions(silent) == []
    assert [step.command for step in steps] == [step.command for step in silent]


@pytest.mark.parametrize("error", first_quick(["no map server answered", "no key known"], 1))
def test_no_answer_changes_nothing(walls, error):
    steps = live(walls, ExplorerSettings(), 40, {1: ServerAnswer(-1, None, error)})
    assert [step.command for step in steps] == [
        step.command for step in live(walls, ExplorerSettings(), 40, {})
    ]


def test_it_does_not_map_places_that_others_have_covered(walls):
    alone = doings(live(walls, ExplorerSettings(), 12, {}))
    assert alone[:2] == [Phase.LOOKING, Phase.DRIVING]
    result = live(walls, ExplorerSettings(), 12, {0: ServerAnswer(-1, KnownAnswer(ALL_AROUND, ""))})
    assert doings(result)[1] == Phase.SCANNING
    half = live(walls, ExplorerSettings(), 12, {0: ServerAnswer(-1, KnownAnswer(ALL_AROUND[:4], ""))})
    assert doings(half)[1] == Phase.DRIVING
    far = ALL_AROUND + np.array([2.0, 0.0, 0.0, 0.0])
    elsewhere = live(walls, ExplorerSettings(), 12, {0: ServerAnswer(-1, KnownAnswer(far, ""))})
    assert doings(elsewhere)[1] == Phase.DRIVING


def turns(steps: list[TickResult]) -> list[float]:
    """Side of each turn between two views: 1 to the left, -1 to the right."""
    sides, turning = [], False
    for step in steps:
        now = step.status.doing == Phase.TURNING and step.command.turn != 0.0
        if now and not turning:
            sides.append(math.copysign(1.0, step.command.turn))
        turning = now
    return sides


@pytest.mark.slow
def test_the_papers_way_turns_to_a_side_by_chance_and_goes_on_by_chance(walls):
    by_chance = ExplorerSettings(random=True)
    steps = live(walls, by_chance, 250, {})
    sides = turns(steps)
    assert len(sides) >= 3
    assert set(sides) == {1.0, -1.0}
    assert Phase.TRAVELLING in doings(steps)
    assert questions(steps) == []
    commands = [step.command for step in steps]
    assert commands[:50] == [step.command for step in live(walls, by_chance, 50, {})]
    assert commands[:150] != [step.command for step in live(walls, by_chance, 150, {}, seed=1)]


@pytest.mark.slow
def test_our_exploration_turns_all_the_way_around(walls):
    sides = turns(live(walls, ExplorerSettings(), 250, {}))
    assert len(sides) >= 3
    assert len(set(sides)) == 1


class Mapped(View):
    """A mapper that has driven around a block, and has a map whose nodes drift."""

    def __init__(self, closed: bool) -> None:
        super().__init__()
        self.true, self.taken = drive()
        kept = range(0, len(self.taken), 10)
        nodes = [drifting_node(k, self.taken[k]) for k in kept]
        ways = [(a, b, self.taken[a].inverse() @ self.taken[b]) for a, b in pairwise(kept)]
        if closed:
            ways.append((0, kept[-1], self.true[0].inverse() @ self.true[kept[-1]]))
        edges = [
            Edge(NodeId("r0", 1, 9000 + k), nodes[a // 10].id, nodes[b // 10].id,
                 PoseGaussian.from_sigmas(pose, 0.01, 0.002), EdgeKind.LOOP)
            for k, (a, b, pose) in enumerate(ways)
        ]  # fmt: skip
        self.pose, self.known = self.taken[-1], HybridMap(changes_of(nodes, edges))

    @property
    def map(self) -> HybridMap:
        return self.known

    @property
    def last(self) -> NodeId | None:
        return max(self.known.nodes)


@pytest.mark.parametrize("closed", [False, True])
def test_where_it_was_moves_with_the_map_when_a_loop_closes(closed):
    """Behind a loop its places and views lie where they are as seen from it, not where its way puts them."""
    mapper, (floor, *_) = Mapped(closed), drawn()
    explorer = Explorer(MAP, ROBOT, mapper, floor, ExplorerSettings(ask_fleet=False))  # type: ignore[arg-type]
    first = NodeId("r0", 1, 0)
    explorer._places = [(first, np.array([0.0, 0.0])), (None, np.array([1.0, 1.0]))]
    explorer._correct_drift()
    been = list(explorer._been())
    start = mapper.taken[-1] @ mapper.true[-1].inverse() @ mapper.true[0]
    off = float(np.linalg.norm(been[0] - [start.x, start.y]))
    assert off < 0.15 if closed else off > 0.5
    assert (been[1] == [1.0, 1.0]).all(), "what was before the first node stays"
    assert explorer._own_views[0, :2] == pytest.approx(been[0])


def test_a_loop_that_no_node_closes_is_closed_before_it_is_done(monkeypatch):
    """Before, a robot that had seen all around a ring was complete, and its map had two open ends."""
    monkeypatch.setattr("mapweave.agent.exploration.explorer.next_viewpoint", lambda *_: [])
    (floor, *_) = drawn()
    closed, open_ = (
        Explorer(MAP, ROBOT, Mapped(c), floor, ExplorerSettings(ask_fleet=False))  # type: ignore[arg-type]
        for c in (True, False)
    )
    assert closed._way_on() == []
    (*_, end) = open_._way_on()
    assert np.linalg.norm(end) < 3.0, "to where it has begun"
    assert open_._way_on() == [], "once"

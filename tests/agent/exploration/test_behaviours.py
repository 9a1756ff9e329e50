"""The moves of exploration, of a robot that moves just as commanded."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import pytest

from mapweave import Command, HybridMap, MapId, NodeId, Observation, Odometry
from mapweave.agent.exploration.avoided_places import FIRST, MOST
from mapweave.agent.exploration.behaviours import (
    DRIVE,
    LEAST_TURN,
    STUCK_PAUSE,
    ExplorationBehaviours,
    Phase,
)
from mapweave.agent.exploration.explorer import Explorer
from mapweave.agent.mapping.episode import Move
from mapweave.agent.settings import ExplorerSettings
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from tests.agent.ranged_body import BEARINGS, BODY

FREE = np.full(len(BEARINGS), BODY.ranger_reach)


@dataclass
class View:
    """What behaviours read of a mapper that sees features ahead."""

    pose: Pose2 = field(default_factory=Pose2)
    anchor: Pose2 = field(default_factory=Pose2)
    anchor_features: int = 40
    anchored: int = 3
    bearings: Array = field(default_factory=lambda: np.linspace(-0.2, 0.2, 40))

    @property
    def anchor_from_robot(self) -> Pose2:
        return self.anchor.inverse() @ self.pose

    @property
    def map_from_robot(self) -> PoseGaussian:
        return PoseGaussian(self.pose, np.zeros((3, 3)))

    @property
    def last(self) -> NodeId | None:
        return None

    def finish_pending(self) -> None:
        """It makes no nodes."""

    @property
    def map(self) -> HybridMap:
        return HybridMap()

    @property
    def started(self) -> bool:
        return True


def test_a_robot_whose_wheels_are_stuck_stands_and_tries_again():
    """Before, it turned for ever, and its motors with it."""
    view, first, longest = View(), *STUCK_PAUSE
    moves = ExplorationBehaviours(BODY, view, ExplorerSettings())  # type: ignore[arg-type]
    moves.see(Observation(0, Odometry(0.0, 0.0), None, FREE))

    def turns() -> Iterator[Move]:
        while True:
            yield from moves.turn_to_next_view(1.0)

    behaviour, commanded, stood, pauses = turns(), 0.0, 0, list[float]()
    for _ in range(round(3600.0 / BODY.tick)):
        move = next(behaviour)
        assert moves.phase in (Phase.TURNING, Phase.STUCK)
        if moves.phase is Phase.STUCK:
            assert move == Command()
            stood += 1
        elif isinstance(move, Command):
            commanded += move.turn * BODY.tick
            pauses += [stood * BODY.tick] if stood else []
            stood = 0
    assert "3 turns in a row had no effect" not in moves.detail  # it counts on
    assert pauses[:5] == pytest.approx([first, 2 * first, 4 * first, 8 * first, longest], abs=2.0)
    assert commanded < 40.0, "seldom in an hour"
    # Pushed while it stands, it goes on at once.
    while moves.phase is not Phase.STUCK:
        next(behaviour)
    view.pose = Pose2(0.2)
    ticks = 0
    while moves.phase is Phase.STUCK:
        next(behaviour)
        ticks += 1
    assert ticks <= 2


def test_what_blocks_the_way_for_a_while_is_tried_again(monkeypatch):
    """Before, a place before which a person stood was avoided for good, and the map remained without it."""
    goal, tried, view = np.array([4.0, 0.0]), list[float](), View(anchor_features=0)

    def only_goal(floor: object, position: Array, visited: Array, *rest: object) -> list[Array]:
        away = np.linalg.norm(visited - goal, axis=1).min()
        return [goal] if away >= 1.7 and np.linalg.norm(position - goal) > 0.1 else []

    monkeypatch.setattr("mapweave.agent.exploration.explorer.next_viewpoint", only_goal)

    def explore(free_from: float) -> Explorer:
        tried.clear()
        view.pose = view.anchor = Pose2()
        explorer = Explorer(MapId("r0", 1), BODY, view, None, ExplorerSettings(ask_fleet=False))  # type: ignore[arg-type]
        before = explorer.phase
        for tick in range(9000):
            now = tick * BODY.tick
            blocked = now < free_from and view.pose.x > 1.0
            explorer.see(Observation(0, Odometry(0.0, 0.0), None, FREE))
            move = explorer.next_move()
            while not isinstance(move, Command):
                view.anchor = view.pose
                move = explorer.next_move()
            if explorer.phase is Phase.TRAVELLING and before is not Phase.TRAVELLING:
                tried.append(now)
            before = explorer.phase
            if not (blocked and move.forward):
                view.pose = view.pose @ Odometry(move.forward * BODY.tick, move.turn * BODY.tick).motion()
            if explorer.finished:
                break
        return explorer

    reached = explore(free_from=100.0)
    assert reached.finished and np.linalg.norm(np.array([view.pose.x, view.pose.y]) - goal) < 0.2
    assert len(tried) in (2, 3)
    given_up = explore(free_from=1e9)
    assert given_up.finished, "a wall is not tried for ever"
    assert len(tried) == MOST and all(b - a >= FIRST for a, b in pairwise(tried))


@pytest.mark.parametrize("tick", [0.1, 0.05, 0.02])
def test_a_drive_comes_back_and_a_turn_ends_at_any_rate_of_ticks(tick: float):
    """Before, a drive had 64 ticks: at 20 Hz it ended half way, and no depth had converged."""
    body, view = replace(BODY, tick=tick), View()
    moves = ExplorationBehaviours(body, view, ExplorerSettings())  # type: ignore[arg-type]
    moves.see(Observation(0, Odometry(0.0, 0.0), None, FREE))

    def follow(behaviour: Iterator[Move]) -> list[Pose2]:
        way = [view.pose]
        for move in behaviour:
            if isinstance(move, Command):
                view.pose = view.pose @ Odometry(move.forward * tick, move.turn * tick).motion()
                way.append(view.pose)
        return way

    drive = follow(moves.map_view())
    assert max(pose.x for pose in drive) == pytest.approx(DRIVE, abs=0.02)
    assert drive[-1].x == pytest.approx(0.0, abs=0.03)
    turn = follow(moves.turn_to_next_view(1.0))
    assert LEAST_TURN <= turn[-1].heading < LEAST_TURN + 0.1

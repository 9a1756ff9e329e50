"""The moves of exploration, of a robot that moves just as commanded."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from mapweave.agent.exploration.behaviours import DRIVE, LEAST_TURN, ExplorationBehaviours
from mapweave.agent.mapping.episode import Move
from mapweave.agent.observation import Command, Observation, Odometry
from mapweave.agent.settings import ExplorerSettings
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from tests.agent.ranged_body import BEARINGS, BODY

FREE = np.full(len(BEARINGS), BODY.ranger_reach)


@dataclass
class View:
    """What behaviours read of a mapper that sees features ahead."""

    pose: Pose2 = field(default_factory=Pose2)
    anchor_features: int = 40
    anchored: int = 3
    bearings: Array = field(default_factory=lambda: np.linspace(-0.2, 0.2, 40))

    @property
    def anchor_from_robot(self) -> Pose2:
        return self.pose

    @property
    def map_from_robot(self) -> PoseGaussian:
        return PoseGaussian(self.pose, np.zeros((3, 3)))


@pytest.mark.parametrize("tick", [0.1, 0.05, 0.02])
def test_a_drive_comes_back_and_a_turn_ends_at_any_rate_of_ticks(tick: float) -> None:
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

"""When a carried robot makes nodes: rule by rule, and on photographs hung on walls."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from mapweave import Command, MapId, Pose2
from mapweave.agent.exploration import carried_mapping
from mapweave.agent.exploration.carried_mapping import CarriedMapping
from mapweave.agent.mapping.episode import EpisodeRequest
from mapweave.agent.mapping.mapper import Mapper
from mapweave.hybridmap.change import NodePut


@dataclass
class Stage:
    """A mapper that only says what the test wants."""

    anchor_from_robot: Pose2 = field(default_factory=Pose2)
    anchored: int = 100
    anchor_features: int = 100
    converged_share: float = 0.0
    typical_depth: float = 2.0
    started: bool = True


def tick(mapping: CarriedMapping) -> list[EpisodeRequest]:
    """What it asks of the mapper in a tick. The wheels are not its business."""
    moves = list(iter(mapping.next_move, Command()))
    assert all(isinstance(move, EpisodeRequest) for move in moves)
    return moves


@pytest.mark.parametrize(("stage", "node"), [
    (Stage(Pose2()), False),
    (Stage(Pose2(0.49), converged_share=0.9), False),
    (Stage(Pose2(0.51), converged_share=0.9), True),
    (Stage(Pose2(0.3, -0.45), converged_share=0.7), True),
    (Stage(Pose2(0.51), converged_share=0.69), False),
    (Stage(Pose2(0, 0, -0.36), converged_share=0.7), True),
    (Stage(Pose2(0, 0, 0.34), converged_share=0.9), False),
    (Stage(Pose2(0.05), anchored=44), True),
    (Stage(Pose2(0.05), anchored=46), False),
    (Stage(Pose2(0, 0, 0.11), anchored=10), True),
    (Stage(Pose2(0.03), anchored=10), False),
    (Stage(Pose2(0.05), anchored=15, anchor_features=20), True),
    (Stage(Pose2(0.05), anchored=16, anchor_features=20), False),
])  # fmt: skip
def test_a_node_is_made_when_the_view_is_known_or_leaving(stage, node):
    assert tick(CarriedMapping(stage)) == [EpisodeRequest.FINISH] * node


def test_limits_are_heeded(monkeypatch):
    stage = Stage(Pose2(0.3), converged_share=0.5)
    assert not tick(CarriedMapping(stage))
    monkeypatch.setattr(carried_mapping, "CONVERGED", 0.4)
    monkeypatch.setattr(carried_mapping, "DEPTH_STEP", 0.1)
    assert tick(CarriedMapping(stage))


def test_without_an_image_it_waits():
    stage = Stage(started=False)
    mapping = CarriedMapping(stage)
    assert mapping.detail == "no image yet"
    assert tick(mapping) == tick(mapping) == [EpisodeRequest.BEGIN]
    stage.started = True
    assert not tick(mapping)


def test_problems_of_the_view_are_reported():
    mapping = CarriedMapping(Stage(anchor_features=3, anchored=2))
    tick(mapping)
    assert mapping.detail == "only 3 features in view"


def carried(walls, description, poses):
    """The nodes that a carried robot makes, and its mapper."""
    mapper = Mapper(MapId("r0", 1), description)
    mapping = CarriedMapping(mapper)
    changes, before = [], poses[0]
    for number, pose in enumerate(poses):
        observation = walls.observe(before, pose, number)
        mapper.step(observation)
        while isinstance(move := mapping.next_move(), EpisodeRequest):
            mapper.meet(move, observation)
        changes += mapper.take_changes()
        before = pose
    return changes, mapper, mapping


def test_a_drive_along_the_walls_becomes_a_chain_of_nodes(walls, description):
    poses = [Pose2(x) for x in np.arange(0.0, 1.3, 0.025)]
    changes, mapper, mapping = carried(walls, description, poses)
    nodes = [change.node for change in changes if isinstance(change, NodePut)]
    assert len(nodes) >= 2
    assert len(mapper.map.components()) == 1
    for node in nodes:
        true = poses[round(node.stamp_ns / 1e8)]
        assert node.map_from_robot.mean.distance(true) < 0.03
        assert abs(node.map_from_robot.mean.heading) < 0.02
    assert "features left after" in mapping.detail


def test_a_robot_that_stands_still_makes_no_node(walls, description):
    changes, mapper, _ = carried(walls, description, [Pose2()] * 25)
    assert changes == []
    assert mapper.started


def test_a_blank_wall_makes_no_node_and_is_reported(walls, description):
    poses = [Pose2(-x, 0, np.pi) for x in np.arange(0.0, 0.8, 0.05)]
    changes, _, mapping = carried(walls, description, poses)
    assert changes == []
    assert mapping.detail == "only 0 features in view"

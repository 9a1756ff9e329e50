"""Who maps when, and what the floor sees of it."""

from dataclasses import replace

import pytest

from mapweave import MapId, Odometry, Pose2
from mapweave.agent.calibration.online import OnlineCalibration
from mapweave.agent.map_making import MapMaking
from mapweave.agent.mapping.mapper import Mapper
from mapweave.agent.settings import AgentSettings
from mapweave.hybridmap.change import NodePut


def test_the_floor_sees_a_node_that_is_put_again_once(walls, description, monkeypatch):
    """Its image shows no more free floor, nor more obstacles, when its lengths are corrected."""
    node = walls.mapped(Mapper(MapId("r0", 1), description))
    made = MapMaking(MapId("r0", 1), OnlineCalibration(description), AgentSettings())
    seen: list[int] = []
    monkeypatch.setattr(made.floor, "see_node", lambda one: seen.append(one.id.number))
    for _ in range(2):
        made.mapper.drove(None, node)
        assert made.take_changes() == (NodePut(node),)
    assert seen == [node.id.number]


@pytest.mark.parametrize(("lever_error", "losses"), [(0.0, 1), (10.0, 0)])
def test_wheels_that_images_contradict_in_a_turn_lose_no_pose_while_the_camera_may_stand_elsewhere(
    lever_error: float, losses: int, walls, description, monkeypatch
):
    """As far as it may stand elsewhere by the calibration; whether it does is not its business here."""
    monkeypatch.setattr(OnlineCalibration, "lever_error", lever_error)
    made = MapMaking(MapId("r0", 1), OnlineCalibration(description), AgentSettings())
    true = Pose2()
    for tick in range(60):
        step = Odometry(0.02, 0.012)
        # Once depths are known, the wheels spin.
        seen = walls.observe(true, true := true @ step.motion(), tick + 1)
        seen = replace(seen, odometry=Odometry(0.02 if tick < 25 else 0.08, 0.012))
        made.step(made.calibration.correct(seen), (), alone=False, blind=False, held=False)
    assert made.losses == losses


def test_a_drive_by_hand_that_ends_in_the_middle_of_an_episode_leaves_a_node(walls, description):
    """One that has not moved leaves none: it knows no depths."""
    for steps, nodes in ((1, 0), (8, 1)):
        made = MapMaking(MapId("r0", 1), OnlineCalibration(description), AgentSettings())
        true = Pose2()
        for tick in range(steps):
            seen = walls.observe(true, true := true @ Pose2(0.02), tick + 1)
            made.step(made.calibration.correct(seen), (), alone=False, blind=False, held=False)
        assert not made.mapper.map.nodes, "the episode has not ended"
        made.finish()
        assert len(made.mapper.map.nodes) == nodes
        assert made.finish() == (), "and none twice"

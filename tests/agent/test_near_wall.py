"""Surprises that once bent a map: a wall much nearer than expected, and a place that looks like another."""

from types import SimpleNamespace

import numpy as np
import pytest

from mapweave import Camera, Command, HybridMap, Landmarks, MapId, Node, NodeId, Pose2, PoseGaussian
from mapweave.agent.mapping import loop_closures
from mapweave.agent.mapping.loop_closures import LoopClosures
from mapweave.agent.mapping.mapper import Mapper
from mapweave.hybridmap.change import NodePut
from mapweave.sim.simulation import Simulation
from mapweave.sim.worlds.catalog import make_world

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, 0.3)


@pytest.mark.parametrize(("seed", "aside"), [(3, 0.0), (3, 0.9), (4, 1.2), (5, 0.3)])
def test_backing_away_from_a_near_wall_is_no_slip(seed, aside):
    """Landmarks at 0.3 m where 2.4 m are expected move eight times as fast as they should."""
    world = make_world("office", seed)
    room = world.plan.rooms[0]
    start = Pose2(room.x + aside, room.y - room.width / 2 + 0.30, -np.pi / 2 + 0.1)
    with Simulation(world, ["r0"], seed, [start]) as simulation:
        mapper = Mapper(MapId("r0", 1), simulation.describe("r0"))
        observation = simulation.step({})["r0"]
        mapper.step(observation)
        mapper.begin(observation)
        anchor, worst = simulation.truth("r0"), 0.0
        for tick in range(25):
            command = Command(-0.1 if tick < 20 else 0.0, 0.0)
            mapper.step(simulation.step({"r0": command})["r0"])
            true = anchor.inverse() @ simulation.truth("r0")
            worst = max(worst, mapper.anchor_from_robot.distance(true))
        assert true.x < -0.15
    assert worst < 0.02


def node(number: int, pose: PoseGaussian) -> Node:
    empty = Landmarks.empty()
    return Node(NodeId("r0", 1, number), number, pose, CAMERA, empty)


@pytest.mark.parametrize(("off", "closed"), [(0.0, True), (0.05, True), (0.6, False), (1.8, False)])
def test_a_loop_must_agree_with_the_way_there(monkeypatch, off, closed):
    """Shelves look alike: a recognition that is sure of itself, one bay off, is no loop."""
    along = PoseGaussian.from_sigmas(Pose2(3.0, 0.5, 0.4), 0.05, 0.02)
    earlier = PoseGaussian.from_sigmas(Pose2(2.0, 1.0, -0.7), 0.3, 0.1)
    back = PoseGaussian.from_sigmas(along.mean.inverse() @ Pose2(0.4, 0.1, 0.1), 0.05, 0.02)
    later = earlier @ along @ back
    closures = LoopClosures(HybridMap([NodePut(node(1, earlier))]), lambda: NodeId("r0", 1, 9))
    way = earlier.mean.inverse() @ later.mean
    result = PoseGaussian.from_sigmas(Pose2(way.x - off, way.y, way.heading), 0.02, 0.005)
    recognition = SimpleNamespace(
        node_from_robot=result, pairs=np.zeros((0, 2), np.int64), evidence={"sigma_xy": 0.02, "inliers": 29.0}
    )
    monkeypatch.setattr(loop_closures, "register", lambda *arguments: recognition)
    edges = closures.edges(node(5, later))
    assert bool(edges) == closed

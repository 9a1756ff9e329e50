"""What is in a robot's way: where it is, and which of its own edges lead past it."""

import math

import numpy as np
import pytest

from mapweave.agent.localization.fix import Fix
from mapweave.agent.navigation.obstruction import MARGIN, NO_PROGRESS, Obstruction, obstruction
from mapweave.agent.navigation.route_source import onboard_route
from mapweave.agent.observation import Observation, Odometry
from mapweave.agent.robots_in_view import RobotBeside
from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import EdgeId, MapId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import Obstacle
from tests.agent.scripted_fleet import BODY, FREE, IMAGE, WALL_AHEAD, A
from tests.mapserver.test_reservations import place_node

FIX = Fix(A, PoseGaussian(Pose2(1.0, 2.0, math.pi / 2), 1e-4 * np.eye(3)))
"""One metre before node A, two to its left, turned to the left."""
AHEAD = Pose2(1.0, 0.0)


def seen(
    proximity: np.ndarray, touched: str = "", beside: RobotBeside | None = None, to_goal: float = 3.0
) -> Obstruction:
    observation = Observation(0, Odometry(0.0, 0.0), IMAGE, proximity)
    return obstruction(BODY, observation, FIX, AHEAD, to_goal, touched, beside)


def test_a_robot_on_the_straight_way_is_the_obstacle_and_one_beside_it_is_only_named():
    words, obstacle = seen(FREE, beside=RobotBeside(0.1, "r7", 0.5, 0.1, 0.2))
    assert words == "no progress; r7 is 0.1 m off"
    assert obstacle is not None and (obstacle.node, obstacle.robot) == (A, "r7")
    assert (obstacle.x, obstacle.y) == pytest.approx((1.0 - 0.1, 2.0 + 0.5)), "in the node's frame"
    assert obstacle.reach == pytest.approx(BODY.radius + 0.2 + MARGIN)
    behind = seen(FREE, beside=RobotBeside(0.1, "r7", -0.6, 0.0, 0.2))
    assert behind.obstacle is None and "r7" in behind.words


def test_what_is_near_is_right_before_the_robot_and_leaves_the_robot_outside():
    _, obstacle = seen(WALL_AHEAD)
    assert obstacle is not None and obstacle.robot == ""
    assert (obstacle.x, obstacle.y) == pytest.approx((1.0, 2.0 + BODY.radius + MARGIN))
    assert obstacle.reach < math.dist((obstacle.x, obstacle.y), (1.0, 2.0))
    assert seen(FREE, touched="a box").obstacle == obstacle
    assert seen(FREE) == (NO_PROGRESS, None)


def test_within_its_own_length_of_the_goal_only_another_robot_is_an_obstacle():
    words, obstacle = seen(WALL_AHEAD, to_goal=2.0 * BODY.radius)
    assert obstacle is None and "0.06 m off" in words
    beside = RobotBeside(0.1, "r7", 0.5, 0.1, 0.2)
    assert seen(WALL_AHEAD, "", beside, 2.0 * BODY.radius).obstacle is not None


def test_the_own_map_leads_around_a_place_whichever_edges_pass_it():
    """A corridor of three parallel edges a few centimetres apart, and a way round of 6 m."""
    me, places = MapId("a", 1), [(0, 0), (3, 0), (0, 0.1), (3, 0.1), (0, -0.1), (3, -0.1), (0, 1.5), (3, 1.5)]
    joints = [(0, 1), (2, 3), (4, 5), (0, 2), (0, 4), (1, 3), (1, 5), (0, 6), (6, 7), (7, 1)]
    nodes = [place_node(NodeId(*me, k + 1), (float(x), float(y))) for k, (x, y) in enumerate(places)]
    edges = []
    for k, (a, b) in enumerate(joints):
        relative = nodes[a].map_from_robot.mean.inverse() @ nodes[b].map_from_robot.mean
        pose = PoseGaussian(relative, 1e-4 * np.eye(3))
        edges.append(EdgePut(Edge(EdgeId(*me, k + 1), nodes[a].id, nodes[b].id, pose, EdgeKind.DRIVEN)))
    own = HybridMap([*map(NodePut, nodes), *edges])

    def way(*obstacles: Obstacle) -> list[int]:
        legs = onboard_route(own, nodes[0].id, nodes[1].id, (), obstacles).legs
        return [leg.node.id.number - 1 for leg in legs]

    spot = Obstacle(nodes[6].id, 1.5, -1.5, 0.3)
    assert way() == [0, 1] and way(spot) == [0, 6, 7, 1]
    assert way(Obstacle(NodeId("z", 1, 1), 1.5, 0.0, 9.0)) == [0, 1], "a place that it does not know"
    assert way(spot, Obstacle(nodes[6].id, 1.5, 0.0, 0.3)) == []

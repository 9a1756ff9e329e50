"""The plot of a kidnapping on made-up maps: its rules, one by one."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from mapweave import Camera, Edge, EdgeKind, HybridMap, Landmarks, Node, NodeId, Pose2, PoseGaussian
from mapweave.hybridmap.change import EdgePut, EdgeRetired, NodePut
from mapweave.scenarios.kidnap_planning import (
    CLEARANCE,
    LEAST_LANDMARKS,
    NEAR,
    NothingToShow,
    plan_kidnapping,
)
from mapweave.sim.floorplan import BuildingPlan, Rectangle

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, 0.3)
PLAN = BuildingPlan(
    (
        Rectangle.spanning(0, 2, 4, 6, "room 0"),
        Rectangle.spanning(4, 2, 8, 6, "room 1"),
        Rectangle.spanning(8, 2, 12, 6, "room 2"),
        Rectangle.spanning(0, 0, 12, 2, "corridor"),
    ),
    (Rectangle.spanning(3.95, 2, 4.05, 6), Rectangle.spanning(7.95, 2, 8.05, 6)),
    (Rectangle(5.0, 5.0, 0.8, 0.8),),
)


def a_map(where: dict[str, list[tuple[float, float]]], landmarks: int = LEAST_LANDMARKS):
    """The merged map, its components and the truth, of robots that made nodes at places."""
    rng = np.random.default_rng(0)
    truth = {
        NodeId(agent, 1, k + 1): Pose2(x, y, float(rng.uniform(-3, 3)))
        for agent, places in where.items()
        for k, (x, y) in enumerate(places)
    }
    seen = Landmarks(
        np.zeros((landmarks, 2), np.float32), np.zeros((landmarks, 32), np.uint8),
        np.ones(landmarks, np.float32), np.ones(landmarks, np.float32),
    )  # fmt: skip
    here = PoseGaussian.from_sigmas(Pose2(), 0.1, 0.1)
    merged = HybridMap(NodePut(Node(n, 0, here, CAMERA, seen)) for n in truth)
    for k, (a, b) in enumerate(combinations(truth, 2)):
        merged.apply(EdgePut(Edge(NodeId("r0", 1, 1000 + k), a, b, here, EdgeKind.MAPPED)))
    return merged, dict.fromkeys(truth, 0), truth


EACH_ITS_ROOM = {
    "r0": [(2, 3), (2, 5), (1, 1)],
    "r1": [(6, 3), (6, 4), (6, 1)],
    "r2": [(10, 3), (10, 5), (10, 1)],
}


def plot(
    where=None, robots=("r0", "r1", "r2"), occupied=(), seed=0, landmarks=LEAST_LANDMARKS, components=None
):
    merged, joined, truth = a_map(where or EACH_ITS_ROOM, landmarks)
    joined |= components or {}
    return plan_kidnapping(
        merged, joined, truth, PLAN, robots, {f"r{k}": pose for k, pose in enumerate(occupied)}, seed
    ), truth


@pytest.mark.parametrize("seed", range(25))
def test_the_rules_are_kept(seed):
    standing = [Pose2(2, 4), Pose2(6, 3.5), Pose2(10, 4)]
    plan, truth = plot(occupied=standing, seed=seed)
    place = plan.world_from_robot
    in_room = {n.agent for n, p in truth.items() if PLAN.room_at(p.x, p.y) == plan.room}
    assert in_room == {plan.host}, "only the host has mapped it"
    assert plan.robot != plan.host
    assert plan.goal.agent not in (plan.robot, plan.host)
    goal = truth[plan.goal]
    assert PLAN.room_at(goal.x, goal.y) not in (plan.room, "corridor")
    assert PLAN.clearances(np.array([[place.x, place.y]]))[0] >= CLEARANCE
    hosts = [p for n, p in truth.items() if n.agent == plan.host and PLAN.room_at(p.x, p.y) == plan.room]
    assert min(place.distance(p) for p in hosts) <= NEAR
    assert min(place.distance(p) for p in standing) > 0.6


def test_seeds_choose_and_the_same_seed_chooses_the_same():
    plots = [plot(seed=seed)[0] for seed in range(30)]
    assert {p.robot for p in plots} == {"r0", "r1", "r2"}
    assert {p.room for p in plots} == {"room 0", "room 1", "room 2"}
    assert plot(seed=7)[0] == plots[7]


def test_with_two_robots_the_goal_may_be_its_own():
    where = {"r0": [(2, 3), (1, 1)], "r1": [(6, 3), (6, 1)]}
    goals = set()
    for seed in range(20):
        plan, truth = plot(where, ("r0", "r1"), seed=seed)
        assert plan.robot != plan.host
        goal = truth[plan.goal]
        assert PLAN.room_at(goal.x, goal.y) not in (plan.room, "corridor")
        goals.add(plan.goal.agent == plan.robot)
    assert True in goals


def test_a_goal_in_the_corridor_is_the_last_resort():
    plan, truth = plot({"r0": [(2, 3)], "r1": [(6, 3)], "r2": [(10, 1)]}, robots=("r0", "r1"))
    goal = truth[plan.goal]
    assert plan.goal.agent == "r2"
    assert PLAN.room_at(goal.x, goal.y) == "corridor"


@pytest.mark.parametrize("case", [
    {"where": {"r0": [(2, 3)], "r1": [(2, 4)], "r2": [(2, 5)]}},
    {"where": {"r0": [(2, 1)], "r1": [(6, 1)], "r2": [(10, 1)]}},
    {"landmarks": LEAST_LANDMARKS - 1},
    {"components": {NodeId(f"r{k}", 1, n): k for k in range(3) for n in (1, 2, 3)}},
    {"where": {"r0": [(2, 3)]}, "robots": ("r0",)},
],
ids=["all in one room", "only in the corridor", "poor views", "maps that did not join", "alone"])  # fmt: skip
def test_impossible_kidnappings_are_reported(case):
    with pytest.raises(NothingToShow, match="no room is known to one robot alone"):
        plot(**case)


def test_a_room_without_a_free_place_is_reported():
    everywhere = [Pose2(x, y) for x in np.arange(0, 12.2, 0.5) for y in np.arange(2, 6.2, 0.5)]
    with pytest.raises(NothingToShow, match="no free place near the nodes of such a room"):
        plot(occupied=everywhere)


def test_nodes_without_truth_play_no_part():
    merged, components, truth = a_map(EACH_ITS_ROOM)
    stranger = replace(next(iter(merged.nodes.values())), id=NodeId("r2", 1, 50))
    merged.apply(NodePut(stranger))
    plan = plan_kidnapping(merged, components, truth, PLAN, ("r0", "r1", "r2"), {}, 3)
    assert plan.goal in truth


def test_a_goal_that_the_others_cut_off_is_none():
    """r0 is in the only gap between the two halves of a hall: no robot is sent through it."""
    hall = BuildingPlan(
        (Rectangle.spanning(0, 0, 4, 4, "room 0"), Rectangle.spanning(4, 0, 8, 4, "room 1")),
        (Rectangle.spanning(3.95, 0, 4.05, 1.6), Rectangle.spanning(3.95, 2.4, 4.05, 4)),
    )
    merged, components, truth = a_map({"r0": [(1, 1), (2, 2)], "r1": [(6, 1), (6, 3)]})
    robots = ("r0", "r1")
    aside = {"r0": Pose2(1, 3), "r1": Pose2(7, 3)}
    plan = plan_kidnapping(merged, components, truth, hall, robots, aside, 3)
    assert plan.robot in robots
    in_the_gap = {name: Pose2(4.0, 2.0) for name in ("r0", "r1")}
    with pytest.raises(NothingToShow, match="leave a way"):
        plan_kidnapping(merged, components, truth, hall, robots, in_the_gap, 3)


def test_a_goal_whose_only_mapped_way_is_blocked_is_not_chosen():
    """There is room to drive around a robot on the way, but it is not mapped."""
    hall = BuildingPlan(
        (Rectangle.spanning(0, 0, 4, 6, "room 0"), Rectangle.spanning(4, 0, 8, 6, "room 1")), ()
    )
    merged, components, truth = a_map({"r0": [(1, 3)], "r1": [(5, 3), (7, 3)]})
    aside = {"r0": Pose2(1, 1), "r1": Pose2(7, 1)}
    assert plan_kidnapping(merged, components, truth, hall, ("r0",), aside, 3).goal.agent == "r0"
    between = {"r0": Pose2(1, 1), "r1": Pose2(3, 3)}
    with pytest.raises(NothingToShow, match="leave a way"):
        plan_kidnapping(merged, components, truth, hall, ("r0",), between, 3)
    for edge in list(merged.edges):
        merged.apply(EdgeRetired(edge))
    with pytest.raises(NothingToShow, match="leave a way"):
        plan_kidnapping(merged, components, truth, hall, ("r0",), aside, 3)

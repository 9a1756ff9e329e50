"""The navigation benchmark: shortest ways against geometry, starts and goals keep their word, figures."""

import math
from dataclasses import replace

import networkx as nx
import numpy as np
import pytest

from benchmarks.navigate.benchmark import summary
from benchmarks.navigate.drives import PATIENCE, NavigationOutcome, _reason, drive
from benchmarks.navigate.floor import FreeFloor
from benchmarks.navigate.office import Mapped
from benchmarks.navigate.plots import LEAST_EDGES, Plot, draw_plot
from mapweave import HybridMap, MapId, MissionKind, NodeId
from mapweave.evaluation.map_score import crossed
from mapweave.hybridmap.agent_status import AgentStatus, Status
from mapweave.hybridmap.drive_statistics import DriveStatistics
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Pose2, wrap_angle
from mapweave.sim.floorplan import BuildingPlan, Rectangle
from mapweave.sim.ground_truth_messages import RobotStatus, SimStatus
from mapweave.sim.snapshot import Snapshot
from synthetic.maps import changes_of
from synthetic.world import room, take_map

RADIUS = 0.17
WALL = Rectangle.spanning(2.9, 0.0, 3.1, 3.0, "wall")
PLAN = BuildingPlan((Rectangle.spanning(0, 0, 6, 4, "room"),), (WALL,))
"""A room with a wall from the south that leaves 1 m at the north."""


@pytest.fixture(scope="module")
def floor() -> FreeFloor:
    return FreeFloor.of(PLAN, RADIUS)


@pytest.fixture(scope="module")
def mapped() -> Mapped:
    """Ten nodes west of the wall, in a chain."""
    rng = np.random.default_rng(1)
    truth = [Pose2(0.5 + 0.2 * k, 0.6 + 0.25 * k, 0.7 * k) for k in range(10)]
    nodes, edges = take_map(room(0, 0, 2.9, 4, 900, rng), MapId("r0", 1), truth, rng)
    contents = HybridMap(changes_of(nodes, edges))
    return Mapped(contents, {node.id: pose for node, pose in zip(nodes, truth, strict=True)})


def test_the_shortest_way_leads_around_the_corner(floor: FreeFloor):
    """Against the taut string around the wall's two corners, at the robot's radius."""
    start, goal = Pose2(1.5, 1.0), Pose2(4.5, 1.0)
    corners = np.array([[2.9, 3.0], [3.1, 3.0]])

    def taut(a: np.ndarray, corner: np.ndarray) -> tuple[float, float]:
        """Length of the tangent from a point to the circle, and the angle where it touches."""
        reach = float(np.linalg.norm(corner - a))
        return math.sqrt(reach**2 - RADIUS**2), math.acos(RADIUS / reach)

    left = np.array([start.x, start.y])
    length, touch = taut(left, corners[0])
    toward = math.atan2(*(left - corners[0])[::-1])
    arc = wrap_angle(toward - touch - math.pi / 2)
    expected = 2 * (length + RADIUS * abs(arc)) + 0.2
    route = floor.ways_from(start).to(goal)
    assert expected - 0.06 <= route <= 1.03 * expected + 0.06


def test_free_ways_are_about_straight_and_symmetric(floor: FreeFloor):
    rng = np.random.default_rng(0)
    for _ in range(20):
        a, b = (Pose2(*rng.uniform((0.3, 0.3), (2.6, 3.7))) for _ in range(2))
        there, back = floor.ways_from(a).to(b), floor.ways_from(b).to(a)
        assert there == pytest.approx(back, abs=1e-9)
        assert a.distance(b) - 1e-9 <= there <= 1.03 * a.distance(b) + 0.08


def test_no_way_leads_into_a_wall_or_outside(floor: FreeFloor):
    assert math.isinf(floor.ways_from(Pose2(1.0, 1.0)).to(Pose2(8.0, 1.0)))
    assert math.isinf(floor.ways_from(Pose2(-3.0, 1.0)).to(Pose2(1.0, 1.0)))
    closed = BuildingPlan(PLAN.rooms, (Rectangle.spanning(2.9, 0.0, 3.1, 4.0),))
    assert math.isinf(FreeFloor.of(closed, RADIUS).ways_from(Pose2(1.0, 1.0)).to(Pose2(5.0, 1.0)))


def test_plots_are_valid_pictures(mapped: Mapped, floor: FreeFloor):
    starts = set()
    for seed in range(20):
        plot = draw_plot(mapped, PLAN, floor, np.random.default_rng(seed))
        start = plot.world_from_robot
        starts.add(start)
        assert PLAN.is_free(start.x, start.y, 0.3)
        for taken in mapped.truth.values():
            turned = abs(wrap_angle(start.heading - taken.heading))
            assert start.distance(taken) >= 0.15 or turned >= math.radians(15)
        beside = min(mapped.truth, key=lambda node: mapped.truth[node].distance(start))
        assert nx.shortest_path_length(mapped.nodes.graph(), beside, plot.goal) == plot.edges >= LEAST_EDGES
        line = np.array([[mapped.truth[beside].x, mapped.truth[beside].y], [start.x, start.y]])
        assert not crossed(line[:1], line[1:], PLAN.walls)[0]
        assert plot.shortest >= start.distance(plot.world_from_goal)
    assert len(starts) == 20, "another seed is another start"


def test_a_map_that_is_too_small_is_refused(mapped: Mapped, floor: FreeFloor):
    few = sorted(mapped.truth)[:LEAST_EDGES]
    small = Mapped(mapped.nodes, {node: mapped.truth[node] for node in few})
    for too_small in (small, Mapped(HybridMap(), {})):
        with pytest.raises(InvalidValue, match="explore for longer"):
            draw_plot(too_small, PLAN, floor, np.random.default_rng(0))


def outcome(mapped: Mapped, **other: object) -> NavigationOutcome:
    goal = max(mapped.truth)
    plot = Plot(Pose2(0.5, 0.5), goal, mapped.truth[goal], 5, 2.0)
    status = Status("parked at the goal", "", 10, 0, Pose2(), True, drive=DriveStatistics(4, 1, 2, 0))
    picture = np.zeros((4, 4), np.uint8)
    one = NavigationOutcome(
        plot, status, "", 1.0, 30.0, 0.004, 0.3, 0, 3.0, (), picture, picture, np.zeros((2, 2))
    )
    return replace(one, **other)  # type: ignore[arg-type]


def test_figures_count_failures_as_such(mapped: Mapped):
    away = Status("driving along the route", "", 10, 0, Pose2(), False, drive=DriveStatistics(1, 0, 1, 3))
    outcomes = [
        outcome(mapped),
        outcome(mapped, error_m=0.006, driven=2.2),
        outcome(mapped, status=away, reason="not there", error_m=3.0, collisions=2, found_s=None),
    ]
    figures = summary(outcomes)
    assert figures["success"] == pytest.approx(2 / 3, abs=1e-4) and figures["arrived"] == 2
    assert figures["goal_error_m_median"] == 0.005, "who never arrived has no goal error, but no success"
    assert figures["collisions"] == 2 and figures["path_over_shortest"] == pytest.approx(1.3)
    assert (figures["edges_driven"], figures["nodes_skipped"]) == (9, 2)
    assert (figures["relocalizations"], figures["blocks"]) == (5, 3)
    failed = summary(outcomes[2:])
    assert failed["success"] == 0.0 and failed["goal_error_m_median"] is None


def test_a_drive_fails_for_each_reason(mapped: Mapped):
    there, away = outcome(mapped).status, Status("looking around", "dark", 1, 0, Pose2(), False)
    assert _reason(there, 0.01, 1.0, 0) == ""
    assert "touched" in _reason(there, 0.01, 1.0, 1)
    assert "looking around; dark" in _reason(away, 0.01, 1.0, 0)
    assert "says that it has arrived" in _reason(there, 0.2, 1.0, 0)
    assert "says that it has arrived" in _reason(there, 0.01, 20.0, 0)


class FakeOffice:
    """Time passes; the robot finds itself after 1 s and drives 0.1 m a second along x, to x = 3 at most."""

    def __init__(self, arrives: bool) -> None:
        self.ticks, self.arrives, self.going = 40, arrives, False
        self.control = self
        self.begin = 0
        self.poses = [Pose2()] * 41
        self.collisions = 3

    def command(self, kind: MissionKind, node: NodeId | None = None) -> None:
        self.going, self.begin = kind is MissionKind.GO, self.ticks

    def kidnap(self, robot: str, pose: Pose2) -> None:
        self.poses[-1] = pose

    def advance(self, seconds: float) -> AgentStatus:
        for _ in range(round(10 * seconds)):
            step = 0.01 if self.going and self.ticks - self.begin > 10 else 0.0
            pose = self.poses[-1]
            self.poses.append(Pose2(min(pose.x + step, 3.0), pose.y, pose.heading))
            self.ticks += 1
        there = self.arrives and self.poses[-1].x == 3.0
        lost = not self.going or self.ticks - self.begin < 10
        status = Status(
            "parked" if there else "looking" if lost else "driving", "so far", 5, 0, Pose2(), there,
            fix_node=None if lost else NodeId("r0", 1, 1),
        )  # fmt: skip
        return AgentStatus(status, 0)

    def status(self) -> SimStatus:
        return SimStatus(self.ticks, 0, {"r0": RobotStatus(self.poses[-1], self.collisions, True)})

    def trajectory(self, robot: str) -> tuple[np.ndarray, np.ndarray]:
        return np.arange(self.ticks + 1), np.array([pose.vector for pose in self.poses])

    def snapshot(self) -> Snapshot:
        seen = np.full((4, 4), round(10 * self.poses[-1].x), np.uint8)
        return Snapshot(self.ticks, 0, {"r0": self.poses[-1]}, (), (), {"r0": seen})


@pytest.mark.parametrize("arrives", [True, False])
def test_a_drive_is_timed_measured_and_ended(arrives: bool):
    office = FakeOffice(arrives)
    plot = Plot(Pose2(1.0, 0.0), NodeId("r0", 1, 9), Pose2(3.01, 0.0, 0.02), 5, 1.6)
    one = drive(office, plot, lambda now, doing: None)  # type: ignore[arg-type]
    assert one.found_s == 1.0 and one.collisions == 0
    assert one.driven == pytest.approx(2.0) and one.path_over_shortest == pytest.approx(1.25)
    assert (one.error_m, one.error_deg) == pytest.approx((0.01, math.degrees(0.02)), abs=1e-3)
    assert one.desired[0, 0] == 30 and one.reached[0, 0] == 30
    assert [words.split(":")[0] for _, words in one.events][:2] == ["looking", "driving"]
    if arrives:
        assert one.success and one.time_s == pytest.approx(21.5, abs=0.6)
    else:
        assert "not there within 240 s: driving" in one.reason and one.time_s == PATIENCE

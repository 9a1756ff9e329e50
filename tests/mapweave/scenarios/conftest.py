"""A trial that never was: robots that drive through three rooms, with maps as good as one wants them."""

import math
from dataclasses import dataclass, field

import numpy as np
import pytest

from mapweave import Camera, Edge, EdgeKind, Landmarks, MapFile, MapId, Node, NodeId, Pose2, PoseGaussian
from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.scenarios.recording import (
    Lost,
    RecordedLocalization,
    RobotRecord,
    TrialEvent,
    TrialRecording,
    TrialTrajectory,
)
from mapweave.sim.floorplan import BuildingPlan, Rectangle

TICK_NS = 100_000_000
span = Rectangle.spanning
PLAN = BuildingPlan(
    rooms=(
        span(0, 0, 12, 2, "corridor"), span(0, 2.2, 5.9, 6, "room 0"), span(6.1, 2.2, 12, 6, "room 1"),
        span(2, 2, 3, 2.2, "door 0"), span(9, 2, 10, 2.2, "door 1"),
    ),
    walls=(
        span(-0.2, -0.2, 12.2, 0), span(-0.2, 6, 12.2, 6.2), span(-0.2, 0, 0, 6), span(12, 0, 12.2, 6),
        span(5.9, 2.2, 6.1, 6), span(0, 2, 2, 2.2), span(3, 2, 9, 2.2), span(10, 2, 12, 2.2),
    ),
    furniture=(Rectangle(1.2, 5.2, 1.2, 0.7, 0.2, "table"), Rectangle(10.9, 3.1, 0.6, 0.6, 0.5, "box")),
)  # fmt: skip


@dataclass
class Staged:
    """What a trial is made of; every list may be changed before `recording` is called.

    Attributes:
        noise: of the estimates, m.
        truth: of each robot, one pose a tick.
        nodes: of the merged map: (component, merged pose, stamp).
        edges: of the merged map.
    """

    noise: float
    truth: dict[str, TrialTrajectory] = field(default_factory=dict)
    nodes: dict[NodeId, tuple[int, Pose2, int]] = field(default_factory=dict)
    edges: list[Edge] = field(default_factory=list)
    lost: list[Lost] = field(default_factory=list)
    moments: list[TrialEvent] = field(default_factory=list)

    def pose(self, robot: str, tick: int) -> Pose2:
        """Where a robot truly was."""
        return Pose2.from_vector(self.truth[robot].poses[tick])

    def add_node(self, robot: str, tick: int, merged: Pose2, component: int = 0, epoch: int = 1) -> NodeId:
        """A node of the merged map."""
        number = sum(n.map == (robot, epoch) for n in self.nodes) + 1
        node = NodeId(robot, epoch, number)
        self.nodes[node] = component, merged, tick * TICK_NS
        return node

    def add_edge(self, a: NodeId, b: NodeId, a_from_b: Pose2, kind: EdgeKind) -> Edge:
        """An edge of the merged map."""
        number = 1000 + len(self.edges)
        edge = Edge(NodeId("s0", 1, number), a, b, PoseGaussian.from_sigmas(a_from_b, 0.05, 0.02), kind)
        self.edges.append(edge)
        return edge

    def true_pose(self, node: NodeId) -> Pose2:
        """Where a node's image was taken."""
        return self.pose(node.agent, self.nodes[node][2] // TICK_NS)

    def relative(self, a: NodeId, b: NodeId) -> Pose2:
        """The true `a_from_b`."""
        return self.true_pose(a).inverse() @ self.true_pose(b)

    def recording(self, seed: int = 3, sim_s: float = 60.0, wall_s: float = 15.0) -> TrialRecording:
        """All of it."""
        rng = np.random.default_rng(5)
        robots = {}
        for k, (name, truth) in enumerate(self.truth.items()):
            map_from_world = Pose2(1.0 + k, -2.0, 0.7 * k).inverse()
            poses = np.array([(map_from_world @ Pose2.from_vector(p)).vector for p in truth.poses[10:400]])
            poses += rng.normal(0.0, 1.0, poses.shape) * [self.noise, self.noise, self.noise]
            estimates = {MapId(name, 1): TrialTrajectory(truth.stamps_ns[10:400], poses)}
            robots[name] = RobotRecord(truth, estimates, k, 1000 * (k + 1), 5000 * (k + 1), 0, f"{k:064x}")
        changes = [
            NodePut(Node(n, stamp, PoseGaussian.from_sigmas(p, 0.1, 0.1), CAMERA, Landmarks.empty()))
            for n, (_, p, stamp) in self.nodes.items()
        ] + [EdgePut(edge) for edge in self.edges]
        placements = {n: (c, PoseGaussian.from_sigmas(p, 0.1, 0.1)) for n, (c, p, _) in self.nodes.items()}
        merged = MapFile("merged", "a merged map", tuple(changes), placements)
        return TrialRecording(
            "staged", seed, robots, PLAN, merged, tuple(self.lost), tuple(self.moments), (), sim_s, wall_s,
            {"render": 4.0, "physics": 2.0},
        )  # fmt: skip


CAMERA = Camera(width=320, height=240, fx=277.0, fy=277.0, cx=159.5, cy=119.5, mount_height=0.3)


def drive(centre: tuple[float, float], phase: float, ticks: int = 600) -> TrialTrajectory:
    """Rounds of a corridor-sized oval, a new one every 30 s, with a slow turn of the whole."""
    t = np.arange(ticks) / 10.0
    angle = phase + t * math.tau / 30.0
    x, y = centre[0] + 1.6 * np.cos(angle), centre[1] + 0.7 * np.sin(angle)
    heading = np.arctan2(np.gradient(y), np.gradient(x))
    return TrialTrajectory(np.arange(ticks, dtype=np.int64) * TICK_NS, np.stack([x, y, heading], axis=1))


def stage() -> Staged:
    """Two robots in the corridor and one in room 1; the corridor's maps are linked, all is true to 1 cm."""
    rng = np.random.default_rng(7)
    staged = Staged(noise=0.01)
    staged.truth = {"r0": drive((3, 1), 0.0), "r1": drive((4, 1), 1.0), "r2": drive((9, 4), 0.3)}
    merged_from_world = Pose2(4.0, -1.0, 1.2).inverse()
    for robot in staged.truth:
        last = None
        for tick in range(20, 400, 20):
            merged = merged_from_world @ staged.pose(robot, tick) @ Pose2(*rng.normal(0, 0.01, 3))
            node = staged.add_node(robot, tick, merged, component=int(robot == "r2"))
            if last is not None:
                staged.add_edge(last, node, staged.relative(last, node), EdgeKind.MAPPED)
            last = node
    first, again = NodeId("r0", 1, 1), NodeId("r0", 1, 16)
    staged.add_edge(first, again, staged.relative(first, again), EdgeKind.LOOP)
    for k in (2, 6, 9):
        a, b = NodeId("r0", 1, k), NodeId("r1", 1, k)
        staged.add_edge(a, b, staged.relative(a, b), EdgeKind.MERGED)
    return staged


def stage_events(staged: Staged) -> Staged:
    """The same, and r1 is carried into room 1, finds out where it is, and drives to r2's third place."""
    goal, known = NodeId("r2", 1, 3), NodeId("r2", 1, 5)
    put = Pose2(7.5, 3.0, 0.5)
    poses = staged.truth["r1"].poses
    end = staged.true_pose(goal) @ Pose2(0.01, -0.02, math.radians(1.0))
    share = np.linspace(0.0, 1.0, 150)[:, None]
    poses[421:571] = put.vector * (1 - share) + end.vector * share
    poses[571:] = end.vector
    true = staged.pose("r1", 450)
    answer = staged.true_pose(known).inverse() @ true @ Pose2(0.03, 0.04, math.radians(2.0))
    staged.lost.append(
        Lost(
            "r1",
            "room 1",
            420 * TICK_NS,
            put,
            goal,
            RecordedLocalization(450 * TICK_NS, known, answer),
            580 * TICK_NS,
            4,
        )
    )
    staged.moments += [
        TrialEvent(200 * TICK_NS, "the network of r2 is cut | for a while"),
        TrialEvent(420 * TICK_NS, "r1 is put down at (7.50, 3.00)"),
    ]
    return staged


@pytest.fixture
def staged() -> Staged:
    """Two robots in the corridor and one in room 1."""
    return stage()


@pytest.fixture
def eventful(staged: Staged) -> Staged:
    """The same, and r1 is carried into room 1."""
    return stage_events(staged)

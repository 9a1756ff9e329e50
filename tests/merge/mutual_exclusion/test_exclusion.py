"""Two robots in one place at one time: found where it is so, never where robots only meet."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse
from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Landmarks, Node
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from mapweave.hybridmap.ranges import Ranges
from mapweave.hybridmap.trajectory_segment import MOST, TrajectorySegment
from mapweave.merge.mutual_exclusion import encounter
from mapweave.merge.mutual_exclusion.collision import Collision
from mapweave.merge.mutual_exclusion.exclusion import chances_clear, collision_of
from mapweave.merge.mutual_exclusion.trajectories import RobotTrajectory, trajectories_of
from mapweave.merge.pose_graph.solved_graph import PoseGraph
from mapweave.merge.settings import ExclusionSettings

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, 0.3)


class Walk:
    """A robot that goes from node to node in a room, straight, stopping and going as it likes.

    Attributes:
        times: (N,) s, of the nodes.
        truth: (T, 2) m, where it really was, every 0.1 s.
    """

    def __init__(self, rng: np.random.Generator, nodes: int = 40, way: Array | None = None) -> None:
        self.times = np.cumsum(rng.uniform(3.0, 5.0, nodes))
        way = wander(rng, nodes) if way is None else way
        self.ticks = np.arange(0, self.times[-1], 0.1)
        leg = np.clip(np.searchsorted(self.times, self.ticks, side="right") - 1, 0, nodes - 2)
        share = (self.ticks - self.times[leg]) / (self.times[leg + 1] - self.times[leg])
        rests = rng.uniform(0, 0.25, (nodes, 2))[leg]
        share = np.clip((share - rests[:, 0]) / (1 - rests.sum(axis=1)), 0, 1)
        self.truth = way[leg] + share[:, None] * (way[leg + 1] - way[leg])
        self.way = way

    def segment(self, node: int) -> TrajectorySegment:
        """Where it was each second until the next node, beside a node that looks east."""
        end = self.times[node + 1] if node + 1 < len(self.times) else self.times[node]
        times = np.arange(self.times[node] + 1.0, end, 1.0)[:MOST]
        places = [np.interp(times, self.ticks, self.truth[:, k]) - self.way[node, k] for k in range(2)]
        poses = np.stack([*places, np.zeros(len(times))], axis=1)
        return TrajectorySegment(times - self.times[node], poses, np.zeros((len(times), 0)))

    def moved(self, by: Array) -> None:
        self.truth, self.way = self.truth + by, self.way + by


def wander(rng: np.random.Generator, nodes: int) -> Array:
    """(N, 2) m, places in a room of 4 by 3 m."""
    way = [rng.uniform([0, 0], [4, 3])]
    while len(way) < nodes:
        angle = rng.uniform(-np.pi, np.pi)
        place = way[-1] + rng.uniform(0.0, 0.7) * np.array([np.cos(angle), np.sin(angle)])
        if (place > 0).all() and (place < [4, 3]).all():
            way.append(place)
    return np.array(way)


def apart(a: Walk, b: Walk) -> Array:
    """(T,) m, true distances."""
    n = min(len(a.truth), len(b.truth))
    return np.hypot(*(a.truth[:n] - b.truth[:n]).T)


def trajectories(
    a: Walk, b: Walk, clocks: tuple[str, str] = ("net", "net"), agents: str = "ab",
    radii: tuple[float, float] = (0.0, 0.0), segments: bool = False,
) -> list[RobotTrajectory]:  # fmt: skip
    collected = []
    for k, walk in enumerate((a, b)):
        nodes = [
            Node(NodeId(agents[k], k, i), round(time * 1e9), PoseGaussian(Pose2(), np.zeros((3, 3))), CAMERA,
                 Landmarks.empty(), clocks[k], radii[k], Ranges(),
                 walk.segment(i) if segments else TrajectorySegment())
            for i, time in enumerate(walk.times)
        ]  # fmt: skip
        collected += trajectories_of(nodes)
    return collected


def graph(a: Walk, b: Walk, rng: np.random.Generator, agents: str = "ab", sigma: float = 0.02) -> PoseGraph:
    """Both walks as they were mapped: each node off by 1 cm, b as a whole by `sigma`; the graph knows."""
    ids = [NodeId(agents[0], 0, k) for k in range(len(a.way))] + [
        NodeId(agents[1], 1, k) for k in range(len(b.way))
    ]
    means = np.zeros((len(ids), 3))
    means[:, :2] = np.concatenate([a.way, b.way]) + rng.normal(0, 0.01, (len(ids), 2))
    means[len(a.way) :, :2] += rng.normal(0, sigma, 2)
    information = np.tile([1, 1, 1e4], len(ids)) / (0.01**2 + sigma**2 / 2)
    return PoseGraph(ids[0], tuple(ids), means, scipy.sparse.csc_matrix(scipy.sparse.diags(information)))


def twins(seed: int) -> tuple[Walk, Walk, np.random.Generator]:
    """Two robots that do much the same in rooms that look the same, laid over each other."""
    rng = np.random.default_rng(seed)
    a = Walk(rng)
    b = Walk(rng, way=a.way + rng.normal(0, 0.05, a.way.shape))
    b.times = a.times + rng.uniform(-0.5, 0.5, len(a.times))
    return a, b, rng


def collision_on(a: Walk, b: Walk, rng: np.random.Generator, **how: tuple[str, str]) -> Collision | None:
    first, second = trajectories(a, b, **how)
    return collision_of(graph(a, b, rng), first, second)


@pytest.mark.parametrize("seed", range(3))
def test_twins_clash_and_the_reason_has_numbers(seed: int):
    a, b, rng = twins(seed)
    collision = collision_on(a, b, rng)
    assert collision is not None and collision.evidence > 10 and collision.nearest < 0.1
    assert collision.reason.startswith("a and b would have been at the same place at the same time: 0.0")
    assert f"{collision.time:.1f} s of clock net, {collision.moments} such moments" in collision.reason


def test_it_is_the_same_from_either_side():
    a, b, rng = twins(4)
    first, second = trajectories(a, b)
    whole = graph(a, b, rng)
    forth, back = collision_of(whole, first, second), collision_of(whole, second, first)
    assert forth is not None and back is not None
    assert back == replace(forth, first="b", second="a", evidence=back.evidence)
    assert np.isclose(forth.evidence, back.evidence, rtol=0.1)


def scarce(seed: int, late: float) -> tuple[Walk, Walk, np.random.Generator]:
    """Two robots that do much the same, so late one after the other, and make a node all 16 seconds only."""
    rng = np.random.default_rng(seed)
    a = Walk(rng, 80)
    b = Walk(rng, way=a.way + rng.normal(0, 0.03, a.way.shape))
    for walk, more in ((a, 0.0), (b, late)):
        walk.times = (a.times + more)[::4]
        walk.ticks, walk.truth, walk.way = a.ticks + more, a.truth, walk.way[::4]
    b.truth = b.truth + rng.normal(0, 0.01, 2)
    return a, b, rng


@pytest.mark.parametrize("seed", range(3))
def test_trajectory_segments_fill_gaps_between_nodes(seed: int):
    """Between nodes the robots' poses are unknown, without trajectory segments."""
    a, b, rng = scarce(seed, 0.7)
    whole = graph(a, b, rng)
    collision = collision_of(whole, *trajectories(a, b, segments=True))
    assert collision is not None and collision.evidence > 10 and collision.nearest < 0.15
    bare = collision_of(whole, *trajectories(a, b))
    assert bare is None or bare.evidence < collision.evidence / 2


def test_moments_of_segments_move_with_their_nodes():
    """Against poses composed one by one; a view is a moment of its own, and times ascend."""
    rng = np.random.default_rng(6)
    nodes, means = [], rng.uniform(-3, 3, (5, 3))
    for k in range(5):
        ages, poses = np.sort(rng.uniform(-1, 9, k)), rng.uniform(-1, 1, (k, 3))
        nodes.append(
            Node(NodeId("a", 1, k), round(1e10 * (k + 1)), PoseGaussian(Pose2(), np.zeros((3, 3))), CAMERA,
                 Landmarks.empty(), "net", 0.2, Ranges(), TrajectorySegment(ages, poses, np.zeros((k, 0))))
        )  # fmt: skip
    (trajectory,) = trajectories_of(list(reversed(nodes)))
    ids = tuple(node.id for node in nodes)
    pose = trajectory.poses(PoseGraph(ids[0], ids, means, scipy.sparse.eye(15, format="csc")))
    expected = [
        (10.0 * (k + 1) + age, k, (Pose2(*means[k]) @ Pose2(*beside)).vector)
        for k, node in enumerate(nodes)
        for age, beside in [
            (0.0, np.zeros(3)),
            *zip(node.segment.ages, node.segment.node_from_robot, strict=True),
        ]
    ]
    expected.sort(key=lambda row: row[0])
    assert trajectory.times == pytest.approx([time for time, _, _ in expected])
    assert trajectory.nodes == tuple(ids[k] for _, k, _ in expected)
    assert pose[:, :2] == pytest.approx(np.array([vector[:2] for _, _, vector in expected]))
    assert np.exp(1j * pose[:, 2]) == pytest.approx(np.exp([1j * vector[2] for _, _, vector in expected]))


def test_no_evidence_without_a_common_clock():
    a, b, rng = twins(0)
    assert collision_on(a, b, rng, clocks=("net", "own")) is None
    assert trajectories(a, b, clocks=("", "")) == []
    late = Walk(np.random.default_rng(1), way=b.way)
    late.times = late.times + 1000.0
    assert collision_on(a, late, rng) is None


def test_a_robot_does_not_clash_with_itself():
    a, b, rng = twins(0)
    first, second = trajectories(a, b, agents="aa")
    assert collision_of(graph(a, b, rng, agents="aa"), first, second) is None


def test_a_moment_or_two_prove_nothing():
    """One of the poses may be wrong: two robots that are far apart but for one node."""
    a, b, rng = twins(0)
    b.moved(np.array([5.0, 0.0]))
    b.way[10] = a.way[10]
    assert collision_on(a, b, rng) is None


def test_unknown_poses_are_no_evidence():
    """Every other node is far away in time, so that the straight line between nodes means nothing."""
    a, b, rng = twins(0)
    a.times = 4.0 * a.times
    b.times = a.times + 6.0
    assert collision_on(a, b, rng) is None


@settings(max_examples=30, deadline=None)
@given(
    st.integers(0, 10**6), st.sampled_from(["follows", "wanders"]), st.sampled_from([0.005, 0.02, 0.04]),
    st.booleans(),
)  # fmt: skip
def test_robots_that_meet_closely_are_not_refused(seed: int, manner: str, sigma: float, segments: bool):
    """They come as near as 0.35 m, centre to centre, repeatedly: footprints of 0.3 m and a hand between."""
    rng = np.random.default_rng(seed)
    a = Walk(rng)
    way = a.way + rng.normal(0, 0.1, a.way.shape) if manner == "follows" else None
    b = Walk(rng, way=way)
    angle = rng.uniform(-np.pi, np.pi)
    step = 0.02 * np.array([np.cos(angle), np.sin(angle)])
    while apart(a, b).min() < 0.35:
        b.moved(step)
    first, second = trajectories(a, b, segments=segments)
    assert collision_of(graph(a, b, rng, sigma=sigma), first, second) is None


@pytest.mark.slow
@pytest.mark.parametrize("segments", [False, True])
def test_robots_that_nearly_touch_rarely_count_as_collisions(segments: bool, monkeypatch):
    """The bound holds even for footprints exactly as small as supposed: here at 0.2 m, with loose doubt."""
    monkeypatch.setattr(encounter, "LEAST_WINDOWS", 1)
    s = ExclusionSettings(doubt=0.1)
    refused = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        a = Walk(rng)
        b = Walk(rng, way=a.way + rng.normal(0, 0.1, a.way.shape))
        while apart(a, b).min() < 0.2:
            b.moved(np.array([0.02, 0.0]))
        refused += collision_of(graph(a, b, rng), *trajectories(a, b, segments=segments), s) is not None
    assert refused <= 10


def test_known_radii_decide_the_least_distance():
    """Two that pass at 0.25 m: small ones may, large ones cannot, and one of unknown radius may be small."""
    rng = np.random.default_rng(8)
    a = Walk(rng)
    b = Walk(rng, way=a.way + np.array([0.25, 0.0]) + rng.normal(0, 0.03, a.way.shape))
    b.times = a.times
    whole = graph(a, b, rng)
    collision = collision_of(whole, *trajectories(a, b, radii=(0.2, 0.2)))
    assert collision is not None and collision.nearest > 0.15
    for radii in ((0.04, 0.04), (0.0, 0.0), (0.4, 0.0)):
        assert collision_of(whole, *trajectories(a, b, radii=radii)) is None
    tiny = ExclusionSettings(least_apart=0.4)
    assert collision_of(whole, *trajectories(a, b, radii=(0.04, 0.04)), tiny) is None
    assert collision_of(whole, *trajectories(a, b), tiny) is not None


def test_probabilities_agree_with_monte_carlo():
    rng = np.random.default_rng(3)
    offsets = rng.uniform(-0.3, 0.3, (20, 2))
    roots = rng.normal(0, 0.07, (20, 2, 2))
    spreads = roots @ roots.transpose(0, 2, 1)
    shifts = rng.uniform(0, 0.05, 20)
    chances = chances_clear(offsets, shifts, spreads, 0.2)
    for offset, shift, spread, chance in zip(offsets, shifts, spreads, chances, strict=True):
        centre = offset * (1 + shift / np.hypot(*offset))
        samples = rng.multivariate_normal(centre, spread + 1e-4 * np.eye(2), 20000)
        assert abs((np.hypot(*samples.T) >= 0.2).mean() - chance) < 0.05
    assert chances_clear(np.zeros((1, 2)), np.zeros(1), np.zeros((1, 2, 2)), 0.2)[0] < 0.02

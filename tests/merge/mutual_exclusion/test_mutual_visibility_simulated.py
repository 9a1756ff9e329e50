"""Robots with real rangers: twins should have seen each other, robots that are together do."""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import cache
from itertools import combinations

import numpy as np
import pytest
import scipy.sparse

from mapweave.agent.mission import Explore
from mapweave.agent.observation import Command
from mapweave.agent.pipeline import Pipeline
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.change import NodePut
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Landmarks, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.ranges import Ranges
from mapweave.hybridmap.trajectory_segment import TrajectorySegment
from mapweave.merge.mutual_exclusion import encounter
from mapweave.merge.mutual_exclusion.collision import Collision
from mapweave.merge.mutual_exclusion.exclusion import collision_of
from mapweave.merge.mutual_exclusion.trajectories import trajectories_of
from mapweave.merge.pose_graph.solved_graph import PoseGraph
from mapweave.merge.settings import ExclusionSettings
from mapweave.sim.events import Fail
from mapweave.sim.simulation import Simulation
from mapweave.sim.worlds.catalog import make_world
from tests.quick import first_quick

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, 0.3)
RADIUS = 0.16
APART = 2 * RADIUS


class Walks:
    """Two robots that go about in rooms of a simulated world, straight from node to node in four seconds.

    Attributes:
        nodes: with what their rangers really measured.
        truth: of the nodes.
    """

    def __init__(
        self, kind: str, seed: int, rooms: tuple[int, int], instants: int = 60, **parameters: float
    ) -> None:
        rng = np.random.default_rng([seed, 7])
        world = make_world(kind, seed, **parameters)
        free = [world.plan.free_points(RADIUS + 0.05, world.plan.rooms[room].name) for room in rooms]
        begin = rng.permutation(free[0])[0]
        far = np.hypot(*(free[1] - begin).T) > 2 * APART
        now = [begin, rng.permutation(free[1][far])[0]]
        to = list(now)
        self.nodes: list[Node] = []
        self.truth: dict[NodeId, Pose2] = {}
        with Simulation(world, ["r0", "r1"], seed) as simulation:
            # Only the rangers are read: no picture is drawn.
            for name in simulation.robots:
                simulation.apply(Fail(name, "camera", "drop", 1.0))
            for instant in range(instants):
                a, b = instant % 2, 1 - instant % 2
                # One has arrived, two is midway.
                now[a] = to[a]
                simulation.kidnap(f"r{b}", Pose2(*(now[b] + to[b]) / 2, 0.0))
                simulation.kidnap(f"r{a}", Pose2(*now[a], rng.uniform(-np.pi, np.pi)))
                self._observe(simulation, f"r{a}", instant)
                ends = free[a][np.hypot(*(free[a] - now[a]).T) < 0.5]
                clear = [np.hypot(*(x - to[b]).T) > APART + 0.02 for x in (ends, (ends + now[a]) / 2)]
                ends = ends[clear[0] & clear[1]]
                to[a] = rng.permutation(ends)[0] if len(ends) else now[a]

    def _observe(self, simulation: Simulation, name: str, instant: int) -> None:
        d, node_id = simulation.describe(name), NodeId(name, 1, instant)
        proximity = simulation.observe(name).proximity
        ranges = Ranges.around(proximity, d.ranger_bearings, d.ranger_reach, d.radius)
        self.truth[node_id] = simulation.truth(name)
        pose = PoseGaussian(self.truth[node_id], np.zeros((3, 3)))
        stamp = round(2e9 * instant)
        node = Node(node_id, stamp, pose, CAMERA, Landmarks.empty(), d.clock, d.radius, ranges)
        self.nodes.append(node)

    def collision_on(self, moved: float = 0.0, settings: ExclusionSettings | None = None) -> Collision | None:
        """Whether they clash, if the second's room is taken to lie further east by `moved`."""
        return clash_of_mapped(self.nodes, self.truth, "r0", "r1", moved, settings)


simulated = cache(Walks)


def walked(kind: str, seed: int, rooms: tuple[int, int], instants: int = 60, **parameters: float) -> Walks:
    """As `Walks`, with nodes that may be replaced; each is simulated once."""
    walks = copy(simulated(kind, seed, rooms, instants, **parameters))
    walks.nodes = list(walks.nodes)
    return walks


def clash_of_mapped(
    nodes: Sequence[Node], truth: Mapping[NodeId, Pose2], first: str, second: str, moved: float = 0.0,
    settings: ExclusionSettings | None = None,
) -> Collision | None:  # fmt: skip
    """Whether two robots clash, each node mapped with an error of 1 cm, the second as a whole with 2 cm."""
    rng = np.random.default_rng(1)
    a, b = ([node for node in nodes if node.id.agent == name] for name in (first, second))
    ids = [node.id for node in a + b]
    means = np.array([truth[node].vector for node in ids])
    means[:, :2] += rng.normal(0, 0.01, (len(ids), 2))
    means[len(a) :, :2] += rng.normal([moved, 0.0], 0.02)
    information = scipy.sparse.diags(np.tile([3e3, 3e3, 1e5], len(ids)))
    graph = PoseGraph(ids[0], tuple(ids), means, scipy.sparse.csc_matrix(information))
    return collision_of(graph, trajectories_of(a)[0], trajectories_of(b)[0], settings)


def between_twins(seed: int) -> float:
    """From the second of two rooms that look alike to the first, m."""
    first, second = make_world("twins", seed).plan.rooms[:2]
    return first.x - second.x


@pytest.mark.parametrize("seed", first_quick(range(4), 2))
def test_twins_should_have_seen_each_other(seed: int):
    """Within five minutes, in any room: where little floor is free they rarely see each other."""
    collision = walked("twins", seed, (0, 1), 150).collision_on(between_twins(seed))
    assert collision is not None and collision.where and collision.evidence > 6.9
    assert f"{collision.first} would have seen {collision.second} " in collision.reason
    assert f"m {collision.where} at {collision.time:.1f} s of clock" in collision.reason
    assert f"its sensors saw nothing there, {collision.moments} such moments" in collision.reason


def with_segments(walks: Walks, every: int = 5) -> None:
    """Of each robot's nodes one in five stays; the others become moments of its trajectory segment."""
    kept = []
    for name in ("r0", "r1"):
        nodes = [node for node in walks.nodes if node.id.agent == name]
        for k in range(0, len(nodes), every):
            node, after = nodes[k], nodes[k + 1 : k + every]
            beside = [(walks.truth[node.id].inverse() @ walks.truth[item.id]).vector for item in after]
            segment = TrajectorySegment(
                np.array([(item.stamp_ns - node.stamp_ns) / 1e9 for item in after]),
                np.array(beside).reshape(-1, 3),
                np.array([item.ranges.distances for item in after]).reshape(-1, len(node.ranges)),
            )
            kept.append(replace(node, segment=segment))
    walks.nodes = kept


@pytest.mark.parametrize("seed", range(3))
def test_twins_should_have_seen_each_other_on_the_way(seed: int):
    """Nodes alone do not refute the merge, or hardly, segments do; the same scans of another robot."""
    walks = walked("twins", seed, (0, 1), 150)
    all_nodes = walks.collision_on(between_twins(seed))
    with_segments(walks)
    collision = walks.collision_on(between_twins(seed))
    walks.nodes = [replace(node, segment=TrajectorySegment()) for node in walks.nodes]
    bare = walks.collision_on(between_twins(seed))
    assert all_nodes is not None and collision is not None and collision.evidence > 6.9
    assert bare is None or bare.moments < collision.moments / 2


@pytest.mark.parametrize("seed", range(3))
def test_robots_in_one_room_are_not_refused_by_views_on_the_way(seed: int, monkeypatch):
    """Neither where they meet, nor where the second is taken to be elsewhere by a few centimetres."""
    walks = walked("arena", seed, (0, 0), 100, length=4.0, width=3.0)
    with_segments(walks)
    assert walks.collision_on(moved=0.05) is None
    monkeypatch.setattr(encounter, "LEAST_WINDOWS", 1)
    assert walks.collision_on(settings=ExclusionSettings(doubt=0.9)) is None


@pytest.mark.parametrize("seed", first_quick(range(3), 1))
@pytest.mark.parametrize("kind", ["office", "arena"])
def test_robots_that_are_in_one_room_are_not_refused(kind: str, seed: int, monkeypatch):
    """They come as near as they can, with furniture between, and rays that miss them."""
    walks = walked(kind, seed, (0, 0))
    assert walks.collision_on() is None
    # Not even nearly: the scans are evidence for the merge. There is no evidence where no robots meet.
    loose = ExclusionSettings(doubt=0.9)
    monkeypatch.setattr(encounter, "LEAST_WINDOWS", 1)
    assert walks.collision_on(settings=loose) is None
    assert walks.collision_on(moved=20.0, settings=loose) is None


@pytest.mark.parametrize("fails", ["all for a while", "most for ever"])
def test_broken_sensors_are_no_evidence(fails: str):
    """Rangers that fail say that there is nothing, though the other robot stands there."""
    walks = walked("arena", 3, (0, 0), 120, length=4.0, width=3.0)
    broken = slice(0, 16) if fails == "all for a while" else slice(0, 13)
    for k, node in enumerate(walks.nodes):
        if fails == "all for a while" and k % 60 > 50:
            continue
        distances = node.ranges.distances.copy()
        distances[broken] = node.ranges.reach
        walks.nodes[k] = replace(node, ranges=replace(node.ranges, distances=distances))
    assert walks.collision_on() is None


def test_robots_without_a_radius_are_not_used_for_visibility(monkeypatch):
    walks = walked("twins", 0, (0, 1))
    walks.nodes = [replace(node, radius=0.0) for node in walks.nodes]
    seeing = walks.collision_on(between_twins(0))
    # Robots that see nothing of each other.
    monkeypatch.setattr("mapweave.merge.mutual_exclusion.mutual_visibility.CORE", 0.0)
    assert seeing == walks.collision_on(between_twins(0))


class Exploration:
    """Robots that explore a simulated world with all that they have.

    Attributes:
        nodes: that they made.
        truth: of the nodes.
    """

    def __init__(self, kind: str, seed: int, robots: int, seconds: float) -> None:
        names = [f"r{k}" for k in range(robots)]
        commands: dict[str, Command] = {}
        self.nodes: list[Node] = []
        with Simulation(make_world(kind, seed), names, seed) as simulation:
            pipelines = {name: Pipeline(MapId(name, 1), simulation.describe(name)) for name in names}
            for pipeline in pipelines.values():
                pipeline.set_mission(Explore())
            for _ in range(round(seconds * 10)):
                for name, observation in simulation.step(commands).items():
                    step = pipelines[name].step(observation)
                    commands[name] = step.command
                    self.nodes += [change.node for change in step.changes if isinstance(change, NodePut)]
            self.truth = {node.id: simulation.truth_at(node.id.agent, node.stamp_ns) for node in self.nodes}


@pytest.mark.scenario
@pytest.mark.timeout(500)
def test_exploring_twin_rooms_are_distinguished_within_100_seconds():
    """In most rooms; in some they are hardly in sight of each other."""
    collected = []
    for seed in range(5, 9):
        made = Exploration("twins", seed, 2, 100.0)
        collected.append(clash_of_mapped(made.nodes, made.truth, "r0", "r1", between_twins(seed)))
    assert sum(clash is not None and bool(clash.where) for clash in collected) >= 3


@pytest.mark.parametrize(
    ("kind", "seed"),
    [
        pytest.param("arena", 1, marks=pytest.mark.slow),
        pytest.param("arena", 2, marks=pytest.mark.scenario),
        pytest.param("office", 5, marks=pytest.mark.scenario),
    ],
)
def test_robots_that_explore_together_are_never_refused(kind: str, seed: int):
    made = Exploration(kind, seed, 4 if kind == "arena" else 3, 80.0)
    loose = ExclusionSettings(doubt=0.5)
    for first, second in combinations(sorted({node.id.agent for node in made.nodes}), 2):
        assert clash_of_mapped(made.nodes, made.truth, first, second, settings=loose) is None

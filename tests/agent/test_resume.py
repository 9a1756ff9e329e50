"""Agents that are killed, moved, driven or carried off map on in the simulator, and the map stays true."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from mapweave import Command, HybridMap, MapId, NodeId
from mapweave.agent.mission import Explore, GoTo
from mapweave.agent.pipeline import Pipeline
from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.retained_map import RetainedMap
from mapweave.hybridmap.pose import Pose2, wrap_angle
from mapweave.sim.simulation import Simulation
from mapweave.sim.world import World
from mapweave.sim.worlds.catalog import make_world
from mapweave.wire.codec import encode_body

ROBOT = "r0"
SEED = 3

LOOKS = 30.0
"""Seconds: two views that agree, where it was killed, and a view mapped."""


class Life:
    """One robot in a world that outlives its agents, and the truth of all that it maps.

    Attributes:
        sim: the world now.
        pipeline: the agent now.
        said: what its status said, in order, without repetitions.
        journal: what its agents have kept.
    """

    def __init__(self, world: World, journal: Journal, start: Pose2 | None = None) -> None:
        poses = None if start is None else [start]
        self.sim = Simulation(world, [ROBOT], SEED, poses)
        self.said: list[str] = []
        self._command = Command()
        self.journal = journal
        self._map = journal.open_map(1)
        self.began = journal.head(self._map)
        self.born()

    def born(self) -> None:
        """Start an agent with what is in the journal."""
        kept = RetainedMap.of(self.journal, self._map)
        self.pipeline = Pipeline(self._map, self.sim.describe(ROBOT), None, kept.contents, kept.next_number)
        self.pipeline.set_mission(Explore())

    def live(self, seconds: float) -> None:
        """Let the agent drive, and keep its changes."""
        for _ in range(round(seconds * 10)):
            step = self.pipeline.step(self.sim.step({ROBOT: self._command})[ROBOT])
            self._command = step.command
            if step.changes:
                self.journal.append(self._map, step.changes, self.sim.stamp_ns)
            if not self.said or self.said[-1] != step.status.doing:
                self.said.append(step.status.doing)

    def map_on(self, most: float) -> None:
        """Live until a node has been added, and five seconds more; how long that takes is partly luck."""
        before = len(self.pipeline.map.nodes)
        while len(self.pipeline.map.nodes) == before and most > 0:
            self.live(2.0)
            most -= 2.0
        self.live(5.0)

    def truth(self) -> dict[NodeId, Pose2]:
        """`world_from_robot` of the nodes that were made in this world."""
        return {n: self.sim.truth_at(ROBOT, self.pipeline.map.nodes[n].stamp_ns) for n in self.made()}

    def made(self) -> list[NodeId]:
        """Nodes that this life has added to the journal."""
        changes = self.journal.changes(self._map, self.began + 1, 10**6)
        return [c.body.node.id for c in changes if hasattr(c.body, "node")]


@dataclass(frozen=True)
class Begun:
    """A map that an agent has made before it was killed."""

    world: World
    path: Path
    standing: Pose2
    truth: dict[NodeId, Pose2]
    highest: int


@pytest.fixture(scope="module")
def begun(tmp_path_factory: pytest.TempPathFactory) -> Begun:
    """50 seconds of exploration: once around the first place."""
    path = tmp_path_factory.mktemp("begun") / "r0.sqlite"
    world = make_world("office", SEED, rooms=3)
    journal = Journal(path, ROBOT)
    life = Life(world, journal)
    life.live(50.0)
    numbers = [element.number for element in (*life.pipeline.map.nodes, *life.pipeline.map.edges)]
    truth = life.truth()
    journal.close()
    return Begun(world, path, life.sim.truth(ROBOT), truth, max(numbers))


def resumed(begun: Begun, tmp_path: Path, start: Pose2, seconds: float) -> tuple[Life, dict[NodeId, Pose2]]:
    """Another agent on a copy of the journal, and the truth of all nodes."""
    copy = tmp_path / "r0.sqlite"
    copy.write_bytes(begun.path.read_bytes())
    life = Life(begun.world, Journal(copy, ROBOT), start)
    life.live(seconds)
    return life, begun.truth | life.truth()


def worst_edge(pipeline: Pipeline, truth: dict[NodeId, Pose2]) -> tuple[float, float]:
    """By how much edges are off, m and degrees."""
    off = [(0.0, 0.0)]
    for edge in pipeline.map.edges.values():
        true = truth[edge.a].inverse() @ truth[edge.b]
        turn = wrap_angle(edge.a_from_b.mean.heading - true.heading)
        off.append((edge.a_from_b.mean.distance(true), abs(math.degrees(turn))))
    return tuple(np.max(off, axis=0).tolist())


def check_resumed(begun: Begun, life: Life, truth: dict[NodeId, Pose2]) -> None:
    new = set(life.pipeline.map.nodes) - set(begun.truth)
    assert len(new) >= 1
    assert {node.map for node in life.pipeline.map.nodes} == {MapId(ROBOT, 1)}
    assert min(node.number for node in new) > begun.highest
    assert len(life.pipeline.map.components()) == 1
    position, heading = worst_edge(life.pipeline, truth)
    assert position < 0.25
    assert heading < 8.0


@pytest.fixture(scope="module")
def again(begun: Begun, tmp_path_factory: pytest.TempPathFactory) -> tuple[Life, dict[NodeId, Pose2]]:
    """A second agent that was started where the first one was killed."""
    life, _ = resumed(begun, tmp_path_factory.mktemp("again"), begun.standing, LOOKS)
    return life, begun.truth | life.truth()


@pytest.mark.slow
def test_an_agent_that_was_killed_goes_on_with_its_map(begun: Begun, again: tuple[Life, dict[NodeId, Pose2]]):
    life, truth = again
    check_resumed(begun, life, truth)
    assert life.said[0] == "looking for a place of its own map"
    # In the same map frame: old and new nodes are as far from each other as they are in truth.
    first = min(begun.truth)
    for node in life.made():
        nodes = life.pipeline.map.nodes
        between = nodes[first].map_from_robot.mean.inverse() @ nodes[node].map_from_robot.mean
        assert between.distance(truth[first].inverse() @ truth[node]) < 0.25


@pytest.mark.slow
def test_the_journal_replays_to_the_resumed_map(again: tuple[Life, dict[NodeId, Pose2]]):
    life, _ = again
    kept, now = HybridMap(RetainedMap.of(life.journal, MapId(ROBOT, 1)).contents), life.pipeline.map
    assert list(kept.nodes) == list(now.nodes)
    assert list(kept.edges) == list(now.edges)
    for number, node in now.nodes.items():
        # The disk keeps single precision.
        assert kept.nodes[number].map_from_robot.mean.distance(node.map_from_robot.mean) < 1e-5
        assert np.array_equal(kept.nodes[number].landmarks.codes, node.landmarks.codes)
    for number, edge in now.edges.items():
        assert (kept.edges[number].a, kept.edges[number].b) == (edge.a, edge.b)
        assert kept.edges[number].a_from_b.mean.distance(edge.a_from_b.mean) < 1e-5


@pytest.mark.slow
def test_resuming_again_is_the_same_to_the_last_bit(
    begun: Begun, again: tuple[Life, dict[NodeId, Pose2]], tmp_path
):
    once, twice = again[0], resumed(begun, tmp_path, begun.standing, LOOKS)[0]
    one, two = ([encode_body(b) for b in life.pipeline.map.contents()] for life in (once, twice))
    assert one == two
    assert once.sim.truth(ROBOT) == twice.sim.truth(ROBOT)


def moved(begun: Begun) -> Pose2:
    """1 m away, in any direction with room, and turned by 40 degrees."""
    here = begun.standing
    for angle in np.arange(0.0, math.tau, 0.3):
        away = Pose2(here.x + math.cos(angle), here.y + math.sin(angle), here.heading + math.radians(40.0))
        if begun.world.plan.clearances(np.array([[away.x, away.y]]))[0] > 0.3:
            return away
    raise AssertionError("no room")


@pytest.mark.slow
def test_an_agent_that_was_killed_and_moved(begun: Begun, tmp_path):
    """The time until two views agree is luck; that they do, and are right, is not."""
    life, _ = resumed(begun, tmp_path, moved(begun), 1.0)
    life.map_on(90.0)
    check_resumed(begun, life, begun.truth | life.truth())


@pytest.mark.slow
def test_nothing_is_appended_where_nothing_is_recognised(begun: Begun, tmp_path):
    """It starts in a room that it has never seen, turns there, and adds nothing."""
    rooms = [
        r for r in begun.world.plan.rooms if math.hypot(r.x - begun.standing.x, r.y - begun.standing.y) > 3
    ]
    centre = max(rooms, key=lambda r: math.hypot(r.x - begun.standing.x, r.y - begun.standing.y))
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9)), axis=-1).reshape(-1, 2)
    grid = grid * 0.4 * [centre.length, centre.width] + [centre.x, centre.y]
    free = grid[int(begun.world.plan.clearances(grid).argmax())]
    life, _ = resumed(begun, tmp_path, Pose2(float(free[0]), float(free[1])), 20.0)
    assert life.made() == []
    assert life.said == ["looking for a place of its own map"]
    turned = np.ptp(np.unwrap(life.sim.trajectory(ROBOT)[1][:, 2]))
    assert turned > math.pi, "it turns around"


@pytest.mark.slow
def test_after_a_drive_to_a_goal_it_maps_on(begun: Begun, tmp_path):
    life, _ = resumed(begun, tmp_path, begun.standing, 1.0)
    life.pipeline.set_mission(GoTo(NodeId("r1", 1, 1)))
    life.live(3.0)
    before = len(life.pipeline.map.nodes)
    life.pipeline.set_mission(Explore())
    life.map_on(60.0)
    assert len(life.pipeline.map.nodes) > before
    check_resumed(begun, life, begun.truth | life.truth())


# Kidnapped while it maps


@pytest.mark.slow
def test_a_kidnapped_explorer_maps_on_and_adds_no_false_edge(begun: Begun, tmp_path):
    """It knows where it is, drives on, and is put down elsewhere between two ticks, turned around."""
    life, _ = resumed(begun, tmp_path, begun.standing, 1.0)
    life.map_on(60.0)
    before = life.made()
    assert before
    life.said.clear()
    life.sim.kidnap(ROBOT, begun.standing @ Pose2(0.0, 0.0, 2.5))
    life.map_on(60.0)
    assert life.said[:2] == ["standing still", "looking for a place of its own map"]
    assert len(life.made()) > len(before)
    check_resumed(begun, life, begun.truth | life.truth())


@pytest.mark.parametrize(
    "seed", [pytest.param(s, marks=pytest.mark.slow if s < 6 else pytest.mark.scenario) for s in range(4, 9)]
)
def test_kidnapped_again_and_again(tmp_path, seed: int):
    world, rng = make_world("office", seed, rooms=3), np.random.default_rng(seed)
    life = Life(world, Journal(tmp_path / "r0.sqlite", ROBOT))
    for _ in range(6):
        life.live(30.0)
        room = world.plan.rooms[int(rng.integers(len(world.plan.rooms)))]
        inside = rng.uniform(-0.5, 0.5, (200, 2)) * [room.length, room.width] + [room.x, room.y]
        x, y = inside[int(np.argmax(world.plan.clearances(inside) > 0.35))].tolist()
        life.sim.kidnap(ROBOT, Pose2(x, y, float(rng.uniform(-3, 3))))
    life.live(30.0)
    assert len(life.pipeline.map.components()) == 1
    position, heading = worst_edge(life.pipeline, life.truth())
    assert position < 0.3
    assert heading < 10.0

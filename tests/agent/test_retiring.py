"""A robot lets superseded nodes go while it maps or rests: only those that the fleet can do without."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from mapweave import MapId, NodeId, Pose2
from mapweave.agent.mission import GoTo
from mapweave.agent.pipeline import Pipeline
from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.retained_map import RetainedMap
from mapweave.agent.settings import AgentSettings
from mapweave.hybridmap.change import NodeRetired
from mapweave.hybridmap.mission_order import MissionKind, MissionOrder
from mapweave.processes.agent import Agent, AgentOptions
from mapweave.wire.bus import Request
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import Ack, KeptNodes, NewestMap
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.pose_messages import MergedPose, PoseNews
from synthetic.world import room
from tests.agent.conftest import DESCRIPTION, PhotoWalls
from tests.agent.own_map import SurveyedMap
from tests.waiting import eventually

KEYS, MAP = Keys("retiring"), MapId("r0", 1)
DAY = 86_400_000_000_000


@pytest.fixture(scope="module")
def own() -> SurveyedMap:
    """A map of the same way on two days."""
    rng = np.random.default_rng(3)
    world, own = room(0, 0, 8, 4, 1600, rng), SurveyedMap(MAP, rng)
    for day, y in ((0, 2.0), (1, 2.15)):
        own.drive(world, [Pose2(1.5 + 0.6 * k, y, 0.3) for k in range(6)], day * DAY)
    return own


def retired(pipeline: Pipeline, days: int) -> list[NodeId]:
    """What leaves the map of a robot that stands still for some ticks."""
    walls, gone = PhotoWalls(), list[NodeId]()
    for tick in range(40):
        step = pipeline.step(walls.observe(Pose2(), Pose2(), days * 864_000 + tick))
        gone += [change.id for change in step.changes if isinstance(change, NodeRetired)]
    return gone


def test_it_does_so_while_it_rests_and_not_on_a_drive_to_a_goal(own: SurveyedMap):
    contents = tuple(own.map.contents())
    resting = Pipeline(MAP, DESCRIPTION, None, contents, 1000)
    assert not retired(resting, 10), "too soon"
    gone = retired(resting, 30)
    assert len(gone) >= 2 and resting.map.nodes.keys() == own.map.nodes.keys() - {*gone}
    driving = Pipeline(MAP, DESCRIPTION, None, contents, 1000)
    driving.set_mission(GoTo(max(own.map.nodes)))
    assert not retired(driving, 30)


@pytest.fixture
def agent(own: SurveyedMap, tmp_path: Path) -> Iterator[tuple[Agent, MemoryBus]]:
    hub = MemoryHub()
    options = AgentOptions("r0", tmp_path, epoch=1, patience=0.0)
    agent = Agent(lambda: DESCRIPTION, MemoryBus(hub), KEYS, AgentSettings(), options)
    yield agent, MemoryBus(hub)
    agent.close()


def test_what_a_server_has_it_must_have_let_go(own: SurveyedMap, agent: tuple[Agent, MemoryBus], opened):
    robot, server = agent
    old, new = NodeId(*MAP, 1), NodeId(*MAP, 2)
    assert robot._released(old, new), "no server knows it"
    robot.replicator.submit(tuple(own.map.contents()), 0)
    assert robot.replicator.flush(30)
    server.publish(KEYS.ack("s0", "r0"), Ack(MAP, robot.journal.log_id(MAP), 3, (), 0, 0.0).encode())
    eventually(lambda: robot.replicator.shared)
    assert not robot._released(old, new), "its map is not known"
    place = MergedPose(old, Pose2())

    whole = PoseNews(7, 0, 1, {old: place, new: place}).encode("r0")
    opened(server.serve(KEYS.all_poses("s0"), lambda request: request.reply(whole)))
    server.publish(KEYS.poses("s0", "r0"), PoseNews(7, 1, 1).encode("r0"))
    eventually(lambda: robot.merged_poses.of(old) is not None)
    assert not robot._released(old, new), "the server has it"
    server.publish(KEYS.poses("s0", "r0"), PoseNews(7, 1, 2, {}, (old,)).encode("r0"))
    eventually(lambda: robot.merged_poses.of(old) is None)
    assert robot._released(old, new), "the server has pruned it"
    assert not robot._released(old, NodeId(*MAP, 9)), "what replaces it must be there"
    # Its pipeline has an empty map.
    robot.missions.unknown_goal = lambda node: ""
    robot.missions.take(MissionOrder.new("r0", MissionKind.GO, "anna", old))
    assert not robot._released(old, new), "it is a goal"


def test_a_map_that_it_has_left_goes_when_its_server_has_pruned_all_of_it(own: SurveyedMap, tmp_path, opened):
    journal = Journal(tmp_path / "r0.sqlite", "r0")
    journal.open_map(1)
    journal.append(MAP, own.map.contents(), 0)
    journal.acknowledge("s0", MAP, journal.head(MAP))
    journal.close()
    hub, asked = MemoryHub(), list[KeptNodes]()
    server = MemoryBus(hub)

    def answer(request: Request) -> None:
        asked.append(KeptNodes.decode(request.payload))
        request.reply(NewestMap(1, pruned=True).encode())

    server.serve(KEYS.all_acks("s0"), answer)
    server.announce(KEYS.server_alive("s0"))
    options = AgentOptions("r0", tmp_path, fresh=True, patience=0.0)
    robot = opened(Agent(lambda: DESCRIPTION, MemoryBus(hub), KEYS, AgentSettings(), options))
    eventually(lambda: not RetainedMap.of(robot.journal, MAP).contents)
    assert asked == [KeptNodes(1, tuple(sorted(node.number for node in own.map.nodes)))]

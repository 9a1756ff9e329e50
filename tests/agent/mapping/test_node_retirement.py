"""Nodes of the own map that newer ones have superseded for long leave it, and nothing is lost by it."""

from collections.abc import Callable, Collection
from dataclasses import replace

import numpy as np
import pytest

from mapweave import Edge, EdgeKind, HybridMap, MapId, NodeId, Pose2, PoseGaussian
from mapweave.agent.mapping.node_retirement import EVERY, KEPT, NodeRetirement, Released, alone
from mapweave.hybridmap.change import EdgePut, NodePut, NodeRetired
from mapweave.hybridmap.reachability import FARTHEST, WIDEST
from mapweave.hybridmap.superseding import CROWD
from mapweave.registration.recognition import register
from synthetic.world import room
from tests.agent.own_map import SurveyedMap

MAP = MapId("r0", 1)
DAY = 86_400_000_000_000
WAY = [Pose2(1.5 + 0.6 * k, 2.0, 0.3) for k in range(6)]
BESIDE = [Pose2(1.5 + 0.6 * k, 2.15, 0.25) for k in range(6)]
BACK = [Pose2(1.5 + 0.6 * k, 2.0, 3.4) for k in range(6)]


class Robot:
    """Drives the same way on the first day and on the second, and then rests."""

    def __init__(self, *tours: list[Pose2], seed: int = 3) -> None:
        rng = np.random.default_rng(seed)
        self.world = room(0, 0, 8, 4, 1600, rng)
        self.own = SurveyedMap(MAP, rng)
        for day, tour in enumerate(tours):
            self.own.drive(self.world, tour, day * DAY)

    @property
    def map(self) -> HybridMap:
        return self.own.map

    def retire(self, now_ns: int, held: Collection[NodeId] = (), released: Released = alone) -> set[NodeId]:
        """What one search finds; it is taken out of the map."""
        retirement, gone = NodeRetirement(self.map, released), set[NodeId]()
        for _ in range(2 * len(self.map.nodes) + 2):
            node = retirement.next(now_ns, held)
            if node is not None:
                assert node not in held
                self.own.builder.retire(node)
                gone.add(node)
        return gone


def nodes_of(robot: Robot, day: int) -> set[NodeId]:
    return {node.id for node in robot.map.nodes.values() if node.stamp_ns // DAY == day}


def test_superseded_nodes_leave_after_two_weeks_and_the_map_holds_together():
    robot = Robot(WAY, BESIDE)
    old, new = nodes_of(robot, 0), nodes_of(robot, 1)
    before = dict(robot.map.nodes)
    assert not robot.retire(DAY + KEPT - 1), "not yet"
    gone = robot.retire(2 * DAY + KEPT)
    assert len(gone) >= 3 and gone < old and min(old) not in gone, "the first one gives the map its frame"
    assert new <= robot.map.nodes.keys() and len(robot.map.components()) == 1
    # A view from one of them is recognised by another, near it.
    for node in gone:
        poses = {k: robot.own.truth[node].inverse() @ robot.own.truth[k] for k in robot.map.nodes}
        near = [k for k, p in poses.items() if p.distance(Pose2()) < FARTHEST and abs(p.heading) < WIDEST]
        rng = np.random.default_rng(0)
        assert any(register(robot.map.nodes[k], before[node], None, rng) is not None for k in near)
    changes = robot.own.builder.take_changes()
    assert {change.id for change in changes if isinstance(change, NodeRetired)} == gone
    assert not robot.retire(2 * DAY + KEPT + EVERY), "none is left that could go"


def test_the_only_views_of_a_place_stay():
    robot = Robot(WAY, BACK)
    assert len(nodes_of(robot, 0)) >= 5 and not robot.retire(30 * DAY)


@pytest.mark.parametrize("kept", ["held", "not released"])
def test_what_is_in_use_or_named_stays(kept: str):
    some = Robot(WAY, BESIDE).retire(30 * DAY)
    robot, stays = Robot(WAY, BESIDE), max(some)
    ways: dict[str, Callable[[], set[NodeId]]] = {
        "held": lambda: robot.retire(30 * DAY, {stays}),
        "not released": lambda: robot.retire(30 * DAY, released=lambda node, by: node != stays),
    }
    gone = ways[kept]()
    assert gone and stays not in gone and stays in robot.map.nodes


def test_a_node_stays_that_alone_leads_to_others():
    robot = Robot(WAY, BESIDE)
    some = max(robot.retire(30 * DAY))
    robot = Robot(WAY, BESIDE)
    # A room behind it, that no other node is tied to.
    behind = replace(robot.map.nodes[some], id=robot.own.builder.new_id(), stamp_ns=30 * DAY)
    robot.map.apply(NodePut(behind))
    step = PoseGaussian.from_sigmas(Pose2(0.0, 2.0, 1.0), 0.01, 0.01)
    robot.map.apply(EdgePut(Edge(robot.own.builder.new_id(), some, behind.id, step, EdgeKind.MAPPED)))
    gone = robot.retire(30 * DAY)
    assert some not in gone and len(robot.map.components()) == 1


def test_many_later_views_around_supersede_a_node_that_none_recognises():
    """Later views of the first one's place; their edges say nothing of what they share."""
    robot = Robot(WAY)
    middle = sorted(robot.map.nodes)[3]
    step = PoseGaussian.from_sigmas(Pose2(0.1, 0.0, 0.0), 0.01, 0.01)
    for number in range(CROWD):
        here = replace(robot.map.nodes[middle], id=robot.own.builder.new_id(), stamp_ns=30 * DAY)
        robot.map.apply(NodePut(here))
        # The robot drove there from the nodes beside the middle one.
        for end in (sorted(robot.map.nodes)[2], sorted(robot.map.nodes)[4]):
            edge = Edge(robot.own.builder.new_id(), end, here.id, step, EdgeKind.MAPPED)
            robot.map.apply(EdgePut(edge))
        gone = robot.retire(45 * DAY)
        assert (middle in gone) == (number == CROWD - 1), "fewer do not suffice"
    assert len(robot.map.components()) == 1 and min(robot.map.nodes) == NodeId(*MAP, 1)


def test_a_clock_that_is_put_back_holds_nothing_up():
    robot = Robot(WAY, BESIDE)
    retirement = NodeRetirement(robot.map)
    assert retirement.next(900 * DAY) is None
    while retirement._candidates:
        retirement.next(DAY)
    found = [retirement.next(30 * DAY) for _ in range(20)]
    assert any(node is not None for node in found)


@pytest.mark.slow
def test_a_year_of_drives_makes_no_larger_map():
    rng = np.random.default_rng(5)
    world = room(0, 0, 5, 4, 900, rng)
    own = SurveyedMap(MAP, rng)
    retirement, sizes = NodeRetirement(own.map), list[int]()
    for week in range(52):
        tour = [Pose2(1.2 + 0.5 * k, 1.8 + rng.uniform(-0.2, 0.2), rng.uniform(-0.2, 0.2)) for k in range(6)]
        own.drive(world, tour, week * 7 * DAY)
        for _ in range(len(own.map.nodes) + 2):
            node = retirement.next(week * 7 * DAY + DAY)
            if node is not None:
                own.builder.retire(node)
        sizes.append(len(own.map.nodes))
    assert max(sizes[-10:]) <= 1.2 * max(sizes[16:26]) and sizes[-1] < 52 * 6 / 3

"""How many statuses a server asks of its robots: as many together, however many they are."""

from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapweave.agent.fleet_client import FleetClient
from mapweave.agent.mission_control import MissionControl
from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.replicator import Replicator
from mapweave.hybridmap.agent_status import (
    FIRST_STATUS_PERIOD,
    LONGEST_STATUS_PERIOD,
    MAX_ROBOTS,
    MOST_AHEAD,
    SILENT,
    AgentStatus,
    FleetStatus,
    RobotEntry,
    Status,
)
from mapweave.hybridmap.annotation import Annotations
from mapweave.hybridmap.change import NodeRetired
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.mission_order import MAX_VIA, MissionKind, MissionOrder, MissionReport, MissionState
from mapweave.hybridmap.portal import PortalMeans, PortalStop, PortalWait
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver import http
from mapweave.mapserver.places import PlaceResolver
from mapweave.mapserver.quotas import Quotas
from mapweave.mapserver.roster import MOST_ALIVE, STAGGER, STATUSES_PER_S, Roster
from mapweave.mapserver.routes import Router
from mapweave.mapserver.server import MapServer
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.wire.bus import Closing
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.messages import decode, encode
from tests.quick import first_quick
from tests.waiting import eventually

KEYS = Keys("fleet")


class Listening:
    """A roster on a bus of its own, at the time that a test sets."""

    def __init__(self, hub: MemoryHub) -> None:
        self.bus, self.quotas, self.now = MemoryBus(hub), Quotas(), 0.0
        self.roster = Roster(self.bus, KEYS, lambda: self.now, lambda status: None, self.quotas)

    def come(self, maps: Iterable[MapId]) -> list[Closing]:
        return [self.bus.announce(KEYS.agent_alive(map_id)) for map_id in maps]


@pytest.fixture
def listening(hub: MemoryHub) -> Iterator[Listening]:
    listening = Listening(hub)
    yield listening
    listening.roster.close()


@pytest.mark.parametrize(
    ("robots", "period"), first_quick([(0, 0.0), (200, 0.0), (300, 0.75), (1000, 2.5), (1700, 4.0)], 3)
)
def test_the_period_of_statuses_grows_with_the_number_of_robots(
    listening: Listening, robots: int, period: float
):
    roster = listening.roster
    tokens = listening.come(MapId(f"r{k}", 1) for k in range(robots))
    eventually(lambda: roster.status_period() == period and roster.alive("r0") is bool(robots))
    for token in tokens[50:]:
        token.close()
    eventually(lambda: roster.status_period() == 0.0)


def test_robots_that_begin_together_report_apart_after_two_periods(listening: Listening):
    """In step, 1000 robots filled two cores for half a second, five times in 12.5 s."""
    listening.come(MapId(f"r{k}", 1) for k in range(1000))
    eventually(lambda: listening.roster.status_period() == 2.5)
    periods = np.array([listening.roster.status_period_of(f"r{k}") for k in range(1000)])
    rate = float(np.sum(1.0 / periods))
    assert rate == pytest.approx(400.0, rel=0.02)
    times = np.arange(50)[:, None] * periods
    for begin in np.arange(5.0, 30.0, 0.5):
        assert np.count_nonzero((times >= begin) & (times < begin + 0.5)) < 2 * 0.5 * rate


def test_a_robot_that_reports_far_too_often_is_reminded(listening: Listening):
    roster, reminded = listening.roster, list[MapId]()
    roster.remind = reminded.append

    def report(robot: str, at: float) -> int:
        listening.now, before = at, reminded.count(MapId(robot, 3))
        said = AgentStatus(Status("standing", "", 1, 0, Pose2(), False), round(1e9 * at), robot, 3)
        # The second one is taken when all is done about the first.
        for one in (said, replace(said, robot="another")):
            listening.bus.publish(KEYS.agent_status(one.robot), encode(one))
            eventually(lambda one=one: roster.status(one.robot) == one)
        return reminded.count(MapId(robot, 3)) - before

    for k in range(4):
        report("r0", 100.0 + 0.5 * (k // 2))
    assert not reminded, "a small fleet reports as it likes"
    listening.come(MapId(f"r{k}", 3) for k in range(1000))
    eventually(lambda: roster.status_period() == 2.5)
    period = roster.status_period_of("r0")
    for k in range(4):
        assert not report("r0", 200.0 + period * k), "as it should"
    assert not report("r1", 300.0), "the first"
    assert report("r1", 300.5) == 1
    # One that does not listen keeps no other from it.
    assert sum(report("r1", 300.6 + 0.01 * k) for k in range(40)) == 0
    assert not report("r2", 301.0) and report("r2", 301.5) == 1
    assert not report("r1", 300.5 + LONGEST_STATUS_PERIOD), "as rarely as it may"
    assert report("r1", 305.0) == 1


@pytest.mark.parametrize("comes_first", [False, True])
def test_a_robot_that_makes_no_node_hears_how_rarely_to_report(hub: MemoryHub, tmp_path, comes_first: bool):
    """It is acknowledged nothing new: 1000 such robots sent 2000 statuses a second."""
    bus = MemoryBus(hub)
    with MapServer(bus, KEYS, tmp_path / "s0.sqlite", "s0"):

        def others_come() -> None:
            for k in range(1000):
                bus.announce(KEYS.agent_alive(MapId(f"f{k}", 1)))

        with closing(Journal(tmp_path / "r0.sqlite", "r0")) as journal:
            replicator = Replicator(bus, KEYS, journal, journal.open_map(1), ("s0",))
            replicator.submit([NodeRetired(NodeId("r0", 1, 1))], 1)
            eventually(lambda: journal.acknowledged(MapId("r0", 1)) == {"s0": 1})
            replicator.close()
        if not comes_first:
            others_come()
        with closing(Journal(tmp_path / "r0.sqlite", "r0")) as journal:
            replicator = Replicator(bus, KEYS, journal, MapId("r0", 1), ("s0",))
            assert replicator.status_period == FIRST_STATUS_PERIOD
            link = FleetClient(bus, KEYS, MapId("r0", 1), MissionControl("r0"))
            if comes_first:
                eventually(lambda: replicator.status_period == 0.0)
                others_come()
            wanted = 1001 / STATUSES_PER_S

            def heard() -> bool:
                if comes_first:
                    link.report(Status("standing", "", 1, 0, Pose2(), False), 1)
                period = replicator.status_period
                within = wanted / (1.0 + STAGGER) < period < wanted / (1.0 - STAGGER)
                return within and period != FIRST_STATUS_PERIOD

            eventually(heard)
            link.close()
            replicator.close()


def test_a_robot_that_reports_as_rarely_as_it_may_is_not_called_silent():
    """It looks every half second whether a status is due. The page has the same limit as the command."""
    assert SILENT > LONGEST_STATUS_PERIOD + 0.5
    page = Path(http.__file__).parent / "static" / "robot_panel.js"
    assert f"const QUIET = {SILENT:g};" in page.read_text()


@pytest.mark.slow
def test_one_answer_holds_all_robots_whatever_they_do():
    node = NodeId("r0", 1, 3)
    wait = PortalWait(PortalStop("lift", PortalMeans.LIFT, node, node._replace(number=4)))
    order = MissionOrder("m", "r0", MissionKind.GO, 1, "anna", node, "kitchen", MAX_VIA * (node,))
    report = MissionReport(order, MissionState.RUNNING, portal=wait)
    status = Status("waiting", "", 7, 0, Pose2(), False, "goto", fix_node=node, portal=wait)
    said = AgentStatus(status, 1, "r0", 1, mission=report, battery=0.5)
    ahead = MOST_AHEAD * (node,)
    entries = tuple(
        RobotEntry(f"r{k}", True, 0.0, said, Pose2(), 0, newest=node, ahead=ahead) for k in range(MAX_ROBOTS)
    )
    assert decode(encode(FleetStatus(entries)), FleetStatus).robots == entries


def test_a_robot_that_is_alive_under_many_maps_is_named_and_harms_itself_alone(listening: Listening):
    roster, quotas = listening.roster, listening.quotas
    tokens = listening.come(MapId("r3", epoch) for epoch in range(40))
    listening.come([MapId("r1", 1)])
    eventually(lambda: roster.alive("r1"))
    eventually(lambda: quotas.over() == {"r3": "over its quota: 32 liveliness tokens"})
    places, way = PlaceResolver(Router(MergedMap.empty()), Annotations()), 100 * (NodeId("r3", 1, 1),)
    entries = roster.robots(places, {"r3": way}).robots
    assert entries[1].over_quota and [len(one.ahead) for one in entries] == [0, MOST_AHEAD]
    assert roster.alive("r3") and len(roster._alive["r3"]) == MOST_ALIVE
    for token in tokens:
        token.close()
    eventually(lambda: not roster.alive("r3"))

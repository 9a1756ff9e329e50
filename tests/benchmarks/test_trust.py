"""The benchmark of trust: truth and lies of its server against a room, drives against the simulator."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import reduce
from itertools import pairwise

import numpy as np
import pytest

from benchmarks.trust.lying_server import LIES, LyingServer
from mapweave import HybridMap, MapId, NodeId, Pose2
from mapweave.hybridmap.errors import InvalidMessage
from mapweave.hybridmap.query import Certainty, RelocalizeAnswer, RouteAnswer, RouteRequest, View
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.messages import decode, encode, encode_view
from synthetic.maps import changes_of
from synthetic.world import World, room, take_map, take_view

KEYS = Keys("trust")
TOUR = [Pose2(0.8 + 0.7 * k, 2.0, 0.3 * k) for k in range(5)]
ROBOT = Pose2(1.7, 2.1, 0.35)
AGREE = 0.1
"""m and rad by which the honest whereabouts of this room may be off."""


class Asked:
    """A server whose map, robot and truth are known here, and a robot that asks it."""

    def __init__(self, hub: MemoryHub) -> None:
        rng = np.random.default_rng(3)
        self.world: World = room(0, 0, 5, 4, 900, rng)
        nodes, edges = take_map(self.world, MapId("r0", 1), TOUR, rng, sigma_xy=0.002)
        self.nodes = [node.id for node in nodes]
        self.true = dict(zip(self.nodes, TOUR, strict=True))
        self.buses = MemoryBus(hub), MemoryBus(hub)
        contents = HybridMap(changes_of(nodes, edges))
        self.server = LyingServer(self.buses[0], KEYS, contents, self.true, lambda: ROBOT, 3)
        self.server.goal = self.nodes[-1]
        self.view: View = take_view(self.world, ROBOT, rng)[0]

    def raw(self, key: str, payload: bytes) -> bytes | None:
        replies = [reply for reply in self.buses[1].ask(f"{key}/r1", payload, 5.0) if not reply.error]
        return replies[0].payload if replies else None

    def where(self) -> RelocalizeAnswer:
        payload = self.raw(KEYS.relocalize("s0"), encode_view(self.view))
        assert payload is not None
        return decode(payload, RelocalizeAnswer)

    def way(self) -> RouteAnswer:
        request = RouteRequest(self.nodes[0], self.nodes[-1], (), Pose2())
        payload = self.raw(KEYS.route("s0"), encode(request))
        assert payload is not None
        return decode(payload, RouteAnswer)

    def stated(self, answer: RelocalizeAnswer) -> Pose2:
        """Where the robot is by an answer, in the room."""
        return self.true[answer.candidates[0].node] @ answer.candidates[0].node_from_robot.mean


@pytest.fixture
def asked(hub: MemoryHub) -> Iterator[Asked]:
    asked = Asked(hub)
    yield asked
    for bus in asked.buses:
        bus.close()


def end_of(way: RouteAnswer, start: Pose2) -> Pose2:
    """Where a route leads from where it begins."""
    return reduce(lambda pose, leg: pose @ leg.previous_from_node.mean, way.legs, start)


def off(a: Pose2, b: Pose2) -> tuple[float, float]:
    """Distance, m, and angle, rad."""
    return math.dist((a.x, a.y), (b.x, b.y)), abs(math.remainder(a.heading - b.heading, math.tau))


def test_without_a_lie_the_answers_are_the_truth(asked: Asked):
    where, way = asked.where(), asked.way()
    assert where.certainty is Certainty.FOUND
    assert max(off(asked.stated(where), ROBOT)) < AGREE
    assert [leg.node.id for leg in way.legs][-1] == asked.nodes[-1]
    assert max(off(end_of(way, TOUR[0]), TOUR[-1])) < AGREE


@pytest.mark.parametrize(("lie", "distance", "angle"), [
    ("right place, 0.5 m off", math.hypot(0.35, 0.35), 0.0),
    ("right place, 90 degrees off", 0.0, math.pi / 2),
])  # fmt: skip
def test_whereabouts_are_as_wrong_as_the_lie_says(asked: Asked, lie: str, distance: float, angle: float):
    asked.server.lie = LIES[lie]()
    assert off(asked.stated(asked.where()), ROBOT) == pytest.approx((distance, angle), abs=AGREE)


def test_places_that_are_wrong_are_elsewhere_and_nodes_that_no_map_has_are_in_none(asked: Asked):
    asked.server.lie = LIES["wrong place"]()
    assert any(off(asked.stated(asked.where()), ROBOT)[0] > 0.3 for _ in range(10))
    for lie in ("another floor", "the view itself as a node"):
        asked.server.lie = LIES[lie]()
        assert asked.where().candidates[0].node not in asked.true
    assert asked.way().legs[0].node.id not in asked.true


def test_routes_lead_where_the_lie_says(asked: Asked):
    honest = asked.way()
    asked.server.lie = LIES["route through walls"]()
    straight = asked.way()
    assert len(straight.legs) == 3 and straight.legs[1].node.id not in asked.true
    # The ends of the way by the room; its headings are not driven.
    assert off(end_of(straight, TOUR[0]), TOUR[-1])[0] < AGREE
    asked.server.lie = LIES["cyclic routes"]()
    passed = [leg.node.id for leg in asked.way().legs]
    there = [leg.node.id for leg in honest.legs]
    assert passed == [*there, *there[-2::-1], *there[1:]]
    known = {frozenset(pair) for pair in pairwise(there)}
    assert {frozenset(pair) for pair in pairwise(passed)} == known
    assert max(off(end_of(asked.way(), TOUR[0]), TOUR[-1])) < 3 * AGREE
    asked.server.lie = LIES["absurd legs"]()
    assert min(off(end_of(asked.way(), Pose2()), Pose2())[0] for _ in range(2)) > 80.0
    asked.server.lie = LIES["routes that never end"]()
    ends: list[NodeId] = [leg.node.id for leg in asked.way().legs]
    assert ends[-1] == asked.nodes[-1] and not set(ends[1:-1]) & set(asked.nodes)


def test_what_is_no_answer_is_none(asked: Asked):
    asked.server.lie = LIES["silence"]()
    view = encode_view(asked.view)
    assert asked.raw(KEYS.relocalize("s0"), view) is None
    asked.server.lie = LIES["garbage"]()
    for _ in range(8):
        said = asked.raw(KEYS.relocalize("s0"), view)
        assert said is not None
        with pytest.raises(InvalidMessage):
            decode(said, RelocalizeAnswer)
    asked.server.lie = LIES["late answers"]()
    assert [asked.raw(KEYS.relocalize("s0"), view) is None for _ in range(3)] == [True, True, False]


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_drive_is_judged_by_where_the_robot_was(monkeypatch):
    """Way and arrival against the poses that the simulator gave, tick by tick."""
    from benchmarks.trust import benchmark
    from benchmarks.trust.building import mapped_office
    from mapweave.sim.simulation import Simulation

    track: list[Pose2] = []
    advance = Simulation.advance

    def followed(simulation: Simulation, *arguments: object) -> object:
        track.append(simulation.truth(benchmark.ROBOT))
        return advance(simulation, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(Simulation, "advance", followed)
    building = mapped_office(9104, 1)
    lying = 20.0
    outcome = benchmark.drive(building, "silence", 9104, lying)
    steps = [off(a, b)[0] for a, b in pairwise(track)]
    assert outcome.lied_s == lying and outcome.touches == 0
    assert outcome.way_m == pytest.approx(sum(steps[: round(lying * 10)]), abs=0.06)
    rng = np.random.default_rng([9104, sorted(LIES).index("silence"), 0xD21])
    goal = building.truth[benchmark.plot(building, rng)[1]]
    assert outcome.arrived and not outcome.false_arrival
    assert off(track[-1], goal)[0] < benchmark.CLOSE
    assert outcome.honest_s == pytest.approx(len(track) / 10 - lying, abs=0.2)

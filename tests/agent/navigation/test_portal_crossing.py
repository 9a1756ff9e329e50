"""A robot at a lift: it asks, is taken through or is not, and says where it is."""

from dataclasses import replace

import numpy as np
import pytest

from mapweave.agent.mission import WhereAmI, WhichWay
from mapweave.agent.navigation.navigator import NavigationStage
from mapweave.agent.navigation.portal_crossing import PortalCrossing
from mapweave.agent.navigation.route_source import onboard_route
from mapweave.agent.observation import Command
from mapweave.agent.settings import NavigatorSettings
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.portal import PortalMeans, PortalStop, PortalWait
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import RelocalizeAnswer, RouteAnswer
from synthetic.world import World, room
from tests.agent.scripted_fleet import TOUR, B, C, Eyes, Trial, a_way, answering, at, bare, here, navigator

MAP = MapId("r0", 1)
LANDING = Pose2(2.5, 2.0)


class Lift:
    """A robot on its own floor, a goal on another one, and a lift at the own map's second node."""

    def __init__(self, home: World, own_map: HybridMap, patience: float = 900.0, wait: bool = False) -> None:
        self.own_map, self.entry = own_map, sorted(own_map.nodes)[1]
        self.portal = PortalStop("east lift", PortalMeans.LIFT, self.entry, B, "2", "key: desk")
        self.eyes = Eyes(home, TOUR[1] @ Pose2(-0.4))
        self.upstairs = room(0, 0, 5, 4, 900, np.random.default_rng(8))
        self.seen_upstairs = True
        nav = navigator(self.eyes, own_map, C, NavigatorSettings(patience=30.0))
        nav.crossing = PortalCrossing(MAP, patience, PortalWait(self.portal) if wait else None)
        self.trial = Trial(nav, self.eyes, answering(self.way, self.where))
        self.crossing = nav.crossing

    def where(self) -> RelocalizeAnswer:
        """It is known upstairs alone, and there only on a floor that may be meant."""
        up = self.eyes.world is self.upstairs and self.seen_upstairs
        return at(here(B, LANDING.inverse() @ self.eyes.pose)) if up else at()

    def way(self, question: WhichWay) -> RouteAnswer:
        if question.start == B:
            return a_way(B, C)
        way = onboard_route(self.own_map, question.start, self.entry).legs
        # The robot's images show nothing, so that it parks by what it knows of the nodes around.
        legs = tuple(replace(leg, node=bare(leg.node.id)) for leg in way)
        return RouteAnswer(legs, "to the lift", self.portal)

    def run_until_it_asks(self, times: int = 1) -> None:
        def asks() -> bool:
            wait = self.crossing.wait
            return wait is not None and not wait.done and wait.asked == times

        self.trial.run(120.0, lambda: asks() or self.trial.navigator.given_up)
        self.trial.run(0.3)
        assert asks(), (self.trial.navigator.stage, self.trial.navigator.detail)

    def carry(self) -> None:
        self.eyes.world, self.eyes.pose = self.upstairs, LANDING @ Pose2(0.1, 0.05, 0.1)


@pytest.fixture
def lift(home: World, own_map: HybridMap) -> Lift:
    return Lift(home, own_map)


def test_it_parks_asks_and_goes_on_from_where_it_sees_that_it_is(lift: Lift):
    nav = lift.trial.navigator
    lift.run_until_it_asks()
    assert lift.eyes.pose.distance(TOUR[1]) < 0.05, "it is parked as at a goal"
    assert nav.stage == NavigationStage.PORTAL and not nav.arrived
    assert nav.detail == (
        "at lift 'east lift' (key: desk): take me to floor 2, then say `mapweave portal done r0`"
    )
    begun = len(lift.trial.commands)
    lift.trial.run(40.0, lambda: nav.given_up)
    assert {*lift.trial.commands[begun:]} == {Command()}, "it stands, for longer than drives may take"
    lift.carry()
    lift.trial.run(1.0, lambda: nav.given_up)
    assert nav.stage == NavigationStage.PORTAL, "what it sees meanwhile is no reason to leave"
    lift.crossing.taken_through()
    lift.trial.run(30.0, lambda: nav.progress == 1.0 or nav.statistics.edges > 1)
    looks = [question for question in lift.trial.asked if isinstance(question, WhereAmI)]
    assert looks[-1].near == B, "it knows on which floor it is"
    assert nav.fix is not None and nav.fix.node == B and lift.crossing.wait is None
    assert nav.stage not in (NavigationStage.PORTAL, NavigationStage.LOST) and nav.legs > 0


def test_said_too_early_it_finds_itself_on_its_own_floor_says_so_and_asks_again(lift: Lift):
    lift.run_until_it_asks()
    lift.crossing.taken_through()
    lift.run_until_it_asks(times=2)
    assert lift.trial.navigator.detail.startswith("I am still on this side of lift 'east lift'; at lift")
    lift.carry()
    lift.crossing.taken_through()
    nav = lift.trial.navigator
    lift.trial.run(60.0, lambda: nav.fix is not None and nav.fix.node == B)
    assert nav.fix is not None and nav.fix.node == B


def test_where_nothing_is_known_it_asks_again_and_at_last_gives_up(home: World, own_map: HybridMap):
    lift = Lift(home, own_map, patience=150.0)
    lift.run_until_it_asks()
    lift.carry()
    lift.seen_upstairs = False
    lift.crossing.taken_through()
    lift.run_until_it_asks(times=2)
    nav = lift.trial.navigator
    assert nav.detail.startswith("I cannot find myself on floor 2; at lift 'east lift'")
    lift.trial.run(200.0, lambda: nav.given_up)
    assert nav.given_up
    assert nav.detail == "not taken through lift 'east lift' within 150 s: I cannot find myself on floor 2"


def test_its_own_map_of_a_floor_that_looks_the_same_does_not_mislead_it(lift: Lift):
    lift.run_until_it_asks()
    lift.upstairs = lift.eyes.world
    lift.carry()
    lift.crossing.taken_through()
    nav = lift.trial.navigator
    lift.trial.run(30.0, lambda: nav.fix is not None)
    assert nav.fix is not None and nav.fix.node == B


def test_a_robot_that_was_switched_off_at_a_portal_waits_there_and_looks_where_it_is(
    home: World, own_map: HybridMap
):
    lift = Lift(home, own_map, wait=True)
    lift.eyes.pose = TOUR[1]
    lift.run_until_it_asks()
    assert {*lift.trial.commands} == {Command()} and not lift.trial.asked
    lift.carry()
    lift.crossing.taken_through()
    nav = lift.trial.navigator
    lift.trial.run(30.0, lambda: nav.fix is not None)
    assert nav.fix is not None and nav.fix.node == B


def test_a_robot_that_gets_lost_is_looked_for_on_its_floor_first(home: World):
    """It has a fix, and then sees nothing that anyone knows."""
    eyes, known = Eyes(home, Pose2(0.5, 2.0)), [True]
    nav = navigator(eyes, HybridMap(), C)

    fleet = answering(lambda _: a_way(B, C, step=9.0), lambda: at(here(B, Pose2())) if known[0] else at())
    trial = Trial(nav, eyes, fleet)
    trial.run(10.0, lambda: nav.fix is not None)
    known[0] = False
    trial.run(120.0, lambda: len(trial.asked) > 30)
    near = [question.near for question in trial.asked if isinstance(question, WhereAmI)]
    assert near[0] is None and near[1] == B and near[-1] is None
    assert near.count(B) * 0.5 > 2.0 * np.pi, "after a whole turn without success it may be on any floor"


def test_beyond_a_door_its_own_map_counts():
    portal = PortalStop("gate", PortalMeans.DOOR, NodeId("r0", 1, 1), NodeId("r1", 1, 5))
    crossing = PortalCrossing(MAP, wait=PortalWait(portal))
    assert not crossing.elsewhere and "the other side, node r1.1.5" in crossing.request
    other = PortalCrossing(MAP, wait=PortalWait(replace(portal, means=PortalMeans.RAMP)))
    assert other.elsewhere

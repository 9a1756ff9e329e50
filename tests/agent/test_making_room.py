"""A robot that has done its mission drives out of another one's way; no other does."""

import pytest

from mapweave.agent.exploration.behaviours import Phase
from mapweave.agent.mission import Explore, GoTo, Idle, Mission
from mapweave.agent.navigation.navigator import NavigationStage
from mapweave.agent.pipeline import Pipeline
from mapweave.agent.settings import AgentSettings, NavigatorSettings
from mapweave.hybridmap.ids import NodeId
from tests.agent.ranged_body import BODY, MAP, live, on, still


@pytest.mark.parametrize("allowed", [True, False])
def test_a_robot_that_has_parked_makes_room_and_others_do_not(walls, allowed):
    navigation = NavigatorSettings(make_room=allowed)
    goal, aside = NodeId("r2", 1, 1), NodeId("r2", 1, 9)

    def asked(mission: Mission, stage: NavigationStage) -> Pipeline:
        pipeline = Pipeline(MAP, BODY, AgentSettings(navigation=navigation))
        pipeline.set_mission(GoTo(goal))
        pipeline._navigator.stage = stage
        pipeline.set_mission(mission) if not isinstance(mission, GoTo) else None
        pipeline._others.aside = aside
        pipeline.step(still(walls, tick=1))
        return pipeline

    parked = asked(GoTo(goal), NavigationStage.ARRIVED)
    assert parked.mission == GoTo(aside if allowed else goal)
    assert asked(GoTo(goal), NavigationStage.LOST).mission == GoTo(goal), "it is on its way"
    assert asked(GoTo(goal), NavigationStage.GIVEN_UP).mission == GoTo(goal), "it has failed"
    assert asked(Idle(), NavigationStage.ARRIVED).mission == Idle(), "it was stopped"
    step = parked.step(still(walls, tick=2))
    assert ("makes room" in step.status.detail) == allowed


@pytest.mark.parametrize("lifted", [False, True])
def test_a_robot_that_has_explored_makes_room(walls, lifted):
    """It stands wherever its last view was, which may be in a corridor; in the air it drives nowhere."""
    pipeline, aside = on(Explore()), NodeId("r2", 1, 9)
    _, _, poses = live(walls, pipeline, 20)

    def asked(tick: int) -> Mission:
        pipeline._others.aside = aside
        pipeline.step(still(walls, poses[-1], tick, kidnapped=lifted))
        return pipeline.mission

    assert asked(20) == Explore(), "there is more to explore"
    pipeline._map_making._explorer._moves.phase = Phase.DONE
    assert asked(21) == (Explore() if lifted else GoTo(aside))


def test_no_server_makes_a_parked_robot_drive_for_ever(walls):
    """It says again and again, with another node each time, that the robot is in the way."""
    pipeline = Pipeline(MAP, BODY)
    pipeline.set_mission(GoTo(NodeId("r2", 1, 1)))
    for order in range(2):
        driven = []
        for tick in range(1, 20):
            pipeline._navigator.stage = NavigationStage.ARRIVED
            pipeline._others.aside = NodeId("r2", 1, 10 + tick)
            pipeline.step(still(walls, tick=20 * order + tick))
            driven.append(pipeline.mission.node.number)
        assert driven == [11, 12, *[13] * 17]
        pipeline.set_mission(GoTo(NodeId("r2", 1, 1)))

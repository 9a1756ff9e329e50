"""A goal that does not exist, or that nothing leads to: the robot gives it up and says why."""

import pytest

from mapweave.agent.motion_primitives import NO_ANSWER
from mapweave.agent.navigation.navigator import NavigationStage
from mapweave.agent.settings import NavigatorSettings
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import RouteAnswer
from tests.agent.scripted_fleet import (
    NOWHERE,
    WALL_AHEAD,
    B,
    Eyes,
    Trial,
    a_way,
    answering,
    bare,
    navigator,
    only_a_to_b,
)

UNKNOWN = NodeId("s", 1, 99)


def trial_without_a_route(
    home, answer: RouteAnswer | None, settings: NavigatorSettings | None = None
) -> Trial:
    """A robot that finds itself at A at once, and a fleet that always gives the same answer to routes."""
    eyes = Eyes(home, Pose2(2.5, 2.0))
    return Trial(navigator(eyes, NOWHERE, UNKNOWN, settings), eyes, answering(lambda _: answer))


def test_a_goal_that_does_not_exist_is_given_up_with_the_reason(home):
    """Before, the robot alternated for ever between waiting and looking: 56 relocalizations in 135 s."""
    trial = trial_without_a_route(home, RouteAnswer((), f"goal {UNKNOWN} is not in the merged map"))
    trial.run(135.0, lambda: trial.navigator.given_up)
    assert trial.navigator.statistics.relocalizations == 2, "its pose may be wrong: it looks once more"
    assert trial.navigator.stage == NavigationStage.GIVEN_UP and not trial.navigator.arrived
    assert f"goal {UNKNOWN} is not in the merged map" in trial.navigator.detail
    asked = len(trial.asked)
    trial.run(10.0)
    assert len(trial.asked) == asked, "and stands"
    assert not any(command.forward or command.turn for command in trial.commands[-90:])


def test_without_a_server_it_waits_for_one_before_it_gives_up(home):
    trial = trial_without_a_route(home, None, NavigatorSettings(patience=60.0))
    trial.run(50.0)
    assert not trial.navigator.given_up and trial.navigator.statistics.relocalizations <= 2
    trial.run(20.0, lambda: trial.navigator.given_up)
    assert trial.navigator.given_up
    assert NO_ANSWER in trial.navigator.detail and "60 s" in trial.navigator.detail


@pytest.mark.slow
def test_a_way_that_stays_blocked_is_given_up(home):
    """The server has a way each time that the block is forgotten; the robot never gets through."""
    eyes = Eyes(home, Pose2(2.5, 2.0))
    settings = NavigatorSettings(patience=100.0, blind_distance=1e9)
    nav = navigator(eyes, NOWHERE, B, settings)
    trial = Trial(nav, eyes, answering(only_a_to_b), WALL_AHEAD, held=True)
    trial.run(95.0)
    assert not trial.navigator.given_up
    trial.run(40.0, lambda: trial.navigator.given_up)
    assert trial.navigator.given_up and "blocked" in trial.navigator.detail


def test_who_gets_on_does_not_give_up(home):
    """A way of many edges takes longer than the patience; each edge that is driven renews it."""
    eyes = Eyes(home, Pose2(0.3, 2.0))
    nodes = [bare(NodeId("s", 1, number)) for number in range(1, 12)]
    fleet = answering(lambda _: a_way(*nodes, step=1.0))
    settings = NavigatorSettings(patience=12.0, blind_distance=1e9)
    trial = Trial(navigator(eyes, NOWHERE, nodes[-1].id, settings), eyes, fleet)
    trial.run(36.0)
    assert (
        not trial.navigator.given_up
        and trial.navigator.statistics.edges + trial.navigator.statistics.skipped >= 7
    )

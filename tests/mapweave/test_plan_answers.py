"""Answers in the coordinates of a floor plan: robots of `status`, places of `relocalize`."""

import math
from dataclasses import replace

import pytest

from mapweave import NodeId, Pose2, PoseGaussian
from mapweave.commands.plan import plan_place
from mapweave.commands.relocalize import _json, _print
from mapweave.commands.status import COLUMNS, cells
from mapweave.hybridmap.agent_status import AgentStatus, RobotEntry, Status
from mapweave.hybridmap.floor_plan import FloorPlan, PlacedPlan, PlanImage, PlanPair, PlanPart
from mapweave.hybridmap.pin import Pin
from tests.mapserver.stub_services import ANSWER

PLAN_FROM_MERGED = Pose2(10.0, 5.0, math.pi / 2)
PART = PlanPart(1, PLAN_FROM_MERGED, 0.05, (0.05, 0.0, 0.0, -0.05, 0.0, 0.0), (0.0,) * 16, 0.1, 0.1, (), 0.05)
PLAN = PlacedPlan(
    "office", FloorPlan((PlanPair(NodeId("r0", 1, 7), 0, 0, 0, 0),), PlanImage("0" * 64, 9, 9)), (PART,)
)


def robot(component: int) -> RobotEntry:
    status = Status("standing", "", 7, 0, Pose2(), False)
    return RobotEntry("r0", True, 0.0, AgentStatus(status, 1), Pose2(2.0, 1.0, 0.0), component)


def test_a_robot_is_shown_on_the_plan():
    at = COLUMNS.index("at")
    assert cells(robot(1), PLAN)[at] == "9.00,7.00 90°"
    assert cells(robot(0), PLAN)[at] == "not on plan office"
    assert cells(robot(0))[at] == "2.00,1.00 0°"


def test_nothing_is_minus_nothing():
    """A robot at the first node of its map was at -0.00,-0.00 m, -0 deg."""
    least = Pose2(-1e-5, -1e-5, -1e-5)
    there = replace(robot(0), merged_from_robot=least)
    assert cells(there)[COLUMNS.index("at")] == "0.00,0.00 0°"
    assert plan_place(PLAN, least) == "on plan office: 0.00,0.00 m, 0 deg"
    assert Pin(NodeId("r0", 1, 1), least).words == "at 0.000,0.000 m, 0.0 deg"


def test_a_place_of_a_photograph_is_given_on_the_plan(capsys):
    pose = PoseGaussian.from_sigmas(Pose2(2.0, 1.0, 0.0), 0.02, 0.01)
    found = replace(ANSWER.candidates[0], merged_from_robot=pose, component=1)
    answer = replace(ANSWER, candidates=(found, replace(found, component=0), ANSWER.candidates[0]))
    places = [place["plan_from_robot"] for place in _json(answer, PLAN)["candidates"]]
    assert places == [pytest.approx([9.0, 7.0, math.pi / 2]), None, None]
    assert "plan_from_robot" not in _json(answer, None)["candidates"][0]
    _print(answer, PLAN)
    out = capsys.readouterr().out
    assert out.count("on plan office: 9.00,7.00 m, 90 deg") == 1 and out.count("not on plan office") == 2

"""Answers that no robot can act on are refused with a reason."""

import pytest

from mapweave.agent.mission import WhereAmI, WhichWay
from mapweave.agent.replication.queries import FARTHEST, decode_answer
from mapweave.hybridmap.errors import InvalidMessage
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import Certainty, RelocalizeAnswer, RouteAnswer, RouteLeg, View, Whereabouts
from mapweave.wire.messages import encode
from tests.agent.scripted_fleet import EXACT, A, B, C, bare, here, straight


def route_of(*poses: Pose2) -> RouteAnswer:
    first, *others = (bare(node) for node in (A, B, C)[: 1 + len(poses)])
    hops = (RouteLeg(node, PoseGaussian(pose, EXACT), None) for node, pose in zip(others, poses, strict=True))
    return RouteAnswer((*straight(first), *hops), "a way")


def where(view: View, *places: Whereabouts) -> RelocalizeAnswer:
    payload = encode(RelocalizeAnswer(Certainty.FOUND, places, "here"))
    answer = decode_answer(WhereAmI(1, view), payload)
    assert isinstance(answer, RelocalizeAnswer)
    return answer


@pytest.mark.parametrize("far", [Pose2(1e6), Pose2(0.0, -FARTHEST - 1.0)])
def test_a_leg_of_a_million_metres_is_refused(far: Pose2):
    question = WhichWay(1, A, C)
    decode_answer(question, encode(route_of(Pose2(1.0), Pose2(FARTHEST - 1.0))))
    with pytest.raises(InvalidMessage, match=rf"route: the leg to node {C} is \d+ m away, more than 100 m"):
        decode_answer(question, encode(route_of(Pose2(1.0), far)))


def test_a_route_to_another_node_is_refused():
    with pytest.raises(InvalidMessage, match=f"route: it ends at node {B}, not at {C}"):
        decode_answer(WhichWay(1, A, C), encode(route_of(Pose2(1.0))))


def test_a_circle_and_a_way_that_was_blocked_are_refused():
    a, b, c = (bare(node) for node in (A, B, C))
    with pytest.raises(InvalidMessage, match=f"route: it leads in a circle, to node {A} twice"):
        decode_answer(WhichWay(1, A, C), encode(RouteAnswer(straight(a, b, a, b, c), "a way")))
    blocked = WhichWay(1, A, C, blocked=((C, B),))
    with pytest.raises(InvalidMessage, match=f"from {B} to {C}, where the robot did not get through"):
        decode_answer(blocked, encode(RouteAnswer(straight(a, b, c), "a way")))


def test_no_way_is_an_answer():
    answer = decode_answer(WhichWay(1, A, C), encode(RouteAnswer((), "all blocked")))
    assert isinstance(answer, RouteAnswer)
    assert answer.reason == "all blocked"


def test_a_place_a_million_metres_from_its_node_is_refused_and_costs_no_better_one():
    view = View(bare(A).camera, bare(A).landmarks.pixels, bare(A).landmarks.codes)
    near, far = here(A, Pose2(1.0)), here(B, Pose2(1e6))
    assert where(view, near, far).candidates[0].node == A
    with pytest.raises(InvalidMessage, match=f"seen from node {B}, is 1000000 m away"):
        where(view, far, near)

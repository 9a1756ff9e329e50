"""Weak answers count together only if the robot moved between them, and as the wheels say."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mapweave import NodeId, Pose2, PoseGaussian
from mapweave.agent.global_localization.view_agreement import MEMORY, ViewAgreement
from mapweave.hybridmap.query import NO_COMPONENT, Certainty, RelocalizeAnswer, Whereabouts

FIRST, SECOND = NodeId("r1", 1, 1), NodeId("r1", 1, 2)
MERGED_FROM = {FIRST: Pose2(), SECOND: Pose2(3.0, 1.0, 0.7)}


def weak(node: NodeId, merged_from_robot: Pose2, sigma: float = 0.05, component: int = 0) -> RelocalizeAnswer:
    """An answer that is no proof alone."""
    here = PoseGaussian.from_sigmas(MERGED_FROM[node].inverse() @ merged_from_robot, sigma, sigma / 3)
    merged = None if component == NO_COMPONENT else PoseGaussian(merged_from_robot, here.covariance)
    place = Whereabouts(node, here, merged, component, 12, 0.9)
    return RelocalizeAnswer(Certainty.UNKNOWN, (place,), "not sure")


poses = st.builds(Pose2, st.floats(-3, 3), st.floats(-3, 3), st.floats(-math.pi, math.pi))
steps = st.builds(Pose2, st.floats(0.4, 2.0), st.floats(-0.2, 0.2), st.floats(-0.6, 0.6))


@given(begin=poses, odom=poses, step=steps, node=st.sampled_from([FIRST, SECOND]))
def test_two_weak_views_of_one_place_are_a_proof(begin: Pose2, odom: Pose2, step: Pose2, node: NodeId):
    """Wherever the wheels' frame begins, and whether one node was recognised or two of one component."""
    agreement = ViewAgreement()
    assert agreement.take(weak(FIRST, begin), odom, 5.0, 3.0) is None
    way, turned = 5.0 + math.hypot(step.x, step.y), 3.0 + abs(step.heading)
    place = agreement.take(weak(node, begin @ step), odom @ step, way, turned)
    assert place is not None and place.node == node


@given(begin=poses, step=steps, off=st.sampled_from([Pose2(1.2, 0, 0), Pose2(0, -1.2, 0), Pose2(0, 0, 0.6)]))
def test_another_motion_than_the_wheels_measured_is_none(begin: Pose2, step: Pose2, off: Pose2):
    agreement = ViewAgreement()
    agreement.take(weak(FIRST, begin), Pose2(), 0.0, 0.0)
    assert agreement.take(weak(FIRST, begin @ step @ off), step, abs(step.x), abs(step.heading)) is None


def test_the_same_view_again_proves_nothing():
    agreement, noise = ViewAgreement(), np.random.default_rng(0)
    for _ in range(40):
        here = Pose2(*noise.normal(0.0, 0.01, 3))
        assert agreement.take(weak(FIRST, here), Pose2(), 0.0, 0.0) is None
    assert agreement.take(weak(FIRST, Pose2(0.6, 0, 0)), Pose2(0.6, 0, 0), 0.6, 0.0) is not None


def test_vague_poses_need_more_motion():
    """With a sigma of 0.5 m, 0.6 m of driving are not seen in the poses; 5 m are."""
    for way, certain in ((0.6, False), (5.0, True)):
        agreement = ViewAgreement()
        agreement.take(weak(FIRST, Pose2(), 0.5), Pose2(), 0.0, 0.0)
        moved = Pose2(way, 0.0, 0.0)
        assert (agreement.take(weak(FIRST, moved, 0.5), moved, way, 0.0) is not None) == certain


def test_what_is_not_joined_or_long_ago_is_not_compared():
    step = Pose2(1.0, 0.0, 0.0)
    for component, begun in ((NO_COMPONENT, 0.0), (1, 0.0), (0, -MEMORY)):
        agreement = ViewAgreement()
        agreement.take(weak(FIRST, Pose2()), Pose2(), begun, 0.0)
        assert agreement.take(weak(SECOND, step, component=component), step, 1.0, 0.0) is None


def test_an_answer_that_is_certain_needs_no_other_and_an_ambiguous_one_is_none():
    answer = weak(FIRST, Pose2())
    agreement = ViewAgreement()
    found = RelocalizeAnswer(Certainty.FOUND, answer.candidates, "")
    assert agreement.take(found, Pose2(), 0.0, 0.0) is answer.candidates[0]
    ambiguous = RelocalizeAnswer(Certainty.AMBIGUOUS, answer.candidates, "")
    assert agreement.take(ambiguous, Pose2(), 0.0, 0.0) is None
    step = Pose2(1.0, 0.0, 0.0)
    assert agreement.take(weak(FIRST, step), step, 1.0, 0.0) is None, "the ambiguous one is no second view"

"""Recognising places in a synthetic world with known truth."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Landmarks, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.registration import recognition
from mapweave.registration.recognition import (
    Recognition,
    RecognitionFailure,
    RecognitionSettings,
    examine_nodes,
    examine_view,
    recognise,
    register,
)
from synthetic.world import CAMERA, Sensing, World, room, take_node, take_view
from tests.hybridmap.kernel_forms import form
from tests.registration.test_projection import levelled

__all__ = ["form"]

pytestmark = pytest.mark.usefixtures("form")

HERE = PoseGaussian.from_sigmas(Pose2(), 0.01, 0.01)


def world(seed: int = 1) -> World:
    return room(0, 0, 5, 4, 700, np.random.default_rng(seed))


def node_at(where: Pose2, rng: np.random.Generator, number: int = 1, sensing: Sensing | None = None) -> Node:
    return take_node(world(), NodeId("r0", 1, number), where, HERE, rng, sensing)


def near(where: Pose2, rng: np.random.Generator) -> Pose2:
    return where @ Pose2(*rng.uniform([-0.5, -0.4, -0.25], [0.5, 0.4, 0.25]))


def somewhere(rng: np.random.Generator) -> Pose2:
    return Pose2(*rng.uniform([1.5, 1.2, -3.1], [3.5, 2.8, 3.1]))


def test_views_nearby_are_recognised_with_an_honest_pose():
    rng = np.random.default_rng(2)
    distances, count = [], 0
    for _ in range(60):
        a = somewhere(rng)
        b = near(a, rng)
        view, _ = take_view(world(), b, rng)
        recognition = recognise(node_at(a, rng), view, None, rng)
        if recognition is not None:
            count += 1
            distances.append(recognition.node_from_robot.mahalanobis2(a.inverse() @ b))
    assert count >= 50
    assert max(distances) < 20 and np.mean(distances) < 3.5


@pytest.mark.parametrize("pitch", [-0.012, 0.012])
def test_a_camera_that_looks_further_up_or_down_recognises_as_much(pitch: float):
    """0.7 degrees, 3 px: a planar pose is 7 of its sigmas off then."""
    rng, distances, shares = np.random.default_rng(12), [], []
    sharp = Sensing(pixel_sigma=0.3, depth_share=0.02)
    for _ in range(40):
        a = somewhere(rng)
        b = near(a, rng)
        view, _ = take_view(world(), b, rng, sharp)
        pixels = levelled(view.pixels, np.full(len(view), -pitch), CAMERA).astype(np.float32)
        recognition = recognise(node_at(a, rng, 1, sharp), replace(view, pixels=pixels), None, rng)
        if recognition is not None:
            assert recognition.pitch == pytest.approx(pitch, abs=0.004)
            distances.append(recognition.node_from_robot.mahalanobis2(a.inverse() @ b))
            shares.append(recognition.inliers / recognition.usable)
    assert len(distances) >= 34 and np.median(shares) > 0.9
    assert max(distances) < 20 and np.mean(distances) < 3.5


def test_nodes_of_cameras_that_look_differently_far_up_are_registered():
    """In one estimate with points of either: what one camera sees too low the other sees too high."""
    rng, found = np.random.default_rng(14), []
    for _ in range(30):
        a = somewhere(rng)
        b = near(a, rng)
        node, other = (node_at(where, rng, number) for number, where in ((1, a), (2, b)))
        seen = other.landmarks
        pixels = levelled(seen.pixels, np.full(len(seen), -0.012), CAMERA).astype(np.float32)
        other = replace(other, landmarks=replace(seen, pixels=pixels))
        recognition = register(node, other, None, rng)
        if recognition is not None:
            assert recognition.pitch == pytest.approx(0.012, abs=0.005)
            found.append(recognition.node_from_robot.mahalanobis2(a.inverse() @ b))
    assert len(found) >= 25
    assert max(found) < 20 and np.mean(found) < 3.5


def test_pairs_are_the_same_landmarks():
    rng = np.random.default_rng(3)
    where = Pose2(2.5, 2.0, 0.3)
    seed = int(rng.integers(1000))
    node = node_at(where, np.random.default_rng(seed))
    _, behind_node = take_view(world(), where, np.random.default_rng(seed))
    view, behind_view = take_view(world(), near(where, rng), rng)
    recognition = recognise(node, view, None, rng)
    assert recognition is not None
    a, b = behind_node[recognition.pairs[:, 0]], behind_view[recognition.pairs[:, 1]]
    assert (a == b).mean() > 0.97
    assert recognition.inliers == len(recognition.pairs) == recognition.evidence["inliers"]


def test_views_of_elsewhere_are_not_recognised():
    rng = np.random.default_rng(4)
    for _ in range(40):
        a = somewhere(rng)
        view, _ = take_view(world(99), near(a, rng), rng)
        verdict = examine_view(node_at(a, rng), view, None, rng)
        assert isinstance(verdict, RecognitionFailure) and verdict.reason


def test_two_nodes_register_the_same_in_both_directions():
    rng = np.random.default_rng(5)
    distances, sure = [], []
    for _ in range(30):
        a, b = (where := somewhere(rng)), near(where, rng)
        first, second = node_at(a, rng), node_at(b, rng, 2)
        there, back = register(first, second, None, rng), register(second, first, None, rng)
        if there is None or back is None:
            continue
        true = a.inverse() @ b
        distances.append(there.node_from_robot.mahalanobis2(true))
        # The same information is used either way, up to which side's depths are used for shared landmarks.
        difference = back.node_from_robot.inverse()
        assert there.node_from_robot.mahalanobis2(difference.mean) < 3.0
        sure.append(there.evidence["inliers_3d"])
    assert len(distances) > 20 and np.mean(distances) < 3.5
    assert np.mean(sure) > 10


def test_depths_of_only_one_side_suffice_whichever_it_is():
    rng = np.random.default_rng(6)
    a = Pose2(2.5, 2.0, 0.3)
    b = a @ Pose2(0.2, -0.1, 0.1)
    first, second = node_at(a, rng), node_at(b, rng, 2)
    unknown = np.full(len(second.landmarks), np.nan, np.float32)
    flat = replace(second, landmarks=replace(second.landmarks, depths=unknown, depth_sigmas=unknown))
    for verdict, true in (
        (examine_nodes(first, flat, None, rng), a.inverse() @ b),
        (examine_nodes(flat, first, None, rng), b.inverse() @ a),
    ):
        assert isinstance(verdict, Recognition)
        assert verdict.node_from_robot.mahalanobis2(true) < 16.3


def test_depths_that_do_not_agree_are_refused():
    """A poster twice as large, twice as far away: every pixel fits, the depths do not."""
    rng = np.random.default_rng(7)
    a = Pose2(2.5, 2.0, 0.3)
    first, second = node_at(a, rng), node_at(a, rng, 2)
    landmarks = second.landmarks
    double = replace(landmarks, depths=landmarks.depths * 2, depth_sigmas=landmarks.depth_sigmas * 2)
    assert register(first, second, None, rng) is not None
    assert register(first, replace(second, landmarks=double), None, rng) is None


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"least_inliers": 200}, "are needed"),
        ({"least_cells": 24}, "image cells"),
        ({"least_seen": 1.01}, "should be in the image"),
        ({"LEAST_SHARE": 1.01}, "of the matches agree"),
    ],
)
def test_each_rule_refuses_with_its_own_reason(change: dict[str, float], word: str, monkeypatch):
    for name, value in change.items():
        if name.isupper():
            monkeypatch.setattr(recognition, name, value)
    settings = RecognitionSettings(**{k: v for k, v in change.items() if k.islower()})  # type: ignore[arg-type]
    rng = np.random.default_rng(8)
    a = Pose2(2.5, 2.0, 0.3)
    view, _ = take_view(world(), near(a, rng), rng)
    verdict = examine_view(node_at(a, rng), view, settings, rng)
    assert isinstance(verdict, RecognitionFailure) and word in verdict.reason


@pytest.mark.parametrize(("distance", "linked"), [(0.05, True), (0.5, False)])
def test_a_rival_pose_nearer_than_the_position_may_be_uncertain_refuses_nothing(
    distance: float, linked: bool, monkeypatch
):
    """The landmarks are about 2 m away, and 6 % of that is allowed."""
    solve = recognition.solve_sightings

    def two_poses(*args: Any, **names: Any) -> Any:
        fix = solve(*args, **names)
        assert fix is not None
        return replace(fix, rival=0.95, rival_distance=distance)

    monkeypatch.setattr(recognition, "solve_sightings", two_poses)
    rng = np.random.default_rng(8)
    a = Pose2(2.5, 2.0, 0.3)
    view, _ = take_view(world(), near(a, rng), rng)
    verdict = examine_view(node_at(a, rng), view, None, rng)
    if linked:
        assert isinstance(verdict, Recognition) and verdict.evidence["rival"] == 0.0
    else:
        assert isinstance(verdict, RecognitionFailure) and "on the other side" in verdict.reason


def test_a_patch_in_a_corner_does_not_make_a_place():
    """The same small poster in another room: many inliers, all in one corner of the image."""
    rng = np.random.default_rng(9)
    a = Pose2(2.5, 2.0, 0.0)
    node, (view, _) = node_at(a, rng), take_view(world(), a, rng, Sensing(most=300))
    corner = (view.pixels[:, 0] < 80) & (view.pixels[:, 1] < 120)
    foreign, _ = take_view(world(99), a, rng)
    mixed = replace(
        foreign,
        pixels=np.concatenate([view.pixels[corner], foreign.pixels]),
        codes=np.concatenate([view.codes[corner], foreign.codes]),
    )
    assert isinstance(examine_view(node, mixed, None, rng), RecognitionFailure)


def test_empty_nodes_and_views_are_refused_in_words():
    rng = np.random.default_rng(10)
    a = Pose2(2.5, 2.0, 0.0)
    empty = replace(node_at(a, rng), landmarks=Landmarks.empty())
    view, _ = take_view(world(), a, rng)
    verdict = examine_view(empty, view, None, rng)
    assert isinstance(verdict, RecognitionFailure) and "0 features match" in verdict.reason

"""Views that show nothing of what another robot has mapped there: distinguished from occluded views."""

import math
from dataclasses import replace

import numpy as np
import pytest

from mapweave.hybridmap.node import Landmarks, NodeId
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.merge.mutual_exclusion import negative_evidence as rules
from mapweave.merge.mutual_exclusion.exclusion import clash_of
from mapweave.merge.mutual_exclusion.negative_evidence import Views, negative_evidence, should_show
from tests.merge.mutual_exclusion.rooms import CAMERA, Room, meeting

NOTHING, SOMETHING = (
    math.log((1 - rules.ALIKE) / rules.MISSED),
    math.log(rules.ALIKE / (1 - rules.MISSED)),
)


def test_the_same_room_is_evidence_for_a_merge() -> None:
    views = negative_evidence(*meeting(Room(), Room()))
    assert len(views.expected) == 24 and (views.found > 0.7 * views.expected).all()
    assert views.evidence() == pytest.approx(4 * SOMETHING)


@pytest.mark.parametrize("changed", [(0,), (1, 3), (0, 1, 2, 3)])
def test_walls_of_others_count_against_it_once_each(changed: tuple[int, ...]) -> None:
    views = negative_evidence(*meeting(Room(), Room(changed)))
    assert views.show_nothing().sum() == 6 * len(changed)
    expected = len(changed) * NOTHING + (4 - len(changed)) * SOMETHING
    assert views.evidence() == pytest.approx(min(expected, math.log(rules.MOST)))


def test_no_evidence_from_other_hours_or_unknown_poses() -> None:
    other = Room((0, 1, 2, 3))
    assert len(negative_evidence(*meeting(Room(), other, late=4000.0)).expected) == 0
    assert len(negative_evidence(*meeting(Room(), other, sigma=0.2)).expected) == 0


def test_occluded_and_unobserved_landmarks_are_not_missed() -> None:
    """Against rays that are marched: a board before half of the wall, and a view with half of its depths."""
    rng = np.random.default_rng(3)
    room = Room()
    node = room.node(NodeId("a", 1, 0), 0.0, Pose2())
    view = room.node(NodeId("b", 1, 0), 0.0, Pose2(0.3, 0.0, 0.05))
    shown, pixels = should_show(node, view, Pose2(0.3, 0.0, 0.05))
    assert len(shown) > 60
    # A board 1 m before the view: landmarks on it, to the left of the middle.
    left = np.column_stack([rng.uniform(5, 140, 60), rng.uniform(5, 235, 60)]).astype(np.float32)
    board = Landmarks(
        left, rng.integers(0, 256, (60, 32), np.uint8), *np.tile([[1.0], [0.02]], 60).astype("f4")
    )
    old = view.landmarks.take(view.landmarks.pixels[:, 0] > 160)
    both = Landmarks(*(np.concatenate([getattr(old, n), getattr(board, n)]) for n in
                       ("pixels", "codes", "depths", "depth_sigmas")))  # fmt: skip
    hidden, _ = should_show(node, replace(view, landmarks=both), Pose2(0.3, 0.0, 0.05))
    assert 10 < len(hidden) < len(shown) and set(hidden) < set(shown)
    where = dict(zip(shown.tolist(), pixels[:, 0], strict=True))
    assert min(where[k] for k in hidden.tolist()) > 140 - rules.AROUND * CAMERA.fx
    # Without the board nobody knows how far the view looked there.
    half, _ = should_show(node, replace(view, landmarks=old), Pose2(0.3, 0.0, 0.05))
    assert min(where[k] for k in half.tolist()) > 160 - rules.AROUND * CAMERA.fx
    # From another side, or much nearer, things look different.
    for pose in (Pose2(0.0, 1.5, -0.4), Pose2(1.2, 0.0, 0.0)):
        near = room.node(NodeId("b", 1, 0), 0.0, pose)
        assert len(should_show(node, near, pose)[0]) < 0.2 * len(shown)


@pytest.mark.parametrize("missed", [0.0, 0.01, rules.MISSED])
def test_a_true_merge_has_mean_odds_of_at_most_one(missed: float) -> None:
    """Views miss as seldom as is allowed, all views of one place together or each by itself."""
    rng = np.random.default_rng(4)
    for together in (True, False):
        odds = []
        for _ in range(4000):
            places = np.repeat(rng.uniform(-20, 20, (rng.integers(1, 9), 2)), 3, axis=0)
            draws = rng.random(len(places) // 3).repeat(3) if together else rng.random(len(places))
            expected = np.full(len(places), 40)
            odds.append(math.exp(Views(places, expected, np.where(draws < missed, 0, 15)).evidence()))
        assert np.mean(odds) < 1.0 + 3.0 * np.std(odds) / math.sqrt(len(odds))


def test_it_adds_evidence_and_never_decides_alone() -> None:
    """Three looks in which the sensors saw nothing are 500 to 1; 1000 are asked for."""
    twin = Room((0, 2))
    found = clash_of(*meeting(Room(), twin, looks=3))
    assert found is not None and found.blank == 12
    assert "12 views of theirs show nothing of what the other one mapped there" in found.reason
    assert clash_of(*meeting(Room(), Room(), looks=3)) is None
    with pytest.MonkeyPatch.context() as deaf:
        deaf.setattr(rules, "MOST", 1.0)
        deaf.setattr("mapweave.merge.mutual_exclusion.exclusion.MOST", 1.0)
        assert clash_of(*meeting(Room(), twin, looks=3)) is None
    assert clash_of(*meeting(Room(), Room((0, 1, 2, 3)))) is None
    # Four looks are enough by themselves, and nothing is said of views.
    alone = clash_of(*meeting(Room(), Room(), looks=4))
    assert alone is not None and alone.blank == 0 and alone.reason.endswith("such moments")


def test_places_count_and_not_the_order_of_views() -> None:
    rng = np.random.default_rng(5)
    places: Array = np.array([[0.0, 0.0], [9.0, 0.0], [0.0, 9.0]])[rng.integers(0, 3, 20)]
    views = Views(places + rng.uniform(-0.2, 0.2, (20, 2)), np.full(20, 30), rng.integers(0, 3, 20) * 10)
    order = rng.permutation(20)
    other = Views(views.places[order], views.expected[order], views.found[order])
    assert len(set(views.place_numbers())) == 3
    assert views.evidence() == pytest.approx(other.evidence())

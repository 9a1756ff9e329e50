"""Sightings of tracks against a plain table."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave.agent.mapping.track_history import TrackHistory
from mapweave.hybridmap.pose import Pose2


def seen(*ids: int) -> tuple[np.ndarray, np.ndarray]:
    """Tracks and distinct made-up pixels."""
    numbers = np.array(ids, np.int64)
    return numbers, np.column_stack([numbers * 10.0, numbers + 0.5])


def test_standing_still_adds_nothing():
    history = TrackHistory(step=0.02, turn_step=0.05)
    for pose in (Pose2(), Pose2(0.01, 0, 0), Pose2(0.019, 0, 0.04), Pose2(0.03, 0, 0), Pose2(0.03, 0, 0.06)):
        history.record(pose, *seen(1))
    poses, _ = history.observations(np.array([1]))
    assert poses[:, 0].tolist() == [0.0, 0.03, 0.03]
    history.record(Pose2(0.03, 0, 0.06), *seen(1), force=True)
    assert len(history.observations(np.array([1]))[0]) == 4


def test_the_history_keeps_its_own_arrays():
    history = TrackHistory()
    ids, pixels = seen(1, 2)
    history.record(Pose2(), ids, pixels)
    pixels[:] = -1
    ids[:] = 7
    assert history.observations(np.array([2]))[1].tolist() == [[[20.0, 2.5]]]


@settings(max_examples=60)
@given(
    st.lists(st.sets(st.integers(0, 12)), min_size=1, max_size=12),
    st.lists(st.integers(0, 15), unique=True, max_size=10),
)
def test_the_history_returns_the_recorded_observations(frames, wanted):
    history = TrackHistory()
    table: list[dict[int, list[float]]] = []
    for k, frame in enumerate(frames):
        numbers = list(frame)
        at = [[100.0 * k + n, 3.0 * n] for n in numbers]
        history.record(Pose2(k, -k, 0.1 * k), np.array(numbers, np.int64), np.array(at).reshape(-1, 2))
        table.append(dict(zip(numbers, at, strict=True)))
    poses, pixels = history.observations(np.array(wanted, np.int64))
    assert poses.tolist() == [[k, -k, 0.1 * k] for k in range(len(frames))]
    assert pixels.shape == (len(frames), len(wanted), 2)
    for k, known in enumerate(table):
        for column, track in enumerate(wanted):
            if track in known:
                assert pixels[k, column].tolist() == known[track]
            else:
                assert np.isnan(pixels[k, column]).all()


def test_long_drives_keep_a_bounded_even_choice():
    history = TrackHistory(most=40)
    for k in range(1000):
        history.record(Pose2(0.1 * k), *seen(1))
    poses, _ = history.observations(np.array([1]))
    assert 20 <= len(poses) <= 40
    assert poses[0, 0] == 0.0
    assert (np.diff(poses[:, 0]) > 0).all()


def test_a_new_anchor_sees_the_same_world():
    """Only who counts as the origin changes: relative poses and pixels stay."""
    rng = np.random.default_rng(0)
    history = TrackHistory()
    drive = [Pose2(*rng.uniform(-1, 1, 3)) for _ in range(6)]
    for k, pose in enumerate(drive):
        history.record(pose, *seen(1, 2, *([3] if k == 4 else [])))
    history.reanchor(drive[-1], np.array([1, 3]))
    poses, pixels = history.observations(np.array([1, 2, 3]))
    assert len(poses) == len(drive)
    for row, pose in zip(poses, drive, strict=True):
        assert np.allclose((drive[-1] @ Pose2.from_vector(row)).vector, pose.vector)
    assert np.isnan(pixels[:, 1]).all(), "tracks that ended are forgotten"
    assert (pixels[:, 0] == [10.0, 1.5]).all()
    assert np.isfinite(pixels[4, 2]).all()
    history.reanchor(Pose2(), np.array([3]))
    assert len(history.observations(np.array([3]))[0]) == 1, "a view with no active track is forgotten"

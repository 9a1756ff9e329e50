"""Tracks of one node's landmarks: where they are followed to, and which are given up."""

import numpy as np
import pytest

from mapweave.agent.vision.node_tracks import NodeTracks
from mapweave.hybridmap.pose import Pose2
from mapweave.registration.recognition import recognise
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Features, Sift

HERE, BESIDE = Pose2(), Pose2(0.0, 0.02)


@pytest.fixture
def features(walls, description) -> Features:
    """Of the view from the origin."""
    return Sift(Lens(description.camera, description.distortion)).extract(walls.render(HERE))


@pytest.fixture
def pairs(node, description, features) -> np.ndarray:
    """The node's landmarks in them."""
    recognition = recognise(node, features.view(description.camera), None, np.random.default_rng(0))
    assert recognition is not None
    return recognition.pairs


@pytest.fixture
def tracks(walls, description, features, pairs) -> NodeTracks:
    """Of the landmarks that were recognised there."""
    return NodeTracks(
        Lens(description.camera, description.distortion), walls.render(HERE), features, pairs, most_refusals=2
    )


def test_they_go_where_the_landmarks_go(walls, description, node, tracks, pairs):
    assert tracks.ids.tolist() == pairs[:, 0].tolist()
    tracks.follow(walls.render(BESIDE), np.full((len(pairs), 2), np.nan))
    assert len(tracks.ids) > 0.8 * len(pairs)
    there = description.camera.project(BESIDE.inverse().apply(node.points_in_robot[tracks.ids]))
    known = np.isfinite(there).all(axis=1)
    assert known.sum() > 30
    assert np.median(np.linalg.norm(there - tracks.pixels, axis=1)[known]) < 1.0


def test_a_track_rejected_twice_in_a_row_is_dropped(tracks):
    ids = tracks.ids.copy()
    bad, wavering = ids[0], ids[1]
    assert not len(tracks.judge(~np.isin(ids, [bad, wavering])))
    assert tracks.ids.tolist() == ids.tolist()
    assert tracks.judge(ids != bad).tolist() == [bad]
    assert tracks.ids.tolist() == ids[1:].tolist()
    assert not len(tracks.judge(tracks.ids != wavering)), "it was believed in between"
    assert len(tracks.pixels) == len(ids) - 1


def test_a_new_detection_restores_all_tracks_and_resets_the_rejections(walls, tracks, features, pairs):
    ids = tracks.ids.copy()
    tracks.judge(ids != ids[0])
    tracks.follow(np.full_like(walls.render(HERE), 3), np.full((len(ids), 2), np.nan))
    assert not len(tracks.ids), "the lights were out"
    tracks.follow(walls.render(HERE), np.zeros((0, 2)))
    tracks.renew(features, pairs)
    assert tracks.ids.tolist() == ids.tolist()
    assert not len(tracks.judge(ids != ids[0]))

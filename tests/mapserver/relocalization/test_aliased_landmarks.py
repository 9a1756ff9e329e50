"""What looks alike on the map, and what rests on one thing, in small synthetic worlds."""

from dataclasses import replace

import numpy as np

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import View
from mapweave.mapserver.relocalization.aliased_landmarks import unexplained
from mapweave.mapserver.relocalization.place_hypotheses import hidden, is_one_thing
from mapweave.registration.recognition import Recognition, recognise
from synthetic.world import CAMERA, Sensing, room, take_node, take_view

NOTHING = np.zeros((0, 2))
HERE = PoseGaussian.from_sigmas(Pose2(), 0.01, 0.01)
AT = Pose2(2.2, 2.0, 0.3)
WORLD = room(0, 0, 5, 4, 500, np.random.default_rng(1))


def node(number: int, at: Pose2, seed: int):
    return take_node(WORLD, NodeId("r0", 1, number), at, HERE, np.random.default_rng(seed))


def test_matches_that_a_pose_explains():
    one = node(1, AT, 2)
    known = np.flatnonzero(one.landmarks.has_depth)[:20]
    pixels = one.landmarks.pixels[known].copy()
    pixels[:5] += 30.0
    pairs = np.column_stack([known, np.arange(20)])
    assert unexplained(one, pairs, pixels, one.camera, Pose2(), 12.0) == 5


def test_matches_on_one_thing_count_as_isolated_only_if_the_rest_is_missing():
    one = node(1, AT, 2)
    points = one.landmarks.points_in_robot(one.camera)
    known = np.flatnonzero(one.landmarks.has_depth)
    middle = points[known[len(known) // 2]]
    near = known[np.argsort(np.linalg.norm(points[known] - middle, axis=1))[:12]]
    view, _ = take_view(WORLD, AT, np.random.default_rng(4), Sensing(most=150))
    recognition = recognise(one, view, None, np.random.default_rng(0))
    assert recognition is not None
    evidence = {**recognition.evidence, "seen": 0.4}

    def resting_on(landmarks: np.ndarray, camera: Camera, others: np.ndarray = NOTHING) -> bool:
        """Of a view that shows these landmarks, and other features at these pixels."""
        pixels = np.concatenate([one.landmarks.pixels[landmarks], others]).astype(np.float32)
        seen = View(pixels, np.zeros((len(pixels), 32), np.uint8), camera)
        pairs = np.column_stack([landmarks, np.arange(len(landmarks))])
        result: Recognition = replace(recognition, node_from_robot=HERE, pairs=pairs, evidence=evidence)
        return is_one_thing(one, seen, result)

    spread = float(np.sqrt(np.linalg.eigvalsh(np.cov(points[near][:, :2].T))[-1]))
    assert spread < 0.35
    assert resting_on(near, one.camera)
    assert not resting_on(known[:: max(len(known) // 12, 1)], one.camera)  # all over the room
    # A camera that sees nothing but the thing: nothing else is to be expected.
    u, v = one.landmarks.pixels[near].mean(axis=0)
    narrow = replace(
        one.camera, width=16, height=16, cx=float(one.camera.cx - u) + 8, cy=float(one.camera.cy - v) + 8
    )
    assert not resting_on(near, narrow)
    # Where the whole view is full of other things, some of it may be hidden, not all.
    clutter = np.random.default_rng(5).uniform(0, [320, 240], (60, 2))
    assert resting_on(near, one.camera, clutter)


def test_a_person_occludes_one_strip():
    """Against all strips that begin at a missing landmark, feature by feature."""
    rng, counts = np.random.default_rng(6), set()
    recognition = recognise(node(1, AT, 2), take_view(WORLD, AT, np.random.default_rng(4))[0], None, rng)
    assert recognition is not None
    for _ in range(60):
        agree, missing = int(rng.integers(5, 20)), rng.uniform(0, 320, int(rng.integers(1, 15)))
        across = np.concatenate([rng.normal(rng.uniform(60, 260), 40, agree), rng.uniform(0, 320, 20)])
        pixels = np.column_stack([across, np.full(len(across), 100.0)]).astype(np.float32)
        view = View(pixels, np.zeros((len(across), 32), np.uint8), CAMERA)
        result = replace(recognition, pairs=np.column_stack([np.arange(agree)] * 2))
        most = 0
        for left in missing:
            strip = [k for k, u in enumerate(pixels[:, 0]) if left <= u <= left + 128]
            own, others = [k for k in strip if k < agree], [k for k in strip if k >= agree]
            if len(own) <= agree / 10 and len(others) >= 3:
                most = max(most, sum(left <= u <= left + 128 for u in missing))
        assert hidden(missing, view, result) == most
        counts.add(most)
    assert len(counts) > 4 and 0 in counts

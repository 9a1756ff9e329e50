"""Structure from motion, against a walk whose truth is known, by a camera that is not level."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mapweave import Camera, View
from mapweave.hybridmap.descriptor import quantise
from mapweave.hybridmap.errors import InvalidValue
from mapweave.structure_from_motion import CAMERA_FROM_LEVEL, Structure, pose_by_points, reconstruct
from synthetic.world import random_vectors

CAMERA = Camera(640, 480, 520.0, 522.0, 318.0, 243.0, mount_height=1.3)


class Walk:
    """Photographs of random points on the walls of a room, taken along its middle."""

    def __init__(self, seed: int, count: int = 7, spacing: float = 0.6, wrong: float = 0.1) -> None:
        rng = np.random.default_rng(seed)
        along, aside = rng.uniform(0.5, 9.0, 500), rng.choice([-1.6, 1.7], 500)
        wall = np.column_stack([along, aside, rng.uniform(0.1, 2.6, 500)])
        end = np.column_stack([np.full(150, 9.0), rng.uniform(-1.6, 1.7, 150), rng.uniform(0.1, 2.6, 150)])
        self.points = np.concatenate([wall, end])
        vectors = random_vectors(len(self.points), rng)
        self.rotations, self.centres, self.views = [], [], []
        for k in range(count):
            yaw, pitch, roll = rng.normal(0.0, [0.1, 0.02, 0.02])
            turn = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix() @ CAMERA_FROM_LEVEL.T
            centre = np.array([k * spacing, rng.normal(0.0, 0.05), 1.3 + rng.normal(0.0, 0.02)])
            local = (self.points - centre) @ turn
            with np.errstate(divide="ignore", invalid="ignore"):
                pixels = local[:, :2] / local[:, 2:] * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]
            pixels = pixels + rng.normal(0.0, 0.4, pixels.shape)
            seen = np.flatnonzero((local[:, 2] > 0.5) & CAMERA.contains(pixels))
            seen = rng.permutation(seen)[:150]
            views = vectors[seen] + rng.normal(0.0, 0.03, (len(seen), vectors.shape[1]))
            # Some look like what is elsewhere.
            swapped = rng.permutation(len(seen))[: int(wrong * len(seen))]
            views[swapped] = views[rng.permutation(swapped)]
            self.views.append(View(pixels[seen].astype(np.float32), quantise(views), CAMERA))
            self.rotations.append(turn)
            self.centres.append(centre)

    def off(self, structure: Structure) -> tuple[np.ndarray, np.ndarray, float]:
        """Position errors (K,) m and orientation errors (K,) rad after the best similarity; the scale."""
        true, got = np.array(self.centres), structure.centres
        a, b = true - true.mean(axis=0), got - got.mean(axis=0)
        turn, _ = Rotation.align_vectors(a, b)
        scale = float((a * turn.apply(b)).sum() / (b**2).sum())
        errors = np.linalg.norm(a - scale * turn.apply(b), axis=1)
        relative = [
            (
                Rotation.from_matrix(structure.rotations[0].T @ one) * Rotation.from_matrix(known).inv()
            ).magnitude()
            for one, known in zip(
                structure.rotations, [self.rotations[0].T @ r for r in self.rotations], strict=True
            )
        ]
        return errors, np.array(relative), scale


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_a_walk_is_found_again_up_to_its_scale(seed: int):
    walk = Walk(seed)
    errors, turns, scale = walk.off(reconstruct(walk.views, 0.6))
    assert errors.max() < 0.05
    assert turns.max() < math.radians(0.6)
    assert scale == pytest.approx(1.0, abs=0.15)
    # The scale is what the photographer says, and nothing else changes with it.
    errors, turns, again = walk.off(reconstruct(walk.views, 0.9))
    assert errors.max() < 0.05
    assert again == pytest.approx(scale / 1.5, rel=0.05)


def test_points_lie_where_their_features_are_seen():
    walk = Walk(3)
    structure = reconstruct(walk.views, 0.6)
    assert len(structure.points) > 150
    for k, view in enumerate(walk.views):
        seen = np.flatnonzero(structure.features[k] >= 0)
        local = (structure.points[seen] - structure.centres[k]) @ structure.rotations[k]
        pixels = local[:, :2] / local[:, 2:] * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]
        misses = np.linalg.norm(pixels - view.pixels[structure.features[k, seen]], axis=1)
        assert np.median(misses) < 1.0
        assert (structure.features[k, seen] < len(view)).all()
    assert ((structure.features >= 0).sum(axis=0) >= 1).all()


@pytest.mark.parametrize("size", [100.0, 1.0, 1e-3, 1e-5])
def test_a_camera_is_placed_by_points_of_any_size(size: float):
    """Bearings to a scene of any size, anywhere, and as far off in proportion, are the same."""
    rng = np.random.default_rng(5)
    local = rng.uniform([-1.0, -0.7, 2.0], [1.0, 0.7, 4.0], (40, 3))
    pixels = local[:, :2] / local[:, 2:] * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]
    turn = Rotation.from_rotvec([0.2, -0.4, 0.1])
    centre = np.array([0.3, -0.2, 1.3])
    points = centre + size * turn.apply(local)
    wrong = rng.permutation(40)[:8]
    pose = pose_by_points(points, np.where(np.isin(np.arange(40), wrong)[:, None], 9.0, pixels), CAMERA)
    assert pose is not None
    assert set(pose.inside) == set(range(40)) - set(wrong)
    assert (Rotation.from_rotvec(pose.turn[:, 0]) * turn).magnitude() < 1e-4
    # Rotations are known to 1e-8 or so, and the origin is 1.3 m away.
    assert np.linalg.norm(-turn.apply(pose.shift[:, 0]) - centre) < 1e-3 * size + 1e-7


@pytest.mark.parametrize(
    "points", [np.ones((20, 3)), np.full((20, 3), np.arange(20)[:, None]), np.ones((5, 3))]
)
def test_points_that_determine_no_camera_place_none(points: np.ndarray):
    assert pose_by_points(points * 1e-3, np.full((len(points), 2), 100.0), CAMERA) is None


def test_far_points_place_every_camera():
    """Things so far away that only the first and the fourth photograph, and so on, determine them, and few.

    They begin the map, the two cameras between are placed by their steps, the third before the second.
    """
    rng = np.random.default_rng(7)
    across = rng.uniform([-0.5, -0.4], [0.5, 0.4], (20, 2))
    distance = np.where(np.arange(20) < 11, 90.0, 900.0)[:, None]
    points = np.column_stack([across * distance, distance])
    codes = quantise(random_vectors(20, rng))
    views = []
    for k in range(5):
        local = points - [0.6 * k, 0.0, 0.0]
        pixels = local[:, :2] / local[:, 2:] * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]
        seen = np.arange(1 if k == 1 else 0, 20)
        views.append(View(pixels[seen].astype(np.float32), codes[seen], CAMERA))
    found = reconstruct(views, 0.6)
    assert found.placed.all()
    turns = Rotation.from_matrix(found.rotations[0].T @ found.rotations)
    assert turns.magnitude().max() < math.radians(1.0)


def test_invalid_walks_are_refused():
    walk, other = Walk(1), Walk(2)
    with pytest.raises(InvalidValue, match="two photographs"):
        reconstruct(walk.views[:1], 0.6)
    with pytest.raises(InvalidValue, match="photographs 3 and 4 do not show the same"):
        reconstruct([*walk.views[:3], *other.views[3:]], 0.6)

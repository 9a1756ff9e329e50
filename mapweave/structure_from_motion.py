"""Structure from motion: where an ordered set of photographs was taken, and what they show, up to scale.

Two photographs give a rotation and a direction (Nister's five points); a walk through them with steps of about
equal length is where bundle adjustment begins (Triggs et al. 2000, solved by GTSAM). What a person who takes
photographs holds to softly is part of it: the camera about level, about at one height, the steps about equal.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from hybridmap.camera import Camera
from hybridmap.errors import InvalidValue
from hybridmap.pose import Array
from hybridmap.query import View
from hybridmap.recognising.matching import match

PIXEL_SIGMA = 0.7
"""px, of a SIFT feature; as in triangulation."""

GATE_PX = 3.0
"""px; a feature that misses its point by more is no sighting of it."""

TILT_SIGMA = math.radians(2.0)
"""By which a camera in the hand is off level, pitch and roll alike, rad."""

HEIGHT_SHARE = 0.1
"""By which it is off its height, as a share of the height."""

STEP_SHARE = 0.3
"""By which one step differs from the others, as a share of it."""

OVERLAP = 3
"""Photographs ahead with which each one is compared."""

LEAST_MATCHES = 15
"""That agree on one essential matrix; with fewer two photographs count as showing nothing in common."""

LEAST_PARALLAX = math.radians(1.0)
"""Angle between the rays to a point, rad; with less its depth is not known to a quarter."""

FREE, FIXED = 1e3, 1e-3
"""Standard deviations of what nobody knows, and of where the map's frame begins, m and rad."""

CAMERA_FROM_LEVEL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""(3, 3) from x forward, y left, z up to x right, y down, z forward."""


@dataclass(frozen=True, eq=False)
class Structure:
    """N points seen in K photographs, in a level frame with z up; its unit is the metre as far as known.

    Attributes:
        rotations: (K, 3, 3) world_from_camera.
        centres: (K, 3) m, of the cameras.
        points: (N, 3) m.
        features: (K, N) int64, the feature of each photograph that shows the point, -1 where none does.
    """

    rotations: Array
    centres: Array
    points: Array
    features: NDArray[np.int64]


def reconstruct(views: Sequence[View], spacing: float) -> Structure:
    """Find where photographs were taken.

    Args:
        views: of one camera, in the order in which they were taken.
        spacing: how far apart, on average, m: the scale, of which photographs tell nothing.

    Raises:
        InvalidValue: fewer than two photographs, or two that follow each other and have nothing in common.
    """
    if len(views) < 2:
        raise InvalidValue("two photographs are needed at least")
    relations = {}
    for i, j in itertools.combinations(range(len(views)), 2):
        if j - i <= OVERLAP:
            related = _relate(views[i], views[j])
            if related is not None:
                relations[i, j] = related
            elif j == i + 1:
                raise InvalidValue(
                    f"photographs {i + 1} and {j + 1} do not show the same things: take one in between"
                )
    tracks = _tracks(views, {pair: related.pairs for pair, related in relations.items()})
    rotations, centres = [CAMERA_FROM_LEVEL.T], [np.array([0.0, 0.0, views[0].camera.mount_height])]
    for i in range(len(views) - 1):
        step = relations[i, i + 1]
        centres.append(centres[i] + spacing * rotations[i] @ step.direction)
        rotations.append(rotations[i] @ step.rotation)
    return _adjust(views, Structure(np.array(rotations), np.array(centres), np.zeros((0, 3)), tracks), spacing)


@dataclass(frozen=True, eq=False)
class _Relation:
    """Rotation first_from_second (3, 3), direction of the second in the first (3,), and (M, 2) matches."""

    rotation: Array
    direction: Array
    pairs: NDArray[np.int64]


def _relate(first: View, second: View) -> _Relation | None:
    pairs = match(first.codes, second.codes)
    if len(pairs) < LEAST_MATCHES:
        return None
    camera = first.camera
    matrix = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    a = first.pixels[pairs[:, 0]].astype(np.float64)
    b = second.pixels[pairs[:, 1]].astype(np.float64)
    cv2.setRNGSeed(0)
    essential, mask = cv2.findEssentialMat(a, b, matrix, cv2.RANSAC, 0.999, GATE_PX / 2)
    if essential is None or essential.shape != (3, 3) or int(mask.sum()) < LEAST_MATCHES:
        return None
    # x_second = R x_first + t.
    _, rotation, translation, _ = cv2.recoverPose(essential, a, b, matrix, mask=mask.copy())
    inside = mask[:, 0].astype(bool)
    return _Relation(rotation.T, -rotation.T @ translation[:, 0], pairs[inside])


def _tracks(
    views: Sequence[View], matches: dict[tuple[int, int], NDArray[np.int64]]
) -> NDArray[np.int64]:
    """(K, N) feature of each photograph that shows each point; what appears twice in one is left out."""
    starts = np.concatenate([[0], np.cumsum([len(view) for view in views])])
    parent = np.arange(starts[-1])

    def root(k: int) -> int:
        while parent[k] != k:
            parent[k] = parent[parent[k]]
            k = int(parent[k])
        return k

    for (i, j), pairs in matches.items():
        for a, b in pairs:
            parent[root(int(starts[i] + a))] = root(int(starts[j] + b))
    owner = np.repeat(np.arange(len(views)), np.diff(starts))
    roots = np.array([root(k) for k in range(len(parent))])
    columns = []
    for one in np.unique(roots):
        members = np.flatnonzero(roots == one)
        if len(members) >= 2 and len(np.unique(owner[members])) == len(members):
            column = np.full(len(views), -1, np.int64)
            column[owner[members]] = members - starts[owner[members]]
            columns.append(column)
    return np.array(columns, np.int64).reshape(-1, len(views)).T


def _adjust(views: Sequence[View], start: Structure, spacing: float) -> Structure:
    """Bundle adjustment, twice: the second time without sightings that the first has refuted."""
    structure = start
    for robust in (True, False):
        structure = _triangulated(views, structure)
        structure = _bundled(views, structure, spacing, robust)
        misses = _misses(views, structure)
        with np.errstate(invalid="ignore"):
            features = np.where(misses < GATE_PX, structure.features, -1)
        structure = Structure(structure.rotations, structure.centres, structure.points, features)
    return _triangulated(views, structure)


def _rays(views: Sequence[View], structure: Structure) -> Array:
    """(K, N, 3) unit vectors in world to where the photographs show the points; NaN where they do not."""
    camera = views[0].camera
    rays = np.full((*structure.features.shape, 3), np.nan)
    for k, view in enumerate(views):
        seen = np.flatnonzero(structure.features[k] >= 0)
        pixels = view.pixels[structure.features[k, seen]]
        slopes = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
        ray = np.column_stack([slopes, np.ones(len(seen))]) @ structure.rotations[k].T
        rays[k, seen] = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    return rays


def _triangulated(views: Sequence[View], structure: Structure) -> Structure:
    """With points where the rays meet best; those without parallax, or behind a camera, are left out."""
    rays = _rays(views, structure)
    seen = np.isfinite(rays[..., 0])
    filled = np.nan_to_num(rays)
    # Each ray r through c holds the point p to (1 - r r^T)(p - c) = 0.
    across = (np.eye(3) - filled[..., :, None] * filled[..., None, :]) * seen[..., None, None]
    normal = across.sum(axis=0) + 1e-9 * np.eye(3)
    points = np.linalg.solve(normal, np.einsum("knij,kj->ni", across, structure.centres)[..., None])[..., 0]
    toward = points - structure.centres[:, None]
    ahead = (np.einsum("kni,kni->kn", toward, filled) > 0.0) | ~seen
    cosine = np.einsum("kni,lni->nkl", filled, filled)
    both = seen.T[:, :, None] & seen.T[:, None, :]
    parallax = np.arccos(np.clip(np.where(both, cosine, 1.0).min(axis=(1, 2)), -1.0, 1.0))
    good = (seen.sum(axis=0) >= 2) & ahead.all(axis=0) & (parallax > LEAST_PARALLAX)
    return Structure(structure.rotations, structure.centres, points[good], structure.features[:, good])


def _misses(views: Sequence[View], structure: Structure) -> Array:
    """(K, N) px by which sightings miss their points; NaN where there are none."""
    camera = views[0].camera
    misses = np.full(structure.features.shape, np.nan)
    for k, view in enumerate(views):
        seen = np.flatnonzero(structure.features[k] >= 0)
        local = (structure.points[seen] - structure.centres[k]) @ structure.rotations[k]
        ahead = np.where(local[:, 2] > 0.05, local[:, 2], np.nan)
        expected = local[:, :2] / ahead[:, None] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        misses[k, seen] = np.linalg.norm(expected - view.pixels[structure.features[k, seen]], axis=1)
    return misses


def _bundled(views: Sequence[View], structure: Structure, spacing: float, robust: bool) -> Structure:
    camera: Camera = views[0].camera
    lens = gtsam.Cal3_S2(camera.fx, camera.fy, 0.0, camera.cx, camera.cy)
    pixel = gtsam.noiseModel.Isotropic.Sigma(2, PIXEL_SIGMA)
    if robust:
        pixel = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(2.0), pixel)
    pose, point = gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.L
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    # Tangents are in the camera's axes, of which y points down: it turns about y, and moves over the floor.
    tilt, rise = TILT_SIGMA, HEIGHT_SHARE * camera.mount_height
    held = gtsam.noiseModel.Diagonal.Sigmas(np.array([tilt, FREE, tilt, FREE, rise, FREE]))
    first = gtsam.noiseModel.Diagonal.Sigmas(np.array([tilt, FIXED, tilt, FIXED, rise, FIXED]))
    step = gtsam.noiseModel.Isotropic.Sigma(1, STEP_SHARE * spacing)
    for k, (rotation, centre) in enumerate(zip(structure.rotations, structure.centres, strict=True)):
        values.insert(pose(k), gtsam.Pose3(gtsam.Rot3(rotation), centre))
        yaw = math.atan2(rotation[1, 2], rotation[0, 2])
        level = gtsam.Rot3.Yaw(yaw).matrix() @ CAMERA_FROM_LEVEL.T
        place = np.array([centre[0], centre[1], camera.mount_height])
        graph.add(gtsam.PriorFactorPose3(pose(k), gtsam.Pose3(gtsam.Rot3(level), place), held if k else first))
        if k:
            graph.add(gtsam.RangeFactorPose3(pose(k - 1), pose(k), spacing, step))
    for n, place in enumerate(structure.points):
        values.insert(point(n), place)
        for k in np.flatnonzero(structure.features[:, n] >= 0).tolist():
            pixels = views[k].pixels[structure.features[k, n]].astype(np.float64)
            graph.add(gtsam.GenericProjectionFactorCal3_S2(pixels, pixel, pose(k), point(n), lens, False, False))
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    poses = [solved.atPose3(pose(k)) for k in range(len(views))]
    return Structure(
        np.array([one.rotation().matrix() for one in poses]),
        np.array([one.translation() for one in poses]),
        np.array([solved.atPoint3(point(n)) for n in range(len(structure.points))]).reshape(-1, 3),
        structure.features,
    )

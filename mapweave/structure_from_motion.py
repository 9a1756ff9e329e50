"""Structure from motion: where an ordered set of photographs was taken, and what they show, up to scale.

Two photographs give a rotation and a direction (Nister 2004, five points). Each further one is placed by the
points that it shows (PnP), and bundle adjustment (Triggs et al. 2000, solved by GTSAM) follows. What a
photographer holds to more or less is part of it: a level camera, one height, steps of one length.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array
from mapweave.hybridmap.query import View
from mapweave.registration.matching import match

PIXEL_SIGMA = 0.7
"""px, of a SIFT feature; as in triangulation."""

GATE_PX = 3.0
"""px; a feature that misses its point by more is an outlier."""

TILT_SIGMA = math.radians(2.0)
"""Standard deviation of a hand-held camera's pitch and roll, rad."""

HEIGHT_SHARE = 0.1
"""By which it is off its height, as a share of the height."""

STEP_SHARE = 0.3
"""By which one step differs from the others, as a share of it."""

OVERLAP = 3
"""Photographs ahead with which each one is compared."""

LEAST_MATCHES = 15
"""That agree on one essential matrix; with fewer two photographs count as showing nothing in common."""

BEGINNINGS = 5
"""Pairs of photographs from which it is tried to begin."""

LEAST_POINTS = 12
"""Known points by which a camera is placed."""

LEAST_PARALLAX = math.radians(1.0)
"""Angle between the rays to a point, rad; with less its depth is not known to a quarter."""

FREE, FIXED = 1e3, 1e-3
"""Standard deviations of unknown values, and of the map's origin, m and rad."""

CAMERA_FROM_LEVEL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""(3, 3) from x forward, y left, z up to x right, y down, z forward."""


@dataclass(frozen=True, eq=False)
class Structure:
    """N points seen in K photographs, in a level frame with z up; in metres, up to the unknown scale.

    Attributes:
        rotations: (K, 3, 3) world_from_camera; NaN where a camera has not been placed yet.
        centres: (K, 3) m, of the cameras.
        points: (N, 3) m; NaN where no two rays determine one.
        features: (K, N) int64, the feature of each photograph that shows the point, -1 where none does.
    """

    rotations: Array
    centres: Array
    points: Array
    features: NDArray[np.int64]

    @property
    def placed(self) -> NDArray[np.bool_]:
        """(K,) which cameras are placed."""
        return np.isfinite(self.centres[:, 0])


def reconstruct(
    views: Sequence[View], spacing: float, step_share: float = STEP_SHARE, names: Sequence[str] = ()
) -> Structure:
    """Find where photographs were taken: from the pair that fixes most points on, one photograph at a time.

    Args:
        views: of one camera, in the order in which they were taken.
        spacing: how far apart, on average, m: the scale, which photographs do not have.
        step_share: standard deviation of one step, as a share of it.
        names: of the photographs, for errors; their numbers by default.

    Returns:
        All cameras, and the points that are determined.

    Raises:
        InvalidValue: fewer than two photographs, or two that follow each other and have nothing in common.
    """
    if len(views) < 2:
        raise InvalidValue("two photographs are needed at least")
    relations = {}
    for i, j in itertools.combinations(range(len(views)), 2):
        if j - i <= OVERLAP and (related := _relate(views[i], views[j])) is not None:
            relations[i, j] = related
    called = names or [str(k) for k in range(1, len(views) + 1)]
    apart = next((i for i in range(len(views) - 1) if (i, i + 1) not in relations), None)
    if apart is not None:
        raise InvalidValue(
            f"photographs {called[apart]} and {called[apart + 1]} do not show the same things: take one in "
            "between"
        )
    features = _tracks(views, {pair: related.pairs for pair, related in relations.items()})
    starts = [_start(views, features, pair, related, spacing) for pair, related in relations.items()]
    starts.sort(key=lambda start: -int(np.isfinite(start.points[:, 0]).sum()))
    # What two photographs show of one wall has two explanations (Longuet-Higgins 1986); only the right one
    # goes with the others.
    whole = [_grown(views, start, relations, (spacing, step_share)) for start in starts[:BEGINNINGS]]
    best = max(whole, key=lambda structure: int((_misses(views, structure) < GATE_PX).sum()))
    if not best.placed.all():
        lost = called[int(np.argmin(best.placed))]
        raise InvalidValue(f"photograph {lost} cannot be placed by what it shows")
    determined = np.isfinite(best.points[:, 0])
    return replace(best, points=best.points[determined], features=best.features[:, determined])


def _grown(
    views: Sequence[View],
    start: Structure,
    relations: dict[tuple[int, int], _Relation],
    steps: tuple[float, float],
) -> Structure:
    """All cameras, one after the other, from two on."""
    structure = start
    for _ in range(int((~start.placed).sum())):
        structure = _triangulated(views, _extended(views, structure, relations))
        structure = _triangulated(views, _bundled(views, structure, steps, True))
    refuted = ~(_misses(views, structure) < GATE_PX)
    structure = replace(structure, features=np.where(refuted, -1, structure.features))
    return _triangulated(views, _bundled(views, _triangulated(views, structure), steps, False))


def _start(
    views: Sequence[View],
    features: NDArray[np.int64],
    pair: tuple[int, int],
    related: _Relation,
    spacing: float,
) -> Structure:
    """Two cameras, level but for what they are tilted against each other, and the points that both show."""
    (i, j), count = pair, len(views)
    rotations, centres = np.full((count, 3, 3), np.nan), np.full((count, 3), np.nan)
    rotations[i], centres[i] = CAMERA_FROM_LEVEL.T, (0.0, 0.0, views[0].camera.mount_height)
    rotations[j] = rotations[i] @ related.rotation
    centres[j] = centres[i] + (j - i) * spacing * rotations[i] @ related.direction
    points = np.full((features.shape[1], 3), np.nan)
    structure = _triangulated(views, Structure(rotations, centres, points, features))
    bad = ~(np.nanmax(_misses(views, structure)[[i, j]], axis=0, initial=0.0) < GATE_PX)
    return replace(structure, points=np.where(bad[:, None], np.nan, structure.points))


def _extended(
    views: Sequence[View], structure: Structure, relations: dict[tuple[int, int], _Relation]
) -> Structure:
    """Add a camera: by the points that it shows, or by the last camera's step."""
    placed = np.flatnonzero(structure.placed)
    low, high = int(placed[0]), int(placed[-1])
    visible = (structure.features >= 0) & np.isfinite(structure.points[:, 0])
    inner = [k for k in range(low, high) if k not in placed]
    k = max(
        inner or [k for k in (low - 1, high + 1) if 0 <= k < len(views)],
        key=lambda camera: int(visible[camera].sum()),
    )
    rotations, centres = structure.rotations.copy(), structure.centres.copy()
    visible_points = np.flatnonzero(visible[k])
    pixels = views[k].pixels[structure.features[k, visible_points]].astype(np.float64)
    pose = pose_by_points(structure.points[visible_points], pixels, views[k].camera)
    if pose is not None:
        rotations[k] = cv2.Rodrigues(pose.turn)[0].T
        centres[k] = -rotations[k] @ pose.shift[:, 0]
    else:
        # A gap between placed cameras is two wide at most, so one beside it is placed.
        neighbour = k - 1 if k - 1 in placed else k + 1
        step = relations[min(k, neighbour), max(k, neighbour)]
        length = float(np.linalg.norm(centres[high] - centres[low])) / (high - low)
        if k > neighbour:
            centres[k] = centres[neighbour] + length * rotations[neighbour] @ step.direction
            rotations[k] = rotations[neighbour] @ step.rotation
        else:
            rotations[k] = rotations[neighbour] @ step.rotation.T
            centres[k] = centres[neighbour] - length * rotations[k] @ step.direction
    return replace(structure, rotations=rotations, centres=centres)


@dataclass(frozen=True, eq=False)
class CameraPose:
    """Where a camera sees points: x_camera = R(turn) x + shift.

    Attributes:
        turn: (3, 1) rotation vector, rad.
        shift: (3, 1) m.
        inside: (M,) which of the points agree.
    """

    turn: Array
    shift: Array
    inside: NDArray[np.int64]


def pose_by_points(points: Array, pixels: Array, camera: Camera) -> CameraPose | None:
    """The pose of a camera that sees points (PnP with RANSAC); None if too few agree, or they determine none.

    Args:
        points: (N, 3) m.
        pixels: (N, 2) px.
        camera: that sees them.
    """
    if len(points) < LEAST_POINTS:
        return None
    # SQPnP compares with absolute bounds, and fails where points lie within a centimetre, as those of a
    # scene without a scale may: it gets them about 0, and 1 in size.
    middle = points.mean(axis=0)
    size = float(np.sqrt(np.square(points - middle).sum(axis=1).mean()))
    if not size > 0.0:
        return None
    cv2.setRNGSeed(0)
    try:
        fits, turn, shift, inside = cv2.solvePnPRansac(
            (points - middle) / size,
            pixels,
            matrix_of(camera),
            None,
            reprojectionError=GATE_PX,
            flags=cv2.SOLVEPNP_SQPNP,
        )
    except cv2.error:
        # Those that agree lie so that they determine no pose.
        return None
    if not fits or inside is None or len(inside) < LEAST_POINTS:
        return None
    back = size * np.asarray(shift, np.float64) - cv2.Rodrigues(turn)[0] @ middle[:, None]
    return CameraPose(np.asarray(turn, np.float64), back, inside[:, 0].astype(np.int64))


def matrix_of(camera: Camera) -> Array:
    """(3, 3) px, of a pinhole."""
    return np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])


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
    matrix = matrix_of(first.camera)
    a = first.pixels[pairs[:, 0]].astype(np.float64)
    b = second.pixels[pairs[:, 1]].astype(np.float64)
    cv2.setRNGSeed(0)
    essential, mask = cv2.findEssentialMat(a, b, matrix, cv2.RANSAC, 0.999, GATE_PX / 2)
    if essential is None or essential.shape != (3, 3) or int(mask.sum()) < LEAST_MATCHES:
        return None
    # x_second = R x_first + t.
    _, rotation, translation, _ = cv2.recoverPose(essential, a, b, matrix, mask=mask.copy())
    inside = mask[:, 0].astype(bool)
    turn = np.asarray(rotation, np.float64).T
    return _Relation(turn, -turn @ np.asarray(translation, np.float64)[:, 0], pairs[inside])


def _tracks(views: Sequence[View], matches: dict[tuple[int, int], NDArray[np.int64]]) -> NDArray[np.int64]:
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
    for track in np.unique(roots):
        members = np.flatnonzero(roots == track)
        if len(members) >= 2 and len(np.unique(owner[members])) == len(members):
            column = np.full(len(views), -1, np.int64)
            column[owner[members]] = members - starts[owner[members]]
            columns.append(column)
    return np.array(columns, np.int64).reshape(-1, len(views)).T


def _rays(views: Sequence[View], structure: Structure) -> Array:
    """(K, N, 3) unit vectors in world to where placed photographs show the points; NaN where they do not."""
    camera = views[0].camera
    rays = np.full((*structure.features.shape, 3), np.nan)
    for k, view in enumerate(views):
        visible_points = np.flatnonzero(structure.features[k] >= 0)
        pixels = view.pixels[structure.features[k, visible_points]]
        slopes = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
        ray = np.column_stack([slopes, np.ones(len(visible_points))]) @ structure.rotations[k].T
        rays[k, visible_points] = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    return rays


def _triangulated(views: Sequence[View], structure: Structure) -> Structure:
    """The scene with points where the rays meet best; NaN for those without parallax, or behind a camera."""
    rays = _rays(views, structure)
    visible = np.isfinite(rays[..., 0])
    filled = np.nan_to_num(rays)
    # Each ray r through c holds the point p to (1 - r r^T)(p - c) = 0.
    across = (np.eye(3) - filled[..., :, None] * filled[..., None, :]) * visible[..., None, None]
    normal = across.sum(axis=0) + 1e-9 * np.eye(3)
    centres = np.nan_to_num(structure.centres)
    points = np.linalg.solve(normal, np.einsum("knij,kj->ni", across, centres)[..., None])[..., 0]
    toward = points - centres[:, None]
    ahead = (np.einsum("kni,kni->kn", toward, filled) > 0.0) | ~visible
    cosine = np.einsum("kni,lni->nkl", filled, filled)
    both = visible.T[:, :, None] & visible.T[:, None, :]
    parallax = np.arccos(np.clip(np.where(both, cosine, 1.0).min(axis=(1, 2)), -1.0, 1.0))
    good = (visible.sum(axis=0) >= 2) & ahead.all(axis=0) & (parallax > LEAST_PARALLAX)
    return replace(structure, points=np.where(good[:, None], points, np.nan))


def _misses(views: Sequence[View], structure: Structure) -> Array:
    """(K, N) px reprojection errors; NaN where there is no feature, or no point."""
    camera = views[0].camera
    misses = np.full(structure.features.shape, np.nan)
    for k, view in enumerate(views):
        visible_points = np.flatnonzero(structure.features[k] >= 0)
        local = (structure.points[visible_points] - structure.centres[k]) @ structure.rotations[k]
        ahead = np.where(local[:, 2] > 0.05, local[:, 2], np.nan)
        expected = local[:, :2] / ahead[:, None] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        misses[k, visible_points] = np.linalg.norm(
            expected - view.pixels[structure.features[k, visible_points]], axis=1
        )
    return misses


def _bundled(
    views: Sequence[View], structure: Structure, steps: tuple[float, float], robust: bool
) -> Structure:
    """All cameras and points at their best; of steps, the length, m, and its share of uncertainty."""
    camera: Camera = views[0].camera
    lens = gtsam.Cal3_S2(camera.fx, camera.fy, 0.0, camera.cx, camera.cy)
    pixel: gtsam.noiseModel.Base = gtsam.noiseModel.Isotropic.Sigma(2, PIXEL_SIGMA)
    if robust:
        pixel = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(2.0), pixel)
    pose, point = gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.L
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    # Tangents are in the camera's axes, of which y points down: it turns about y, and moves over the floor.
    tilt, rise = TILT_SIGMA, HEIGHT_SHARE * camera.mount_height
    held = gtsam.noiseModel.Diagonal.Sigmas(np.array([tilt, FREE, tilt, FREE, rise, FREE]))
    first = gtsam.noiseModel.Diagonal.Sigmas(np.array([tilt, FIXED, tilt, FIXED, rise, FIXED]))
    placed = np.flatnonzero(structure.placed).tolist()
    for before, k in zip([None, *placed], placed, strict=False):
        rotation, centre = structure.rotations[k], structure.centres[k]
        values.insert(pose(k), gtsam.Pose3(gtsam.Rot3(rotation), centre))
        yaw = math.atan2(rotation[1, 2], rotation[0, 2])
        level = gtsam.Rot3.Yaw(yaw).matrix() @ CAMERA_FROM_LEVEL.T
        place = np.array([centre[0], centre[1], camera.mount_height])
        graph.add(
            gtsam.PriorFactorPose3(
                pose(k), gtsam.Pose3(gtsam.Rot3(level), place), first if before is None else held
            )
        )
        if before is not None:
            way = (k - before) * steps[0]
            step = gtsam.noiseModel.Isotropic.Sigma(1, steps[1] * way)
            graph.add(gtsam.RangeFactorPose3(pose(before), pose(k), way, step))
    determined = np.flatnonzero(np.isfinite(structure.points[:, 0])).tolist()
    for n in determined:
        values.insert(point(n), structure.points[n])
        for k in np.flatnonzero(structure.placed & (structure.features[:, n] >= 0)).tolist():
            pixels = views[k].pixels[structure.features[k, n]].astype(np.float64)
            graph.add(
                gtsam.GenericProjectionFactorCal3_S2(pixels, pixel, pose(k), point(n), lens, False, False)
            )
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    rotations, centres, points = structure.rotations.copy(), structure.centres.copy(), structure.points.copy()
    for k in placed:
        rotations[k], centres[k] = (
            solved.atPose3(pose(k)).rotation().matrix(),
            solved.atPose3(pose(k)).translation(),
        )
    for n in determined:
        points[n] = solved.atPoint3(point(n))
    return replace(structure, rotations=rotations, centres=centres, points=points)

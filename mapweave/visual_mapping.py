"""Maps of recordings without odometry: of a walk with a camera, by its images alone, up to scale.

Keyframes are taken where the image has changed by parallax, not by turning. Windows of a few of them are
reconstructed as photographs are (`structure_from_motion`), and chained by the landmarks of the keyframes that
two windows share, so that one scale goes through. Where keyframes show nothing in common, or what they show
has no depth (a turn on the spot, a blank wall, a cut), a map ends and the next one begins.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.agent.recordings.recording import Recording
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.change import ChangeBody
from mapweave.hybridmap.errors import DeviceError, InvalidValue
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.node import Landmarks
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.hybridmap.quantization import settle
from mapweave.hybridmap.query import View
from mapweave.photographs import LEAST_LANDMARKS, Stretch, changes_of, stretch_of
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Sift
from mapweave.visual_trajectory import ImagePose, TrackedImage, trajectory_of

PARALLAX = math.radians(2.5)
"""Of the points of a keyframe in the next one, the median, without what turning explains, rad. Depths are
then known to a few percent: the noise of a pixel is a twentieth of it."""
LEAST_TRACKED = 0.4
"""With less than this share of a keyframe's points left the next one is due: matching needs some of them."""
CORNERS, CORNER_QUALITY, CORNER_DISTANCE_PX = 300, 0.01, 8
"""Points that are followed from a keyframe on (Shi and Tomasi 1994)."""
WINDOW, OVERLAP = 6, 2
"""Keyframes that are reconstructed at once, and how many of them the next window shares."""
SPACING = 0.5
"""m from keyframe to keyframe: a stand-in for the scale, which images do not have. A walk of so far moves by
`PARALLAX` what is 10 m away."""
STEP_SHARE = 1.0
"""By which one step differs from the others: parallax depends on how far away things are."""


@dataclass(frozen=True, eq=False)
class Keyframe:
    """One image of a walk.

    Attributes:
        stamp_ns: of the image.
        view: its features.
        followed: the images after it, up to the next one, and where its features are in them.
    """

    stamp_ns: int
    view: View
    followed: list[TrackedImage] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class VisualMap:
    """A map of a walk.

    Attributes:
        id: of it.
        changes: that make it.
        trajectory: where its images were taken, in their order.
    """

    id: MapId
    changes: list[ChangeBody]
    trajectory: list[ImagePose]


def keyframes(recording: Recording, frames: Iterable[int]) -> tuple[list[Keyframe], list[str]]:
    """The images that become nodes, and a line if some cannot be read: these are left out.

    Args:
        recording: of the walk.
        frames: numbers of its images, in their order; going through them shows progress.
    """
    camera, lens = recording.camera, Lens(recording.camera, recording.distortion)
    sift = Sift(lens)
    before: NDArray[np.uint8] | None = None
    corners, points, features = np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 2))
    walk, lost = list[Keyframe](), list[str]()
    for k in frames:
        try:
            image = recording.read(k)
        except DeviceError as error:
            lost.append(str(error))
            continue
        if before is not None:
            both = _followed(before, image, np.concatenate([points, features]))
            points, features = both[: len(corners)], both[len(corners) :]
        stamp_ns = int(recording.stamps_ns[k])
        if before is not None and not _is_next(camera, lens, corners, points):
            walk[-1].followed.append(TrackedImage(stamp_ns, _undistorted(lens, features)))
        else:
            extracted = sift.extract(image)
            walk.append(Keyframe(stamp_ns, extracted.view(camera)))
            features = extracted.raw
            found = cv2.goodFeaturesToTrack(image, CORNERS, CORNER_QUALITY, CORNER_DISTANCE_PX)
            corners = np.zeros((0, 2)) if found is None else found[:, 0].astype(np.float64)
            points = corners
        before = image
    return walk, [f"{lost[0]} (left out, {len(lost)} of {len(recording)} images)"] if lost else []


def _followed(before: NDArray[np.uint8], image: NDArray[np.uint8], points: Array) -> Array:
    """Where points are in the next image; those that are lost become NaN."""
    alive = np.isfinite(points[:, 0])
    if not alive.any():
        return points
    moved, status, _ = cv2.calcOpticalFlowPyrLK(before, image, points[alive].astype(np.float32), None)  # type: ignore[call-overload]
    out = np.full_like(points, np.nan)
    out[alive] = np.where(status == 1, moved, np.nan)
    return out


def _undistorted(lens: Lens, features: Array) -> NDArray[np.float32]:
    """(N, 2) px in the real image to undistorted ones; NaN stays."""
    out = np.full(features.shape, np.nan, np.float32)
    alive = np.isfinite(features[:, 0])
    out[alive] = lens.undistort(features[alive])
    return out


def _is_next(camera: Camera, lens: Lens, corners: Array, points: Array) -> bool:
    """Whether an image differs enough from the last keyframe."""
    alive = np.isfinite(points[:, 0])
    if alive.sum() < max(LEAST_TRACKED * len(corners), LEAST_LANDMARKS):
        return True
    a, b = (_rays(camera, lens.undistort(side[alive])) for side in (corners, points))
    return _parallax(a, b) >= PARALLAX


def _rays(camera: Camera, pixels: Array) -> Array:
    """(N, 3) unit vectors of (N, 2) undistorted px."""
    flat = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    rays = np.column_stack([flat, np.ones(len(flat))])
    return np.asarray(rays / np.linalg.norm(rays, axis=1)[:, None], np.float64)


def _parallax(a: Array, b: Array) -> float:
    """Median angle between rays, rad, after the rotation that brings them closest (Kabsch 1976)."""
    u, _, vt = np.linalg.svd(b.T @ a)
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return float(np.median(2.0 * np.arcsin(np.clip(np.linalg.norm(b - a @ rotation.T, axis=1) / 2, 0, 1))))


def stretches(views: Sequence[View]) -> Iterator[tuple[int, Stretch]]:
    """The pieces of a walk that can be reconstructed, each with the number of its first keyframe.

    Args:
        views: of the keyframes, in their order.
    """
    first = 0
    while first < len(views) - 1:
        stretch = _longest(views, first)
        if stretch is None:
            first += 1
            continue
        begin = first
        first += len(stretch.poses)
        while first < len(views):
            more = _longest(views, first - OVERLAP)
            chained = (
                None
                if more is None or len(more.poses) <= OVERLAP
                else _chained(stretch, more, views[0].camera)
            )
            if chained is None:
                break
            stretch, first = chained, begin + len(chained.poses)
        yield begin, stretch


def _longest(views: Sequence[View], first: int) -> Stretch | None:
    """What can be reconstructed of the window that begins at a keyframe: as much as possible."""
    for last in range(min(first + WINDOW, len(views)), first + 1, -1):
        try:
            stretch = stretch_of(views[first:last], SPACING, STEP_SHARE)
        except InvalidValue:
            continue
        if min(map(len, stretch.landmarks)) >= LEAST_LANDMARKS:
            return stretch
    return None


def _chained(stretch: Stretch, more: Stretch, camera: Camera) -> Stretch | None:
    """A stretch and the window that begins with its last keyframes; None without common landmarks.

    The window is scaled by the median ratio of the depths of landmarks that both have.
    """
    ratios = []
    for old, new in enumerate(range(len(stretch.poses) - OVERLAP, len(stretch.poses))):
        _, a, b = np.intersect1d(stretch.features[new], more.features[old], return_indices=True)
        ratios.append(stretch.landmarks[new].depths[a] / more.landmarks[old].depths[b])
    common = np.concatenate(ratios)
    if len(common) < LEAST_LANDMARKS:
        return None
    scale = float(np.median(common))
    last = more.poses[OVERLAP - 1]
    to_here = stretch.poses[-1]
    for pose, landmarks, features in list(zip(more.poses, more.landmarks, more.features, strict=True))[
        OVERLAP:
    ]:
        way = last.inverse() @ pose
        stretch.poses.append(to_here @ Pose2(scale * way.x, scale * way.y, way.heading))
        scaled, order = settle(_scaled(landmarks, scale), camera)
        stretch.landmarks.append(scaled)
        stretch.features.append(features[order])
    stretch.matches.extend(more.matches[OVERLAP - 1 :])
    return stretch


def _scaled(landmarks: Landmarks, scale: float) -> Landmarks:
    depths, sigmas = scale * landmarks.depths, scale * landmarks.depth_sigmas
    return Landmarks(landmarks.pixels, landmarks.codes, depths.astype(np.float32), sigmas.astype(np.float32))


def nothing_mapped(path: Path, walk: Sequence[Keyframe], damage: Sequence[str]) -> str:
    """Why a recording gave no map, in one line.

    Args:
        path: of it.
        walk: its keyframes.
        damage: what of it cannot be read, a line each.
    """
    why = f"no two of its {len(walk)} keyframes show the same things from two places"
    return damage[0] if damage else f"{path}: {why}: nothing can be mapped"


def visual_maps(walk: Sequence[Keyframe], camera: Camera, name: str, epoch: int) -> list[VisualMap]:
    """The maps of a walk: one, if it can be followed from its beginning to its end.

    Args:
        walk: its keyframes.
        camera: that took them.
        name: whose maps they become.
        epoch: number of the first one.
    """
    found = list(stretches([keyframe.view for keyframe in walk]))
    maps = []
    for number, (first, stretch) in enumerate(found):
        map_id = MapId(name, epoch + number)
        piece = walk[first : first + len(stretch.poses)]
        stamps = [keyframe.stamp_ns for keyframe in piece]
        trajectory = trajectory_of(stretch, stamps, [keyframe.followed for keyframe in piece], camera)
        maps.append(VisualMap(map_id, changes_of(stretch, stamps, camera, map_id), trajectory))
    return maps

"""A map from photographs alone: of a stretch, in order, taken by hand with a calibrated camera.

Each photograph becomes a node, with an edge to the next. Structure from motion gives the depths of their
landmarks in proportion to each other. How large all of it is follows from the spacing that the photographer
states, so each depth, and each way between nodes, carries the uncertainty of that statement. A robot that
drives along finds the scale by its wheels.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.replicator import Replicator
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.change import ChangeBody, EdgePut, NodePut
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind, Landmarks, Node
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from mapweave.hybridmap.quantization import settle
from mapweave.hybridmap.query import View
from mapweave.registration.selection import choose, worth
from mapweave.storage.image_file import read_grey
from mapweave.structure_from_motion import PIXEL_SIGMA, STEP_SHARE, Structure, reconstruct
from mapweave.vision.lens import Distortion, Lens
from mapweave.vision.sift import Sift
from mapweave.wire.bus import Bus
from mapweave.wire.keys import Keys

SCALE_SHARE = 0.3
"""By which the stated spacing may be off, as a share of it."""

LEAST_LANDMARKS = 12
"""A photograph that shows fewer points is no place that a robot could recognise."""

FLOOR = (0.01, 0.01)
"""What a pose is never better than, m and rad: the camera is not quite level."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """What a stretch of K photographs shows, and where they were taken, up to scale.

    Attributes:
        poses: of the robot, in the first one's frame, m.
        landmarks: of each.
        features: of each, (N,) which feature of the photograph each landmark is.
        matches: for each but the last, (M, 2) features of it and of the next that show the same point.
    """

    poses: list[Pose2]
    landmarks: list[Landmarks]
    features: list[NDArray[np.int64]]
    matches: list[NDArray[np.int64]]


def map_of_photographs(
    images: Sequence[Path],
    camera: Camera,
    distortion: Distortion,
    spacing: float,
    map_id: MapId,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> list[ChangeBody]:
    """Make a map.

    Args:
        images: in the order in which they were taken, by one camera that was held about level.
        camera: that took them; `mount_height` is how high it was held.
        distortion: of its lens.
        spacing: how far apart they were taken, on average, m; 30 % more or less does not matter.
        map_id: whose nodes they become; the k-th photograph is node k.
        progress: called with how many of how many images are read.

    Raises:
        DeviceError: an image cannot be read.
        InvalidValue: they are not one stretch, or show too little.
    """
    if not (math.isfinite(spacing) and spacing > 0.0):
        raise InvalidValue(f"spacing {spacing:g}: give the metres between photographs")
    sift = Sift(Lens(camera, distortion))
    features = []
    for k, image in enumerate(images, 1):
        features.append(sift.extract(read_grey(image, camera)))
        progress(k, len(images))
    views, names = [extracted.view(camera) for extracted in features], [image.name for image in images]
    stretch = stretch_of(views, spacing, names=names)
    for image, landmarks in zip(images, stretch.landmarks, strict=True):
        if len(landmarks) < LEAST_LANDMARKS:
            raise InvalidValue(f"{image}: only {len(landmarks)} points of it are in its neighbours too")
    return changes_of(stretch, range(len(images)), camera, map_id)


def stretch_of(
    views: Sequence[View], spacing: float, step_share: float = STEP_SHARE, names: Sequence[str] = ()
) -> Stretch:
    """Where photographs were taken, and what they show.

    Args:
        views: of one camera, in the order in which they were taken.
        spacing: how far apart, on average, m.
        step_share: by how much one step differs from that, as a share of it.
        names: of the photographs, for errors; their numbers by default.

    Raises:
        InvalidValue: they are not one stretch.
    """
    structure, camera = reconstruct(views, spacing, step_share, names), views[0].camera
    levels = [_level(structure, k) for k in range(len(views))]
    seen = [_landmarks(structure, k, levels[k], camera, view.codes) for k, view in enumerate(views)]
    both = [(structure.features[[k, k + 1]] >= 0).all(axis=0) for k in range(len(views) - 1)]
    return Stretch(
        [levels[0].inverse() @ level for level in levels],
        [landmarks for landmarks, _ in seen],
        [structure.features[k, points] for k, (_, points) in enumerate(seen)],
        [structure.features[[k, k + 1]][:, shown].T for k, shown in enumerate(both)],
    )


def changes_of(stretch: Stretch, stamps_ns: Sequence[int], camera: Camera, map_id: MapId) -> list[ChangeBody]:
    """A map of a stretch: a node a photograph, with an edge to the next.

    Args:
        stretch: what was found.
        stamps_ns: of the photographs.
        camera: that took them.
        map_id: whose nodes they become; the k-th photograph is node k.
    """
    count = len(stretch.poses)
    ids = [NodeId(map_id.agent, map_id.epoch, number) for number in range(1, 2 * count)]
    changes: list[ChangeBody] = [
        NodePut(Node(ids[k], stamps_ns[k], _uncertain(stretch.poses[k]), camera, stretch.landmarks[k]))
        for k in range(count)
    ]
    for k, matches in enumerate(stretch.matches):
        here, there = (
            {int(feature): n for n, feature in enumerate(stretch.features[side])} for side in (k, k + 1)
        )
        shared = np.array(
            [(here[a], there[b]) for a, b in matches.tolist() if a in here and b in there], np.int64
        ).reshape(-1, 2)
        shared = shared[shared[:, 0].argsort()]
        a_from_b = _uncertain(stretch.poses[k].inverse() @ stretch.poses[k + 1])
        evidence = {"shared": float(len(shared))}
        edge_id = ids[count + k]
        changes.append(
            EdgePut(Edge(edge_id, ids[k], ids[k + 1], a_from_b, EdgeKind.MAPPED, shared, evidence))
        )
    return changes


def send_map(
    changes: Sequence[ChangeBody],
    map_id: MapId,
    journal: Path,
    bus: Bus,
    keys: Keys,
    server: str,
    patience: float,
) -> bool:
    """Give a map to a server as a robot does: from a journal that keeps what has not been taken.

    Args:
        changes: of the map, each once.
        map_id: no map of this number may be in the journal.
        journal: its file; made if there is none.
        bus: to the fleet.
        keys: of the fleet.
        server: that shall have it.
        patience: how long to wait for it, s.

    Returns:
        Whether the server has it all.

    Raises:
        MapweaveError: the journal cannot be used.
    """
    journal.parent.mkdir(parents=True, exist_ok=True)
    disk = Journal(journal, map_id.agent)
    try:
        disk.open_map(map_id.epoch)
        replicator = Replicator(bus, keys, disk, map_id, servers=(server,))
        try:
            replicator.submit(changes, time.time_ns())
            return replicator.wait_acknowledged(patience)
        finally:
            replicator.close()
    finally:
        disk.close()


def _level(structure: Structure, k: int) -> Pose2:
    """Position of the k-th camera over the floor, and its heading."""
    axis = structure.rotations[k][:, 2]
    x, y, _ = structure.centres[k]
    return Pose2(float(x), float(y), math.atan2(axis[1], axis[0]))


def _landmarks(
    structure: Structure, k: int, level: Pose2, camera: Camera, codes: NDArray[np.uint8]
) -> tuple[Landmarks, NDArray[np.int64]]:
    """What the k-th photograph shows, as a level camera at the stated height sees it; and which points."""
    points = np.flatnonzero(structure.features[k] >= 0)
    points_here = structure.points[points].copy()
    points_here[:, :2] = level.inverse().apply(points_here[:, :2])
    points_here[:, 0] += camera.mount_forward
    depths = points_here[:, 0] - camera.mount_forward
    pixels = camera.project(points_here)
    sigmas = np.hypot(_depth_sigmas(structure, k, points, camera), SCALE_SHARE * depths)
    good = camera.contains(pixels, -min(camera.width, camera.height) / 4) & (
        sigmas < 2 * SCALE_SHARE * depths
    )
    points, pixels, depths, sigmas = points[good], pixels[good], depths[good], sigmas[good]
    features = structure.features[k, points]
    landmarks = Landmarks(
        pixels.astype(np.float32), codes[features], depths.astype(np.float32), sigmas.astype(np.float32)
    )
    visible_share = (structure.features[:, points] >= 0).mean(axis=0)
    kept = choose(landmarks, worth(visible_share, features / len(codes)), camera)
    landmarks, order = settle(landmarks.take(kept), camera)
    return landmarks, points[kept[order]].astype(np.int64)


def _depth_sigmas(structure: Structure, k: int, points: NDArray[np.intp], camera: Camera) -> Array:
    """(M,) m, standard deviations of points along the k-th axis, the cameras taken as true."""
    toward = structure.points[points] - structure.centres[:, None]
    visible = structure.features[:, points] >= 0
    distance = np.linalg.norm(toward, axis=2)
    rays = toward / distance[..., None]
    across = np.eye(3) - rays[..., :, None] * rays[..., None, :]
    weight = np.where(visible, (camera.fx / PIXEL_SIGMA / distance) ** 2, 0.0)
    covariances = np.linalg.inv(np.einsum("kn,knij->nij", weight, across))
    axis = structure.rotations[k][:, 2]
    return np.asarray(np.sqrt(np.einsum("i,nij,j->n", axis, covariances, axis)), np.float64)


def _uncertain(way: Pose2) -> PoseGaussian:
    """A trajectory with its unknown scale."""
    sigmas = [np.hypot(SCALE_SHARE * way.x, FLOOR[0]), np.hypot(SCALE_SHARE * way.y, FLOOR[0]), FLOOR[1]]
    return PoseGaussian(way, np.diag(np.square(sigmas)))

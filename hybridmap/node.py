"""Nodes and edges: the elements of a hybrid map."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import EdgeId, NodeId
from mapweave.hybridmap.pose import Array, PoseGaussian
from mapweave.hybridmap.ranges import NO_RANGES, Ranges
from mapweave.hybridmap.trajectory_segment import NO_SEGMENT, TrajectorySegment

CODE_BYTES = 32
"""Length of a compact descriptor in memory, a byte for each coordinate (mapweave.hybridmap.descriptor)."""

UNMEASURED_SCALE = 0.2
"""Where no depth is known better than by this share, the scale is what is not known. Mapping keeps no depth
that is known worse than to 0.25, and some of a drive's are always known much better."""

HELD_TILT = 0.02
"""rad; without a measured scale the camera was hand-held, neither level nor at its height."""

LEAST_DEPTH_SHARE = 0.03
"""What a depth is off by alone, as a share of it, where what it shares with the others is taken apart: the
uncertainty of both together is rounded to steps of 13 %."""


@dataclass(frozen=True, eq=False)
class Landmarks:
    """What a node sees: N landmarks in columns.

    Attributes:
        pixels: (N, 2) float32, undistorted px in the node's image.
        codes: (N, 32) uint8, compact SIFT descriptors.
        depths: (N,) float32, m along the optical axis from the node's optical centre; NaN where the
            depth is not known (a landmark that only gives a bearing).
        depth_sigmas: (N,) float32, standard deviation of the depth, m; NaN with the depth.
    """

    pixels: NDArray[np.float32]
    codes: NDArray[np.uint8]
    depths: NDArray[np.float32]
    depth_sigmas: NDArray[np.float32]

    def __post_init__(self) -> None:
        """Refuse shapes that do not belong together (InvalidValue)."""
        n = len(self.pixels)
        shapes = (self.pixels.shape, self.codes.shape, self.depths.shape, self.depth_sigmas.shape)
        if shapes != ((n, 2), (n, CODE_BYTES), (n,), (n,)):
            raise InvalidValue(f"landmarks: shapes {shapes} do not belong together")

    def __len__(self) -> int:
        return len(self.pixels)

    @property
    def has_depth(self) -> NDArray[np.bool_]:
        """(N,) which landmarks have a 3D position."""
        return np.isfinite(self.depths)

    @cached_property
    def scale_share(self) -> float:
        """Common relative error of all depths, as of a map whose scale was not measured.

        A drive knows it by the wheels, so that some depths are known well. Photographs leave it open: there
        the best known depth is as uncertain as the scale.
        """
        shares = self.depth_sigmas[self.has_depth] / self.depths[self.has_depth]
        least = float(shares.min(initial=math.inf))
        return least if UNMEASURED_SCALE <= least < math.inf else 0.0

    @property
    def tilt_sigma(self) -> float:
        """How far the camera may have been off level, rad."""
        return HELD_TILT if self.scale_share else 0.0

    def points_in_robot(self, camera: Camera) -> Array:
        """(N, 3) m, in the node's robot frame; NaN where there is no depth."""
        return camera.back_project(self.pixels, self.depths)

    def covariances_in_robot(
        self, camera: Camera, pixel_sigma: float = 0.7, scale_share: float = 0.0, tilt_sigma: float = 0.0
    ) -> Array:
        """(N, 3, 3) m^2, in the node's robot frame, from the depth's and the pixel's uncertainty.

        Args:
            camera: of the node.
            pixel_sigma: standard deviation of a pixel, px.
            scale_share: what all depths are off by together, as a share of them, is not part of the result:
                for estimators that account for it.
            tilt_sigma: by which the camera may have been off level, rad.
        """
        x = (self.pixels[:, 0].astype(np.float64) - camera.cx) / camera.fx
        y = (self.pixels[:, 1].astype(np.float64) - camera.cy) / camera.fy
        depth = self.depths.astype(np.float64)
        ray = np.stack([np.ones_like(x), -x, -y], axis=-1)
        variances = self.depth_sigmas.astype(np.float64) ** 2
        if scale_share:
            variances = np.maximum(variances - (scale_share * depth) ** 2, (LEAST_DEPTH_SHARE * depth) ** 2)
        covariances: Array = np.einsum("ni,nj,n->nij", ray, ray, variances)
        covariances[:, 1, 1] += (pixel_sigma * depth / camera.fx) ** 2
        covariances[:, 2, 2] += (pixel_sigma * depth / camera.fy) ** 2
        covariances[:, 2, 2] += (tilt_sigma * depth) ** 2
        return covariances

    def take(self, index: NDArray[Any]) -> Landmarks:
        """The landmarks that an index or a mask selects."""
        return Landmarks(self.pixels[index], self.codes[index], self.depths[index], self.depth_sigmas[index])

    @staticmethod
    def empty() -> Landmarks:
        """No landmarks at all."""
        return Landmarks(
            np.zeros((0, 2), np.float32),
            np.zeros((0, CODE_BYTES), np.uint8),
            np.zeros(0, np.float32),
            np.zeros(0, np.float32),
        )


@dataclass(frozen=True, eq=False)
class Node:
    """A place: the robot's pose when it took an image, and what it saw.

    Attributes:
        id: never reused.
        stamp_ns: when the image was taken.
        map_from_robot: pose in the agent's own map frame.
        camera: intrinsics and mount of the camera that took the image.
        landmarks: what is in the image.
        clock: what `stamp_ns` was read from. Times of two robots can be compared only if it is the same;
            empty if unknown.
        radius: of the robot's footprint, m: two robots are never nearer to each other than both of theirs. 0
            if unknown.
        ranges: what the proximity sensors saw from there at that time; empty if it has none.
        segment: trajectory segment: where the robot was before and after, with its sensor readings.
    """

    id: NodeId
    stamp_ns: int
    map_from_robot: PoseGaussian
    camera: Camera
    landmarks: Landmarks
    clock: str = ""
    radius: float = 0.0
    ranges: Ranges = NO_RANGES
    segment: TrajectorySegment = NO_SEGMENT

    def __post_init__(self) -> None:
        """Refuse a trajectory segment of more or fewer sensors, or beyond their reach (InvalidValue)."""
        if not len(self.segment):
            return
        distances = self.segment.distances
        if distances.shape[1] != len(self.ranges):
            raise InvalidValue(
                f"trajectory: {distances.shape[1]} sensors, where the node has {len(self.ranges)}"
            )
        if not ((distances >= 0.0) & (distances <= self.ranges.reach + 1e-9)).all():
            raise InvalidValue(f"trajectory: a distance is not within 0 to {self.ranges.reach:g} m")

    @property
    def points_in_robot(self) -> Array:
        """(N, 3) m, landmarks in the node's robot frame; NaN where there is no depth."""
        return self.landmarks.points_in_robot(self.camera)


class EdgeKind(StrEnum):
    """How an edge was obtained."""

    MAPPED = "mapped"
    """The robot drove from one node to the other while mapping, with the landmarks in view."""
    TURNED = "turned"
    """The robot turned on the spot between the two images."""
    DRIVEN = "driven"
    """The edge was driven by visual servoing and measured again."""
    LOOP = "loop"
    """A place was recognised again, within one map."""
    MERGED = "merged"
    """A place of one map was recognised in another."""


@dataclass(frozen=True, eq=False)
class Edge:
    """The robot can servo between two nodes.

    Attributes:
        id: of the agent (or server) that made it.
        a: one end.
        b: the other end; for edges within a map the later node.
        a_from_b: pose of b's robot frame in a's.
        kind: how it was obtained.
        shared: (K, 2) int, landmark indices in a and in b that are the same physical point.
        evidence: numbers that support it, for example inliers; keys are short, values are floats.
    """

    id: EdgeId
    a: NodeId
    b: NodeId
    a_from_b: PoseGaussian
    kind: EdgeKind
    shared: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    evidence: dict[str, float] = field(default_factory=dict)

    @property
    def within(self) -> bool:
        """Whether it joins two nodes of the map that it belongs to."""
        return self.a[:2] == self.b[:2] == self.id[:2]

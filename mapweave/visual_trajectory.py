"""Where each image of a walk without odometry was taken: those between keyframes, too.

The features of a keyframe are followed through the images after it. Those that became landmarks of its node
have a place in the map; by them a camera is placed in all six degrees of freedom (PnP), as those of the
keyframes are, and set upright. An image in which too few of them are left lies on the way between its
neighbours.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.agent.recordings.trajectory_file import tum_line
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.photographs import Stretch
from mapweave.structure_from_motion import matrix_of, pose_by_points

FOUND = "# found in the map from here\n"
INTERPOLATED = "# not found: interpolated from here\n"


@dataclass(frozen=True, eq=False)
class TrackedImage:
    """An image after a keyframe.

    Attributes:
        stamp_ns: of the image.
        pixels: (N, 2) float32 undistorted px, where the keyframe's N features are in it; NaN where lost.
    """

    stamp_ns: int
    pixels: NDArray[np.float32]


@dataclass(frozen=True)
class ImagePose:
    """Where an image was taken.

    Attributes:
        stamp_ns: of the image.
        map_from_robot: pose in its map, which has no scale.
        found: whether its own features say so; else it is interpolated.
    """

    stamp_ns: int
    map_from_robot: Pose2
    found: bool


def trajectory_of(
    stretch: Stretch,
    stamps_ns: Sequence[int],
    followed: Sequence[Sequence[TrackedImage]],
    camera: Camera,
) -> list[ImagePose]:
    """The poses of all images of a map, from its first keyframe to the last image that is found.

    Args:
        stretch: its K keyframes.
        stamps_ns: of them.
        followed: for each keyframe the images after it, up to the next one.
        camera: that took them.
    """
    poses: list[tuple[int, Pose2 | None]] = []
    for k, map_from_node in enumerate(stretch.poses):
        poses.append((stamps_ns[k], map_from_node))
        landmarks, features = stretch.landmarks[k], stretch.features[k]
        points = camera.back_project(landmarks.pixels, landmarks.depths) - [camera.mount_forward, 0.0, 0.0]
        for image in followed[k]:
            node_from_image = _placed(points, image.pixels[features].astype(np.float64), camera)
            poses.append(
                (image.stamp_ns, None if node_from_image is None else map_from_node @ node_from_image)
            )
    found = [n for n, (_, pose) in enumerate(poses) if pose is not None]
    out = []
    for a, b in pairwise([*found, found[-1]]):
        before, after = poses[a][1], poses[b][1]
        assert before is not None
        assert after is not None
        out.append(ImagePose(poses[a][0], before, found=True))
        for stamp_ns, _ in poses[a + 1 : b]:
            share = (stamp_ns - poses[a][0]) / (poses[b][0] - poses[a][0])
            out.append(ImagePose(stamp_ns, _between(before, after, share), found=False))
    return out


def tum_lines(trajectory: Sequence[ImagePose]) -> str:
    """A trajectory as TUM's tools and evo read it; comments say which poses are interpolated."""
    lines, found = [], True
    for one in trajectory:
        if one.found != found:
            lines.append(FOUND if one.found else INTERPOLATED)
        found = one.found
        lines.append(tum_line(one.stamp_ns, one.map_from_robot))
    return "".join(lines)


def _placed(points: Array, pixels: Array, camera: Camera) -> Pose2 | None:
    """The upright pose of a camera that sees points; None if too few agree.

    Args:
        points: (N, 3) m in an upright frame, from below the camera: x forward, y left, z up.
        pixels: (N, 2) px; NaN where a point is not seen.
        camera: that sees them.
    """
    seen = np.isfinite(pixels).all(axis=1)
    points, pixels = points[seen], pixels[seen]
    pose = pose_by_points(points, pixels, camera)
    if pose is None:
        return None
    agree, matrix = pose.inside, matrix_of(camera)
    turn, shift = cv2.solvePnPRefineLM(points[agree], pixels[agree], matrix, None, pose.turn, pose.shift)
    camera_from_points = cv2.Rodrigues(turn)[0]
    x, y, _ = -camera_from_points.T @ shift[:, 0]
    ahead = camera_from_points[2]
    return Pose2(float(x), float(y), math.atan2(ahead[1], ahead[0]))


def _between(before: Pose2, after: Pose2, share: float) -> Pose2:
    way = before.inverse() @ after
    return before @ Pose2(share * way.x, share * way.y, share * way.heading)

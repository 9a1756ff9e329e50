"""A photograph taken by hand, brought to level by a robot that sees the same.

A hand-held camera has an unknown pitch, roll and height, and errors by them are common to all its pixels. A
robot's camera is level and at its height. So the photograph's pitch, roll and rise are estimated together
with the robot's pose, by Gauss-Newton on the recognised landmarks.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.node import LEAST_DEPTH_SHARE, Landmarks, Node
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from mapweave.hybridmap.query import View
from mapweave.registration.planar_ambiguity import mirrored
from mapweave.registration.recognition import Recognition, of_unknown_scale

TILT_SIGMA, RISE_SIGMA = math.radians(2.0), 0.05
"""By which a camera in the hand is off level, rad, and off its height, m."""

LEAST_PX, USUAL_PX = 0.3, 1.0
"""What a pixel is off by at least, though the pixels show how much; and what fits are compared with."""

MAD_TO_SIGMA = 1.4826
"""A Gaussian's standard deviation over the median of its absolute values."""

GATE = 4.0
"""A landmark that misses by more sigma counts for nothing."""

ROUNDS, STEP = 6, 1e-5
"""Of Gauss-Newton; and of each parameter, for derivatives by differences."""


@dataclass(frozen=True, eq=False)
class Levelled:
    """A photograph as a level camera would have taken it, and where it is seen from.

    Attributes:
        node: with all its landmarks, in their order.
        node_from_robot: of the view.
    """

    node: Node
    node_from_robot: PoseGaussian


def level(node: Node, view: View, recognition: Recognition) -> Levelled:
    """Bring a photograph to level.

    Args:
        node: the photograph.
        view: the image's features.
        recognition: of the node in the view, by landmarks that have a depth.
    """
    pairs = recognition.pairs[node.landmarks.has_depth[recognition.pairs[:, 0]]]
    landmarks, pixels = node.landmarks.take(pairs[:, 0]), view.pixels[pairs[:, 1]].astype(np.float64)

    def expected(state: Array, longer: float) -> Array:
        depths = landmarks.depths * np.float32(1.0 + longer)
        points = _tilted(replace(landmarks, depths=depths), node.camera, state[3:])
        points[:, :2] = Pose2.from_vector(state[:3]).inverse().apply(points[:, :2])
        return view.camera.project(points)

    own = recognition.node_from_robot.mean
    # What is seen of one wall is seen almost the same from its other side; the truth explains it better.
    points = landmarks.points_in_robot(node.camera)[:, :2]
    starts = [own.vector, mirrored(own, points).vector]
    fits = [fit for start in starts if (fit := _fit(start, pixels, expected)) is not None]
    if not fits:
        return Levelled(node, recognition.node_from_robot)
    best = min(fits, key=lambda fit: fit.cost)
    mean, turn = Pose2.from_vector(best.state[:3]), np.eye(3)
    turn[:2, :2] = mean.rotation.T
    pose = PoseGaussian(mean, turn @ best.covariance[:3, :3] @ turn.T)
    pose = of_unknown_scale(pose, node.landmarks.scale_share, node.camera, view.camera)
    return Levelled(replace(node, landmarks=_levelled(node.landmarks, node.camera, best.state[3:])), pose)


class _Fit(NamedTuple):
    """(6,) x, y, heading, pitch, roll, rise; (6, 6) their covariance; squared misses in sigma, gated."""

    state: Array
    covariance: Array
    cost: float


def _fit(start: Array, pixels: Array, expected: Callable[[Array, float], Array]) -> _Fit | None:
    """Gauss-Newton from a pose (3,); None if the pixels determine none.

    Args:
        start: x, y, heading.
        pixels: (N, 2) px.
        expected: where they should be, by a state and a share by which all depths are longer.
    """
    prior = np.diag([0.0, 0.0, 0.0, TILT_SIGMA**-2, TILT_SIGMA**-2, RISE_SIGMA**-2])
    state, information, cost = np.append(start, np.zeros(3)), prior, math.inf
    for _ in range(ROUNDS):
        now = expected(state, 0.0)
        by_state = np.stack(
            [(expected(state + step, 0.0) - now) / STEP for step in STEP * np.eye(6)], axis=-1
        )
        misses = pixels - now
        finite: NDArray[np.bool_] = np.isfinite(np.column_stack([misses, by_state.reshape(-1, 12)]))
        finite = np.asarray(finite.all(axis=1))
        if not finite.any():
            return None
        sigma = max(MAD_TO_SIGMA * float(np.median(np.abs(misses[finite]))), LEAST_PX)
        # What a depth is off by alone moves its landmark by the parallax between the two cameras.
        extra = np.square(np.nan_to_num(expected(state, LEAST_DEPTH_SHARE) - now))
        squares = np.where(finite[:, None], np.square(np.nan_to_num(misses)), np.inf)
        gated = np.minimum(squares / (USUAL_PX**2 + extra), GATE**2)
        cost = float(gated.sum() + state @ prior @ state)
        good = np.flatnonzero((squares < GATE**2 * (sigma**2 + extra)).all(axis=1))
        weighed = by_state[good] / (sigma**2 + extra[good])[..., None]
        information = prior + np.einsum("nki,nkj->ij", weighed, by_state[good])
        if np.linalg.cond(information) > 1e12:
            return None
        gradient = np.einsum("nki,nk->i", weighed, misses[good]) - prior @ state
        state = state + np.linalg.solve(information, gradient)
    return _Fit(state, np.linalg.inv(information), cost)


def _tilted(landmarks: Landmarks, camera: Camera, tilt: Array) -> Array:
    """(N, 3) m, in the node's robot frame, if its camera was pitched and rolled (rad) and too high (m)."""
    (cp, cr), (sp, sr) = np.cos(tilt[:2]), np.sin(tilt[:2])
    rotation = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]]) @ [
        [1.0, 0.0, 0.0],
        [0.0, cr, -sr],
        [0.0, sr, cr],
    ]
    centre = np.array([camera.mount_forward, 0.0, camera.mount_height])
    points: Array = (landmarks.points_in_robot(camera) - centre) @ rotation.T + centre
    points[:, 2] += tilt[2]
    return points


def _levelled(landmarks: Landmarks, camera: Camera, tilt: Array) -> Landmarks:
    """Landmarks as a level camera sees them; those without a depth stay where they are."""
    points = _tilted(landmarks, camera, tilt)
    pixels = camera.project(points)
    ahead: NDArray[np.bool_] = np.asarray(np.isfinite(pixels).all(axis=1))
    depths = np.where(ahead, points[:, 0] - camera.mount_forward, landmarks.depths)
    return replace(
        landmarks,
        pixels=np.where(ahead[:, None], pixels, landmarks.pixels).astype(np.float32),
        depths=depths.astype(np.float32),
        depth_sigmas=(landmarks.depth_sigmas * (depths / landmarks.depths)).astype(np.float32),
    )

"""The localization filter at work: landmarks as a map has them, a pose nearly unknown, drives at a node.

A start is as the paper's: the pose is wrong by 1 m in x and in y and by 1 rad (standard deviations), at
least four landmarks of the node are in view for the static fix, and the filter has 19 steps to find itself.
"""

import math
from dataclasses import dataclass

import numpy as np

from mapweave.agent.ekf.localization_filter import LocalizationFilter
from mapweave.agent.observation import Odometry
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from synthetic.mapping_run import AXLE, CAMERA, TICK, WHEEL_NOISE

FEW = 6
"""So many landmarks in view at the start, or fewer, are few."""

_PIXEL = 0.7
_DISTANCE, _TURNED = 0.10, math.radians(3.0)
"""m and rad: a start has converged when the pose stays nearer to the truth than this."""
_LEAST, _MOST = 4, 30
_WRONG = np.array([1.0, 1.0, 1.0])
"""m, m, rad: the paper's start."""
_STEPS_TO_CONVERGE = 19


@dataclass(frozen=True, eq=False)
class SurveyedNode:
    """A node with its true landmarks.

    Attributes:
        true: (N, 3) m, where its landmarks are, in the node's robot frame.
        points: (N, 3) m, where the map has them.
        covariances: (N, 3, 3) m^2, by the map.
    """

    true: Array
    points: Array
    covariances: Array

    @property
    def error(self) -> float:
        """RMS distance of the map's landmarks to the truth, m."""
        return float(np.sqrt(np.square(self.points - self.true).sum(axis=1).mean()))

    @property
    def nees(self) -> float:
        """Mean squared Mahalanobis distance of a landmark from the truth, 3 degrees of freedom."""
        off = (self.points - self.true)[:, :, None]
        return float((off * np.linalg.solve(self.covariances, off)).sum(axis=1).mean())


@dataclass(frozen=True, eq=False)
class Start:
    """What became of one start.

    Attributes:
        visible: landmarks in view at the start.
        converged: whether the pose was near the truth from the nineteenth step on.
        healthy: whether the filter would let the robot drive by its pose at the end.
        near: whether that pose is near the truth.
        nees: squared Mahalanobis distance of the true pose at the end, 3 degrees of freedom.
        before: the node as the map had it.
        after: and as the drive left it.
    """

    visible: int
    converged: bool
    healthy: bool
    near: bool
    nees: float
    before: SurveyedNode
    after: SurveyedNode


def draw_place(rng: np.random.Generator) -> SurveyedNode:
    """Draw a node of 4 to 30 landmarks, 1.5 to 5 m ahead, whose depths the map knows to 1 to 8 %."""
    count = int(rng.integers(_LEAST, _MOST + 1))
    depths = rng.uniform(1.5, 5.0, count)
    pixels = np.column_stack([rng.uniform(20, 300, count), rng.uniform(20, 220, count)])
    mapped_pixels = pixels + _PIXEL * rng.normal(size=pixels.shape)
    # A map's errors are of inverse depth, as from parallax; it has them as sigmas of the depth.
    share = rng.uniform(0.01, 0.08, count)
    mapped_depths = depths / (1 + share * rng.normal(size=count))
    sigmas = share * mapped_depths**2 / depths
    mapped = CAMERA.back_project(mapped_pixels, mapped_depths)
    ray = np.column_stack(
        [np.ones(count), (mapped[:, 1:] - (0.0, CAMERA.mount_height)) / mapped_depths[:, None]]
    )
    covariances = np.einsum("ni,nj,n->nij", ray, ray, sigmas**2)
    covariances[:, [1, 2], [1, 2]] += (_PIXEL * mapped_depths / CAMERA.fx)[:, None] ** 2
    return SurveyedNode(CAMERA.back_project(pixels, depths), mapped, covariances)


def drive(rng: np.random.Generator, place: SurveyedNode, steps: int = 100) -> Start:
    """Drive `steps` ticks near a node, from a prior as wrong as the paper's."""
    while True:
        true = Pose2(*(rng.normal(size=3) * (0.5, 0.3, 0.25)))
        visible = int(CAMERA.contains(CAMERA.project(true.inverse().apply(place.true))).sum())
        if visible >= _LEAST:
            break
    guess = true @ Pose2.from_vector(_WRONG * rng.normal(size=3))
    ids = np.arange(len(place.points))
    prior = PoseGaussian(guess, np.diag(_WRONG**2))
    filter_ = LocalizationFilter(CAMERA, AXLE, WHEEL_NOISE, prior, ids, place.points, place.covariances)
    converged, near = True, False
    phase = rng.uniform(0, 2 * np.pi)
    for k in range(1, steps + 1):
        odometry = Odometry(0.2 * TICK * np.sin(TICK * k + phase), 0.12 * TICK * np.cos(0.8 * TICK * k))
        ways = odometry.forward + 0.5 * AXLE * odometry.turn * np.array([1.0, -1.0])
        right, left = ways * (1 + WHEEL_NOISE * rng.normal(size=2))
        true = true @ Odometry(0.5 * (right + left), (right - left) / AXLE).motion()
        exact = CAMERA.project(true.inverse().apply(place.true))
        pixels = exact + _PIXEL * rng.normal(size=exact.shape)
        pixels[~CAMERA.contains(exact)] = np.nan
        filter_.predict(odometry)
        filter_.update(ids, pixels)
        off = filter_.pose.mean.inverse() @ true
        near = math.hypot(off.x, off.y) < _DISTANCE and abs(off.heading) < _TURNED
        converged &= near or k < _STEPS_TO_CONVERGE
    landmarks = filter_.landmarks_in_node()
    after = SurveyedNode(place.true[landmarks.ids], landmarks.points, landmarks.covariances)
    nees = filter_.pose.mahalanobis2(true)
    return Start(visible, converged, filter_.healthy, near, nees, place, after)


def try_start(rng: np.random.Generator, steps: int = 100) -> Start:
    """One drive at a random node."""
    return drive(rng, draw_place(rng), steps)


def try_drives(rng: np.random.Generator, drives: int, steps: int = 100) -> list[SurveyedNode]:
    """Drive again and again through one node, each time with the landmarks as the last drive left them.

    What a drive learned is kept if the filter was healthy at its end.

    Returns:
        The node as it was mapped, and after each drive.
    """
    places = [draw_place(rng)]
    for _ in range(drives):
        start = drive(rng, places[-1], steps)
        places.append(start.after if start.healthy else start.before)
    return places

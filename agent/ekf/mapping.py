"""The mapping filter: posture since an anchor and landmarks nobody knows yet, 3 + 3n (paper section 4).

Landmarks live in the moving camera's own frame as the paper has it, but as (a, b, w), slopes and inverse
depth: the image measures a and b directly, and a landmark of unknown depth is a landmark with a large
sigma of w (docs/decisions/ekf-parametrisation.md).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.ekf.gating import believe, pixel_gate
from agent.ekf.motion import WheelNoise, move_posture, move_rays
from agent.ekf.report import UpdateReport
from agent.observation import Odometry
from hybridmap.camera import Camera
from hybridmap.errors import InvalidValue
from hybridmap.pose import Array, Pose2, PoseGaussian

Ids = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class FilterSettings:
    """How the mapping filter believes, gates and stops.

    Attributes:
        pixel_sigma: standard deviation of a tracked pixel, px.
        wheel_floor: standard deviation of a wheel's way in a step without any, m.
        posture_noise: process noise of each step on (x m, y m, heading rad), standard deviations.
        prior_depth: depth at which a landmark is expected when nothing is known, m.
        prior_spread: sigma of the prior inverse depth, in units of 1 / prior_depth. 1.2 reaches from
            0.3 prior_depth (two sigma) to infinity (one sigma).
        gate_probability: share of true measurements that each gate lets pass.
        least_agreeing: fewer accepted landmarks than this are no healthy update.
        least_agreeing_share: nor is a smaller share of those seen.
        converged_sigma: depth sigma under which a landmark has converged, m.
        converged_share: the same as a share of the depth; the larger of the two counts.
        widest_slope: landmarks further aside than this |a| have left the view for good and are let go.
        nearest: landmarks nearer than this to the optical centre are let go, m.
    """

    pixel_sigma: float = 0.7
    wheel_floor: float = 1e-5
    posture_noise: tuple[float, float, float] = (0.0, 0.0, 0.0)
    prior_depth: float = 2.5
    prior_spread: float = 1.2
    gate_probability: float = 0.999
    least_agreeing: int = 3
    least_agreeing_share: float = 0.4
    converged_sigma: float = 0.05
    converged_share: float = 0.05
    widest_slope: float = 4.0
    nearest: float = 0.05


class LandmarkEstimates(NamedTuple):
    """Landmarks as a filter knows them now, in columns.

    Attributes:
        ids: (N,) as the front end numbers them.
        points_in_robot: (N, 3) m, in robot; NaN for landmarks that may as well be at infinity (w <= 0).
        covariances_in_robot: (N, 3, 3) m^2, in robot, to first order; infinite where the point is NaN.
        depths: (N,) m along the optical axis from the optical centre; infinite for w <= 0.
        depth_sigmas: (N,) m, to first order; infinite for w <= 0.
    """

    ids: Ids
    points_in_robot: Array
    covariances_in_robot: Array
    depths: Array
    depth_sigmas: Array


class MappingFilter:
    """Extended Kalman filter over [posture (3), landmarks (n x 3)].

    Attributes:
        ids: (n,) landmark ids in the state's order, as the front end numbers them.
        lost: landmarks that the filter has let go by itself since it began: behind the camera, or aside.
    """

    def __init__(
        self, camera: Camera, axle: float, wheel_noise: float, settings: FilterSettings | None = None
    ) -> None:
        """Start at the anchor, with certainty, knowing no landmark.

        Args:
            camera: intrinsics and mount.
            axle: distance between the wheels, m.
            wheel_noise: standard deviation of a wheel's way as a share of the way.
            settings: see there.
        """
        self.settings = settings or FilterSettings()
        self.ids: Ids = np.zeros(0, np.int64)
        self.lost = 0
        self._camera = camera
        self._wheels = WheelNoise(axle, wheel_noise, self.settings.wheel_floor)
        self._focal = np.array([camera.fx, camera.fy])
        self._centre = np.array([camera.cx, camera.cy])
        self._gate = pixel_gate(self.settings.gate_probability)
        self._posture = np.zeros(3)
        self._rays = np.zeros((0, 3))
        self._covariance = np.zeros((3, 3))

    def predict(self, odometry: Odometry) -> None:
        """Move by one step of the wheels; landmarks that come behind the camera or far aside are let go."""
        n = len(self.ids)
        self._posture, by_posture, by_input = move_posture(self._posture, odometry)
        moved = move_rays(self._rays, odometry, self._camera.mount_forward)
        self._rays = moved.rays
        old = self._covariance
        new = np.empty_like(old)
        new[:3, :3] = by_posture @ old[:3, :3] @ by_posture.T
        # The transition is block diagonal: 3x3 blocks times rows, never the dense product.
        cross = moved.by_ray @ (by_posture @ old[:3, 3:]).T.reshape(n, 3, 3)
        new[3:, :3] = cross.reshape(3 * n, 3)
        new[:3, 3:] = new[3:, :3].T
        half = (moved.by_ray @ old[3:, 3:].reshape(n, 3, 3 * n)).reshape(3 * n, 3 * n)
        new[3:, 3:] = (moved.by_ray @ half.T.reshape(n, 3, 3 * n)).reshape(3 * n, 3 * n)
        inputs = np.concatenate([by_input, moved.by_input.reshape(3 * n, 2)]) @ self._wheels.root(odometry)
        new += inputs @ inputs.T
        new[[0, 1, 2], [0, 1, 2]] += np.square(self.settings.posture_noise)
        self._covariance = 0.5 * (new + new.T)
        self._let_go(moved.scale)

    def add(
        self,
        ids: Ids,
        pixels: Array,
        inverse_depths: Array | None = None,
        sigmas: Array | None = None,
    ) -> None:
        """Add landmarks seen now for the first time.

        Args:
            ids: (N,) new ids.
            pixels: (N, 2) px, where they are seen.
            inverse_depths: (N,) 1/m along the optical axis, if known; else the prior.
            sigmas: (N,) 1/m, their standard deviations; needed with inverse_depths.

        Raises:
            InvalidValue: an id is there already, or shapes do not belong together.
        """
        n = len(ids)
        if len(pixels) != n or (inverse_depths is None) != (sigmas is None):
            raise InvalidValue("add: ids, pixels, inverse depths and sigmas do not belong together")
        if np.isin(ids, self.ids).any() or len(np.unique(ids)) != n:
            raise InvalidValue("add: a landmark can be added only once")
        rays = np.empty((n, 3))
        rays[:, :2] = (pixels - self._centre) / self._focal
        variances = np.empty((n, 3))
        variances[:, :2] = (self.settings.pixel_sigma / self._focal) ** 2
        if inverse_depths is None or sigmas is None:
            rays[:, 2] = 1.0 / self.settings.prior_depth
            variances[:, 2] = (self.settings.prior_spread / self.settings.prior_depth) ** 2
        else:
            rays[:, 2] = inverse_depths
            variances[:, 2] = np.square(sigmas)
        size = len(self._covariance)
        grown = np.zeros((size + 3 * n, size + 3 * n))
        grown[:size, :size] = self._covariance
        grown[np.arange(size, size + 3 * n), np.arange(size, size + 3 * n)] = variances.ravel()
        self._covariance = grown
        self._rays = np.concatenate([self._rays, rays])
        self.ids = np.concatenate([self.ids, np.asarray(ids, np.int64)])

    def update(self, ids: Ids, pixels: Array) -> UpdateReport:
        """Correct by the pixels of one image.

        Args:
            ids: (N,) what is seen; ids that the filter does not hold are ignored.
            pixels: (N, 2) px, undistorted; rows with NaN are ignored.
        """
        slots, rows = self._slots(ids, pixels)
        if not len(slots):
            return UpdateReport.blind(ids, "no landmark of the filter is in view")
        index = (3 + 3 * slots[:, None] + np.arange(2)).ravel()
        innovations = (pixels[rows] - self._centre) / self._focal - self._rays[slots, :2]
        spread = self._covariance[np.ix_(index, index)]
        spread[np.arange(len(index)), np.arange(len(index))] += np.tile(
            (self.settings.pixel_sigma / self._focal) ** 2, len(slots)
        )
        believed, information = believe(innovations, spread, self._gate)
        kept = int(believed.sum())
        nis = math.nan
        if kept:
            residual = innovations[believed].ravel()
            nis = float(residual @ information @ residual) / (2 * kept)
            self._correct(index.reshape(-1, 2)[believed].ravel(), residual, information)
        needed = max(
            min(self.settings.least_agreeing, len(self.ids)), self.settings.least_agreeing_share * len(slots)
        )
        reason = "" if kept >= needed else f"{kept} of {len(slots)} landmarks agree"
        accepted = np.zeros(len(ids), np.bool_)
        accepted[rows[believed]] = True
        innovations_px = np.full((len(ids), 2), np.nan)
        innovations_px[rows] = innovations * self._focal
        return UpdateReport(ids, accepted, innovations_px, nis, not reason, reason)

    def remove(self, ids: Ids) -> None:
        """Forget landmarks; ids that are not there are ignored."""
        self._keep(~np.isin(self.ids, ids))

    @property
    def pose(self) -> PoseGaussian:
        """`anchor_from_robot`."""
        posture = Pose2.from_vector(self._posture)
        turn = np.eye(3)
        turn[:2, :2] = posture.rotation.T
        return PoseGaussian(posture, turn @ self._covariance[:3, :3] @ turn.T)

    def reanchor(self) -> PoseGaussian:
        """Make the present posture the anchor.

        Landmarks are held in the robot's frame, so this is the exact marginalisation of the old anchor.

        Returns:
            `old_anchor_from_new_anchor`.
        """
        pose = self.pose
        self._posture = np.zeros(3)
        self._covariance[:3, :] = 0.0
        self._covariance[:, :3] = 0.0
        return pose

    def predict_pixels(self, ids: Ids | None = None) -> Array:
        """(N, 2) px where landmarks are expected now; NaN for ids that the filter does not hold."""
        pixels: Array = self._centre + self._focal * self._rays[:, :2]
        if ids is None:
            return pixels
        slots, rows = self._slots(ids)
        out = np.full((len(ids), 2), np.nan)
        out[rows] = pixels[slots]
        return out

    def landmarks(self) -> LandmarkEstimates:
        """All landmarks as they are known now."""
        n = len(self.ids)
        w = self._rays[:, 2]
        known = w > 0.0
        depths = np.where(known, 1.0 / np.where(known, w, 1.0), np.inf)
        sigmas = np.where(known, np.sqrt(self._blocks()[:, 2, 2]) * depths**2, np.inf)
        finite = np.where(known, depths, np.nan)
        points = self._camera.back_project(self._centre + self._focal * self._rays[:, :2], finite)
        # Point (1, -a, -b) / w + mount, by (a, b, w).
        by_ray = np.zeros((n, 3, 3))
        by_ray[:, 1, 0] = by_ray[:, 2, 1] = -finite
        by_ray[:, 0, 2] = -(finite**2)
        by_ray[:, 1, 2] = self._rays[:, 0] * finite**2
        by_ray[:, 2, 2] = self._rays[:, 1] * finite**2
        covariances = by_ray @ self._blocks() @ np.swapaxes(by_ray, 1, 2)
        covariances[~known] = np.inf
        return LandmarkEstimates(self.ids.copy(), points, covariances, depths, sigmas)

    def converged(self) -> NDArray[np.bool_]:
        """(n,) landmarks whose depth is known well enough, in metres."""
        now = self.landmarks()
        limit = np.maximum(self.settings.converged_sigma, self.settings.converged_share * now.depths)
        return np.asarray(np.isfinite(now.depths) & (now.depth_sigmas <= limit), np.bool_)

    def _blocks(self) -> Array:
        """(n, 3, 3) covariance of each landmark by itself."""
        n = len(self.ids)
        index = np.arange(n)
        blocks: Array = self._covariance[3:, 3:].reshape(n, 3, n, 3)[index, :, index, :]
        return blocks

    def _slots(self, ids: Ids, pixels: Array | None = None) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Places in the state of those ids that are held and seen, and their rows among the ids given."""
        held, slots, rows = np.intersect1d(self.ids, ids, return_indices=True)
        if pixels is not None and len(held):
            seen = np.isfinite(pixels[rows]).all(axis=1)
            slots, rows = slots[seen], rows[seen]
        return slots, rows

    def _correct(self, index: NDArray[np.intp], residual: Array, information: Array) -> None:
        """Kalman update by direct measurements of some entries of the state."""
        columns = self._covariance[:, index]
        step = columns @ (information @ residual)
        root = columns @ np.linalg.cholesky(information)
        self._covariance -= root @ root.T
        self._posture += step[:3]
        self._rays += step[3:].reshape(-1, 3)

    def _let_go(self, scale: Array) -> None:
        near = self._rays[:, 2] * self.settings.nearest > 1.0
        gone = (scale <= 1e-3) | near | (np.abs(self._rays[:, 0]) > self.settings.widest_slope)
        if gone.any():
            self.lost += int(gone.sum())
            self._keep(~gone)

    def _keep(self, mask: NDArray[np.bool_]) -> None:
        index = np.concatenate([[0, 1, 2], 3 + np.flatnonzero(np.repeat(mask, 3))])
        self._covariance = self._covariance[np.ix_(index, index)]
        self._rays = self._rays[mask]
        self.ids = self.ids[mask]

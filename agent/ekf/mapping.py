"""The mapping filter: posture since an anchor and landmarks nobody knows yet, 3 + 3n (paper section 4).

Landmarks live in the moving camera's own frame as the paper has it, but as (a, b, w), slopes and inverse
depth: the image measures a and b directly, and a landmark of unknown depth is a landmark with a large
sigma of w (docs/decisions/ekf-parametrisation.md).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.ekf.gating import believe, inverse, pixel_gate
from agent.ekf.landmarks import Ids, LandmarkEstimates
from agent.ekf.motion import WheelNoise
from agent.ekf.moving_state import MovingState, Step
from agent.ekf.report import UpdateReport
from agent.observation import Odometry
from hybridmap.camera import Camera
from hybridmap.errors import InvalidValue
from hybridmap.pose import Array, PoseGaussian

__all__ = ["FilterSettings", "LandmarkEstimates", "MappingFilter"]

SAME_STEP = 1e-4
"""m and rad; a step is not linearised again for less: its second-order part is then below 1e-5 px."""


@dataclass(frozen=True, slots=True)
class FilterSettings:
    """How the mapping filter believes, gates and stops.

    Attributes:
        pixel_sigma: standard deviation of a tracked pixel, px.
        wheel_floor: standard deviation of a wheel's way in a step without any, m.
        posture_noise: process noise of each step on (x m, y m, heading rad), standard deviations.
        slip_sigmas: a step that the image puts further than this from the wheels is taken for a slip.
        slip: sigma of (forward m, turn rad) of a step whose wheels the landmarks refute.
        prior_depth: depth at which a landmark is expected when nothing is known, m.
        prior_spread: sigma of the prior inverse depth, in units of 1 / prior_depth. 1.2 reaches from
            0.3 prior_depth (two sigma) to infinity (one sigma).
        relinearisations: how often at most a step is linearised again in the light of its image.
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
    slip_sigmas: float = 4.0
    slip: tuple[float, float] = (0.1, 0.2)
    prior_depth: float = 2.5
    prior_spread: float = 1.2
    relinearisations: int = 3
    gate_probability: float = 0.999
    least_agreeing: int = 3
    least_agreeing_share: float = 0.4
    converged_sigma: float = 0.05
    converged_share: float = 0.05
    widest_slope: float = 4.0
    nearest: float = 0.05


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
        self._state = MovingState.at_anchor()
        self._step: Step | None = None

    def predict(self, odometry: Odometry) -> None:
        """Move by one step of the wheels; landmarks that come behind the camera or far aside are let go."""
        taken = Step.predict(
            self._state,
            odometry,
            self._wheels.root(odometry),
            np.square(self.settings.posture_noise),
            self._camera.mount_forward,
        )
        rays = taken.state.rays
        near = rays[:, 2] * self.settings.nearest > 1.0
        stays = (taken.scale > 1e-3) & ~near & (np.abs(rays[:, 0]) <= self.settings.widest_slope)
        self.lost += int((~stays).sum())
        self.ids = self.ids[stays]
        self._take(taken.kept(stays))

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
        self._state = self._state.grown(rays, variances)
        self.ids = np.concatenate([self.ids, np.asarray(ids, np.int64)])
        self._step = None

    def update(self, ids: Ids, pixels: Array) -> UpdateReport:
        """Correct by the pixels of one image.

        Args:
            ids: (N,) what is seen; ids that the filter does not hold are ignored.
            pixels: (N, 2) px, undistorted; rows with NaN are ignored.
        """
        slots, rows = self._slots(ids, pixels)
        if not len(slots):
            return UpdateReport.blind(ids, "no landmark of the filter is in view")
        slopes = (pixels[rows] - self._centre) / self._focal
        innovations = slopes - self._state.rays[slots, :2]
        believed, information = believe(innovations, self._spread(slots), self._gate)
        reason = self._doubt(int(believed.sum()), len(slots))
        if reason and self._step is not None:
            # Many landmarks are seldom wrong together; the wheels may be (slip, a lost encoder).
            step = self._step
            self._take(step.again(wheel_root=np.diag(self.settings.slip)))
            then_believed, then_information = believe(innovations, self._spread(slots), self._gate)
            kept = int(then_believed.sum())
            if self._doubt(kept, len(slots)):
                self._take(step)
            else:
                believed, information = then_believed, then_information
                reason = f"the wheels are refuted by {kept} of {len(slots)} landmarks"
        if believed.sum() < self.settings.least_agreeing_share * len(slots):
            # A few that agree among many that do not may as well be the wrong ones.
            believed[:] = False
        nis = self._correct(slots[believed], slopes[believed], information) if believed.any() else math.nan
        self._step = None
        accepted = np.zeros(len(ids), np.bool_)
        accepted[rows[believed]] = True
        innovations_px = np.full((len(ids), 2), np.nan)
        innovations_px[rows] = innovations * self._focal
        return UpdateReport(ids, accepted, innovations_px, nis, not reason, reason)

    def remove(self, ids: Ids) -> None:
        """Forget landmarks; ids that are not there are ignored."""
        keep = ~np.isin(self.ids, ids)
        if not keep.all():
            self._state = self._state.kept(keep)
            self.ids = self.ids[keep]
            self._step = self._step.kept(keep) if self._step is not None else None

    @property
    def state(self) -> MovingState:
        """The whole state, a value: for figures and tests."""
        return self._state

    @property
    def pose(self) -> PoseGaussian:
        """`anchor_from_robot`."""
        return self._state.pose

    def reanchor(self) -> PoseGaussian:
        """Make the present posture the anchor.

        Landmarks are held in the robot's frame, so this is the exact marginalisation of the old anchor.

        Returns:
            `old_anchor_from_new_anchor`.
        """
        pose = self.pose
        self._state = self._state.reanchored()
        self._step = None
        return pose

    def predict_pixels(self, ids: Ids | None = None) -> Array:
        """(N, 2) px where landmarks are expected now; NaN for ids that the filter does not hold."""
        pixels: Array = self._centre + self._focal * self._state.rays[:, :2]
        if ids is None:
            return pixels
        slots, rows = self._slots(ids)
        out = np.full((len(ids), 2), np.nan)
        out[rows] = pixels[slots]
        return out

    def landmarks(self) -> LandmarkEstimates:
        """All landmarks as they are known now."""
        return LandmarkEstimates.of_rays(self.ids.copy(), self._state.rays, self._state.blocks, self._camera)

    def converged(self) -> NDArray[np.bool_]:
        """(n,) landmarks whose depth is known well enough, in metres."""
        now = self.landmarks()
        limit = np.maximum(self.settings.converged_sigma, self.settings.converged_share * now.depths)
        return np.asarray(np.isfinite(now.depths) & (now.depth_sigmas <= limit), np.bool_)

    def _slots(self, ids: Ids, pixels: Array | None = None) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Places in the state of those ids that are held and seen, and their rows among the ids given."""
        held, slots, rows = np.intersect1d(self.ids, ids, return_indices=True)
        if pixels is not None and len(held):
            seen = np.isfinite(pixels[rows]).all(axis=1)
            slots, rows = slots[seen], rows[seen]
        return slots, rows

    def _take(self, step: Step) -> None:
        self._step, self._state = step, step.state

    def _spread(self, slots: NDArray[np.intp]) -> Array:
        """(2N, 2N) joint covariance of the innovations of some landmarks."""
        index = _measured(slots)
        spread = self._state.covariance[np.ix_(index, index)]
        diagonal = np.arange(len(index))
        spread[diagonal, diagonal] += np.tile((self.settings.pixel_sigma / self._focal) ** 2, len(slots))
        return spread

    def _doubt(self, agreeing: int, seen: int) -> str:
        """Why so many landmarks of those seen are no good update; empty if they are."""
        s = self.settings
        needed = max(min(s.least_agreeing, len(self.ids)), s.least_agreeing_share * seen)
        return "" if agreeing >= needed else f"{agreeing} of {seen} landmarks agree"

    def _correct(self, slots: NDArray[np.intp], slopes: Array, information: Array) -> float:
        """Correct by believed measurements, whose innovations have this information, and return their NIS.

        The image tells better than the wheels by how much the robot has turned, so the step is linearised
        again at what it then seems to have been. Without this each step leaves a second-order error of one
        sign, an expansion of the image that passes for a way forward (docs/decisions/ekf-parametrisation.md).
        A wheel that has slipped further than its noise allows is believed so much less, in this step only.
        """
        index = _measured(slots)
        residual = (slopes - self._state.rays[slots, :2]).ravel()
        for _ in range(self.settings.relinearisations):
            if self._step is None:
                break
            errors = self._step.wheel_errors(index, information @ residual)
            likely, at = self._step.likely(errors), self._step.at
            beyond = float(np.linalg.norm(errors))
            if beyond > self.settings.slip_sigmas:
                self._take(self._step.again(at=likely, wheel_root=beyond * self._step.wheel_root))
            elif max(abs(likely.forward - at.forward), abs(likely.turn - at.turn)) >= SAME_STEP:
                self._take(self._step.again(at=likely))
            else:
                break
            residual = (slopes - self._state.rays[slots, :2]).ravel()
            information = inverse(self._spread(slots))
        self._state = self._state.corrected(index, residual, information)
        return float(residual @ information @ residual) / len(residual)


def _measured(slots: NDArray[np.intp]) -> NDArray[np.intp]:
    """(2N,) entries of the state that the pixels of some landmarks measure: their a and b."""
    return np.asarray((3 + 3 * slots[:, None] + np.arange(2)).ravel(), np.intp)

"""The mapping filter: posture since an anchor and landmarks nobody knows yet, 3 + 3n (paper section 4).

Landmarks live in the moving camera's own frame as the paper has it, but as (a, b, w), slopes and inverse
depth: the image measures a and b directly, and a landmark of unknown depth is a landmark with a large
sigma of w (docs/decisions/ekf-parametrisation.md).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from agent.ekf import kernels
from agent.ekf.gating import believe, pixel_gate
from agent.ekf.landmarks import Ids, LandmarkEstimates
from agent.ekf.motion import WheelNoise
from agent.ekf.moving_state import MovingState, Step
from agent.ekf.pixel_noise import PixelNoise
from agent.ekf.report import Health, UpdateReport
from agent.ekf.settings import FilterSettings
from agent.observation import Odometry
from hybridmap.camera import Camera
from hybridmap.errors import InvalidValue
from hybridmap.pose import Array, PoseGaussian

__all__ = ["FilterSettings", "LandmarkEstimates", "MappingFilter"]

SAME_STEP = (1e-3, 4e-4)
"""m and rad; a step is not linearised again for less: what is then left of second order is below 1e-4 px."""

MANY = 10
"""With fewer landmarks in view nothing is learned of the pixels' noise."""


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
        kernels.load()
        self.settings = settings or FilterSettings()
        self.ids: Ids = np.zeros(0, np.int64)
        self.lost = 0
        self._camera = camera
        self._wheels = WheelNoise(axle, wheel_noise, self.settings.wheel_floor)
        self._focal = np.array([camera.fx, camera.fy])
        self._centre = np.array([camera.cx, camera.cy])
        self._gate = pixel_gate(self.settings.gate_probability)
        self._noise = PixelNoise(self.settings.pixel_sigma, self._focal, self.settings.adaptation)
        self._posture_variances = np.square(np.array(self.settings.posture_noise, np.float64))
        self._settled = MovingState.at_anchor()
        self._step: Step | None = None
        self._steps_unseen = 0
        self._distrust = 0
        self._baseline = 0.0
        self._base = np.zeros(2)
        self._last = (Health.GOOD, "")

    def predict(self, odometry: Odometry) -> None:
        """Move by one step of the wheels; landmarks that come behind the camera or far aside are let go."""
        root = self._wheels.root(odometry)
        if self._distrust:
            # Slip and lost encoders last for more than one step.
            self._distrust -= 1
            root = self._wheels.refuted_root(odometry, 1.0, self.settings.slip[0])
        mount = self._camera.mount_forward
        aside = self.settings.side_slip * (abs(odometry.forward) + self._wheels.axle * abs(odometry.turn))
        taken = Step.predict(self.state, odometry, root, aside, self._posture_variances, mount)
        stays = kernels.ahead(taken.rays, taken.scale, self.settings.nearest, self.settings.widest_slope)
        if not stays.all():
            self.lost += int((~stays).sum())
            self.ids = self.ids[stays]
            taken = taken.kept(stays)
        self._step = taken
        self._steps_unseen += 1
        x, y = (taken.posture[:2] - self._base).tolist()
        self._baseline = max(self._baseline, math.hypot(x, y))

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
        self._settle(self.state.grown(rays, variances))
        self._base, self._baseline = self.state.posture[:2].copy(), 0.0
        self.ids = np.concatenate([self.ids, np.asarray(ids, np.int64)])

    def update(self, ids: Ids, pixels: Array) -> UpdateReport:
        """Correct by the pixels of one image.

        Args:
            ids: (N,) what is seen; ids that the filter does not hold are ignored.
            pixels: (N, 2) px, undistorted; rows with NaN are ignored.
        """
        s = self.settings
        self._steps_unseen = 0
        self._noise.begin_image()
        slots, rows = self._slots(ids, pixels)
        if not len(slots):
            self._last = Health.BLIND, "no landmark of the filter is in view"
            return UpdateReport.blind(ids, self._last[1])
        slopes = (pixels[rows] - self._centre) / self._focal
        by_wheels = self._step
        if by_wheels is not None and s.relinearisations and len(slots) >= s.least_agreeing:
            self._step = by_wheels.again(at=by_wheels.seems(slots, slopes, s.slip_sigmas))
        innovations = slopes - self._rays[slots, :2]
        believed, information, health, reason = self._believe(slots, innovations)
        nis = math.nan
        agreeing = int(np.count_nonzero(believed))
        if agreeing:
            if agreeing < len(slots):
                slots, slopes = slots[believed], slopes[believed]
            nis, slip = self._correct(slots, slopes, information)
            if slip and health is Health.GOOD:
                health, reason = Health.SLIP, slip
        else:
            # What is not believed must not choose where the step is linearised either.
            self._step = by_wheels
            self._settle(self.state)
        accepted = np.zeros(len(ids), np.bool_)
        accepted[rows] = believed
        innovations_px = np.full((len(ids), 2), np.nan)
        innovations_px[rows] = innovations * self._focal
        self._last = health, reason
        return UpdateReport(ids, accepted, innovations_px, nis, health, reason)

    def remove(self, ids: Ids) -> None:
        """Forget landmarks; ids that are not there are ignored."""
        keep = ~np.isin(self.ids, ids)
        if not keep.all():
            self._settled = self._settled.kept(keep) if self._step is None else self._settled
            self._step = self._step.kept(keep) if self._step is not None else None
            self.ids = self.ids[keep]

    @property
    def state(self) -> MovingState:
        """The whole state, a value: for figures and tests."""
        return self._settled if self._step is None else self._step.state

    @property
    def health(self) -> tuple[Health, str]:
        """What holds the estimate up at present, and in words what is wrong; empty if nothing is."""
        unseen = self._steps_unseen
        if unseen >= self.settings.patience:
            return Health.NO_IMAGE, f"no image for {unseen} steps"
        if self._last[0] is not Health.GOOD:
            return self._last
        parallax = self._baseline * self._focal[0] / self.settings.prior_depth
        if parallax < self.settings.parallax_px and not self.converged().any():
            way = 1e3 * self._baseline
            return (
                Health.NO_PARALLAX,
                f"the robot has moved by {way:.0f} mm since landmarks were taken up: no depths",
            )
        return self._last

    @property
    def pose(self) -> PoseGaussian:
        """`anchor_from_robot`."""
        return self.state.pose

    def reanchor(self) -> PoseGaussian:
        """Make the present posture the anchor.

        Landmarks are held in the robot's frame, so this is the exact marginalisation of the old anchor.

        Returns:
            `old_anchor_from_new_anchor`.
        """
        pose = self.pose
        self._settle(self.state.reanchored())
        self._base = pose.mean.inverse().apply(self._base[None])[0]
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
        state = self.state
        return LandmarkEstimates.of_rays(self.ids.copy(), state.rays, state.blocks, self._camera)

    def converged(self) -> NDArray[np.bool_]:
        """(n,) landmarks whose depth is known well enough, in metres."""
        now = self.landmarks()
        limit = np.maximum(self.settings.converged_sigma, self.settings.converged_share * now.depths)
        return np.asarray(np.isfinite(now.depths) & (now.depth_sigmas <= limit), np.bool_)

    @property
    def _rays(self) -> Array:
        """(n, 3) where landmarks are expected now, without the covariance that `state` would compute."""
        return self._settled.rays if self._step is None else self._step.rays

    def _settle(self, state: MovingState) -> None:
        """Go on from a state; no step waits for its image any more."""
        self._settled, self._step = state, None

    def _slots(self, ids: Ids, pixels: Array | None = None) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Places in the state of those ids that are held and seen, and their rows among the ids given."""
        if len(ids) == len(self.ids) and (ids == self.ids).all():
            if pixels is not None:
                rows = kernels.finite_rows(np.ascontiguousarray(pixels, np.float64))
                return rows, rows
            return np.arange(len(ids)), np.arange(len(ids))
        _, slots, rows = np.intersect1d(self.ids, ids, return_indices=True)
        if pixels is not None:
            seen = np.isfinite(pixels[rows]).all(axis=1)
            slots, rows = slots[seen], rows[seen]
        return slots, rows

    def _spread(self, slots: NDArray[np.intp]) -> Array:
        """(2N, 2N) joint covariance of the innovations of some landmarks."""
        spread: Array = kernels.spread(self.state.covariance, slots, self._noise.variances)
        return spread

    def _believe(
        self, slots: NDArray[np.intp], innovations: Array
    ) -> tuple[NDArray[np.bool_], Array, Health, str]:
        """Which of the landmarks seen to correct by, the inverse of their S, and what that tells."""
        s, seen = self.settings, len(slots)
        believed, information, excess = believe(innovations, self._spread(slots), self._gate)
        agreeing = int(np.count_nonzero(believed))
        health, reason = Health.GOOD, ""
        if agreeing < s.least_agreeing_share * seen:
            health, reason = Health.DISAGREEMENT, f"{agreeing} of {seen} landmarks agree"
            if self._step is not None:
                # Many landmarks are seldom wrong together; the wheels may be (slip, a lost encoder).
                step, self._step = self._step, self._step.again(wheel_root=np.diag(s.slip))
                then_believed, then_information, _ = believe(innovations, self._spread(slots), self._gate)
                agreeing = int(np.count_nonzero(then_believed))
                if agreeing >= max(s.least_agreeing, s.least_agreeing_share * seen):
                    self._distrust = s.distrust
                    reason = f"the wheels are refuted by {agreeing} of {seen} landmarks"
                    return then_believed, then_information, Health.SLIP, reason
                self._step = step
            # A few that agree among many that do not may as well be the wrong ones.
            believed[:] = False
        elif seen >= MANY:
            self._noise.learn(excess)
        elif agreeing < s.least_agreeing:
            health, reason = (
                Health.FEW,
                f"{agreeing} of {seen} landmarks in view agree, {s.least_agreeing} are needed",
            )
        return believed, information, health, reason

    def _correct(self, slots: NDArray[np.intp], slopes: Array, information: Array) -> tuple[float, str]:
        """Correct by believed measurements, whose innovations have this information.

        The image tells better than the wheels by how much the robot has turned, so the step is linearised
        at what it then seems to have been. Without this each step leaves a second-order error of one
        sign, an expansion of the image that passes for a way forward (docs/decisions/ekf-parametrisation.md).
        Wheels that an image refutes are believed less; if they claim to stand, not at all and for a while.

        Returns:
            Their NIS over its degrees of freedom; and what is wrong with the wheels, empty if nothing is.
        """
        slip = ""
        residual = (slopes - self._rays[slots, :2]).ravel()
        for _ in range(self.settings.relinearisations):
            if self._step is None:
                break
            errors, at = self._step.wheel_errors(slots, residual, information), self._step.at
            likely, surprise = self._step.if_erred(errors.likely), errors.surprise
            if surprise > self.settings.slip_sigmas and not slip:
                slip = f"the landmarks refute the wheels by {surprise:.0f} sigmas"
                root = self._wheels.refuted_root(self._step.measured, surprise, self.settings.slip[0])
                self._step = self._step.again(at=likely, wheel_root=root)
                self._distrust = self.settings.distrust
            elif (
                abs(likely.forward - at.forward) >= SAME_STEP[0] or abs(likely.turn - at.turn) >= SAME_STEP[1]
            ):
                self._step = self._step.again(at=likely)
                if self._distrust:
                    slip = slip or "the wheels were refuted a moment ago, and are again"
            else:
                break
            residual = (slopes - self._rays[slots, :2]).ravel()
            information = kernels.inverse(self._spread(slots))
        self._settle(self.state.corrected(slots, residual, information, self._noise.variances))
        return float(residual @ information @ residual) / len(residual), slip

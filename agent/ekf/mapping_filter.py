"""The mapping filter: pose since an anchor and unknown landmarks, 3 + 3n (paper section 4).

Landmarks live in the moving camera's own frame as the paper has it, but as (a, b, w), slopes and inverse
depth: the image measures a and b directly, and a landmark of unknown depth is a landmark with a large
sigma of w (docs/decisions/ekf-parametrisation.md).
"""

import math

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.arrays import among
from mapweave.agent.ekf.adaptive_odometry_noise import AdaptiveOdometryNoise
from mapweave.agent.ekf.filter_health import FilterHealth
from mapweave.agent.ekf.gating import (
    GATE_PROBABILITY,
    MEDIAN,
    Judgement,
    pixel_gate,
    remove_outliers,
    select_inliers,
)
from mapweave.agent.ekf.innovations import Examined, innovation_covariance, whiten
from mapweave.agent.ekf.landmark_estimates import Ids, LandmarkEstimates
from mapweave.agent.ekf.mapping_state import (
    LEAST_AGREEING,
    PRIOR_DEPTH,
    PRIOR_SPREAD,
    MappingState,
    WheelStep,
)
from mapweave.agent.ekf.measurement_model import (
    RELINEARISATIONS,
    SLIP_SIGMAS,
    ImageMeasurement,
    Pinhole,
    slots_of,
)
from mapweave.agent.ekf.motion import WIDEST_SLOPE, WheelNoise, move_pose, transform_rays
from mapweave.agent.ekf.pitch_correction import pitch_offset
from mapweave.agent.ekf.pixel_noise import PixelNoise
from mapweave.agent.ekf.update_report import Health, UpdateReport
from mapweave.agent.observation import Odometry
from mapweave.agent.settings import FilterSettings
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array, PoseGaussian

LEAST_AGREEING_SHARE = 0.4
"""An update that accepts a smaller share of the landmarks seen is not healthy."""
CONVERGED_SIGMA = 0.05
"""Depth sigma under which a landmark has converged, m."""
CONVERGED_SHARE = 0.05
"""Depth sigma under which a landmark has converged, as a share of the depth; the larger of the two
counts."""
NEAREST = 0.05
"""Landmarks nearer than this to the optical centre are let go, m."""


SAME_STEP = (1e-3, 4e-4)
"""m and rad; a step is not linearised again for less: what is then left of second order is below 1e-4 px."""

MANY = 10
"""With fewer landmarks in view nothing is learned of the pixels' noise."""


class MappingFilter:
    """Extended Kalman filter over [pose (3), landmarks (n x 3)].

    Attributes:
        ids: (n,) landmark ids in the state's order, as the front end numbers them.
        lost: landmarks that the filter has removed since it began: behind the camera, or far aside.
    """

    def __init__(
        self,
        camera: Camera,
        axle: float,
        wheel_noise: float,
        settings: FilterSettings | None = None,
        side_slip: float = 0.0,
    ) -> None:
        """Start at the anchor, with certainty, knowing no landmark.

        Args:
            camera: intrinsics and mount.
            axle: distance between the wheels, m.
            wheel_noise: standard deviation of a wheel's way as a share of the way.
            settings: see there.
            side_slip: standard deviation of a step's slip aside, as a share of the wheels' way.
        """
        self.settings = settings or FilterSettings()
        self.ids: Ids = np.zeros(0, np.int64)
        self._camera = camera
        self._pinhole = Pinhole(camera)
        self._wheels = AdaptiveOdometryNoise(WheelNoise(axle, wheel_noise), side_slip)
        self._gate = pixel_gate(GATE_PROBABILITY)
        self._noise = PixelNoise(self.settings.pixel_sigma, self._pinhole.focal)
        self._settled = MappingState.at_anchor()
        self._step: WheelStep | None = None
        self._watch = FilterHealth(camera.fx)

    def predict(self, odometry: Odometry) -> None:
        """Move by one step of the wheels; landmarks that come behind the camera or far aside are removed."""
        state, mount = self.state, self._camera.mount_forward
        pose_vector, _, _ = move_pose(state.pose_vector, odometry)
        rays, scale = transform_rays(state.rays, odometry, mount)
        stays = (scale > 1e-3) & (rays[:, 2] * NEAREST <= 1.0) & (np.abs(rays[:, 0]) <= WIDEST_SLOPE)
        root, aside = self._wheels.root(odometry), self._wheels.side_slip(odometry)
        taken = WheelStep(state, odometry, root, aside, mount, odometry, pose_vector, rays)
        if not stays.all():
            self.ids = self.ids[stays]
            taken = taken.kept(stays)
        self._step = taken
        self._watch.moved(taken.pose_vector)

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
        if among(ids, self.ids).any() or len(np.unique(ids)) != n:
            raise InvalidValue("add: a landmark can be added only once")
        rays = np.empty((n, 3))
        rays[:, :2] = self._pinhole.slopes(pixels)
        variances = np.empty((n, 3))
        variances[:, :2] = (self.settings.pixel_sigma / self._pinhole.focal) ** 2
        if inverse_depths is None or sigmas is None:
            rays[:, 2] = 1.0 / PRIOR_DEPTH
            variances[:, 2] = (PRIOR_SPREAD / PRIOR_DEPTH) ** 2
        else:
            rays[:, 2] = inverse_depths
            variances[:, 2] = np.square(sigmas)
        self._settle(self.state.grown(rays, variances))
        self._watch.took_up(self.state.pose_vector)
        self.ids = np.concatenate([self.ids, np.asarray(ids, np.int64)])

    def update(self, ids: Ids, pixels: Array) -> UpdateReport:
        """Correct by the pixels of one image.

        Args:
            ids: (N,) what is seen; ids that the filter does not hold are ignored.
            pixels: (N, 2) px, undistorted; rows with NaN are ignored.
        """
        self._noise.begin_image()
        measurement = ImageMeasurement.of(self.ids, ids, pixels, self._pinhole)
        if not len(measurement.slots):
            self._watch.saw(Health.BLIND, "no landmark of the filter is in view")
            return UpdateReport.blind(len(ids), "no landmark of the filter is in view")
        by_wheels, pitch = self._step, None
        self._step, innovations = measurement.compared(by_wheels, self._settled, self._noise.variances)
        if not innovations.worst <= self._gate:
            pitch = pitch_offset(innovations.innovations, self._spread(measurement.slots), measurement.slopes)
            if pitch is not None:
                measurement = measurement._replace(slopes=measurement.slopes - pitch.offsets)
                self._step, innovations = measurement.compared(
                    by_wheels, self._settled, self._noise.variances
                )
        judged = self._judge(measurement, innovations)
        nis, health, reason = math.nan, judged.health, judged.reason
        if judged.agreeing:
            nis, slip = self._correct(measurement, judged)
            if slip and health is Health.GOOD:
                health, reason = Health.SLIP, slip
            if pitch is not None:
                # Landmarks that come in from now on are seen by the camera as it looks now; on a slope it
                # does not look back.
                self._settle(self.state.pitched(pitch.pitch, pitch.variance))
        else:
            # Rejected measurements must not choose the linearisation point either.
            self._step = by_wheels
            self._settle(self.state)
        self._watch.saw(health, reason)
        return measurement.report(judged.inliers, judged.innovations, nis, health, reason)

    def remove(self, ids: Ids) -> None:
        """Forget landmarks; ids that are not there are ignored."""
        keep = ~among(self.ids, ids)
        if not keep.all():
            self._settled = self._settled.kept(keep) if self._step is None else self._settled
            self._step = self._step.kept(keep) if self._step is not None else None
            self.ids = self.ids[keep]

    @property
    def state(self) -> MappingState:
        """The whole state, a value: for figures and tests."""
        return self._settled if self._step is None else self._step.state

    @property
    def health(self) -> tuple[Health, str]:
        """What holds the estimate up at present, and in words what is wrong; empty if nothing is."""
        return self._watch.health(lambda: bool(self.converged().any()))

    @property
    def pose(self) -> PoseGaussian:
        """`anchor_from_robot`."""
        return self.state.pose

    def reanchor(self) -> PoseGaussian:
        """Make the present pose the anchor.

        Landmarks are held in the robot's frame, so this is the exact marginalisation of the old anchor.

        Returns:
            `old_anchor_from_new_anchor`.
        """
        pose = self.pose
        self._settle(self.state.reanchored())
        self._watch.reanchored(pose.mean)
        return pose

    def predict_pixels(self, ids: Ids | None = None) -> Array:
        """(N, 2) px where landmarks are expected now; NaN for ids that the filter does not hold."""
        pixels = np.full((len(self.ids) + 1, 2), math.nan)
        pixels[:-1] = self._pinhole.pixels(self._rays[:, :2])
        # The last row is of those that are not held, whose slot is -1.
        return pixels[:-1] if ids is None else pixels[slots_of(self.ids, ids)]

    def landmarks(self) -> LandmarkEstimates:
        """All landmarks as they are known now."""
        state = self.state
        return LandmarkEstimates.of_rays(self.ids.copy(), state.rays, state.blocks, self._camera)

    def converged(self) -> NDArray[np.bool_]:
        """(n,) landmarks whose depth is known well enough, in metres."""
        now = self.landmarks()
        limit = np.maximum(CONVERGED_SIGMA, CONVERGED_SHARE * now.depths)
        return np.asarray(np.isfinite(now.depths) & (now.depth_sigmas <= limit), np.bool_)

    @property
    def _rays(self) -> Array:
        """(n, 3) where landmarks are expected now, without the covariance that `state` would compute."""
        return self._settled.rays if self._step is None else self._step.rays

    def _settle(self, state: MappingState) -> None:
        """Go on from a state; no step waits for its image any more."""
        self._settled, self._step = state, None

    def _spread(self, slots: NDArray[np.intp]) -> Array:
        """(2m, 2m) joint covariance of the innovations of some landmarks."""
        return innovation_covariance(self.state.covariance, slots, self._noise.variances)

    def _judge(self, measurement: ImageMeasurement, examined: Examined) -> Judgement:
        """Which measured landmarks to accept, and what they say about the wheels and the pixels."""
        slots = measurement.slots
        innovations, whitening, worst, median = examined
        inliers = np.ones(len(slots), np.bool_)
        if not worst <= self._gate:
            inliers, whitening, median = remove_outliers(innovations, self._spread(slots), self._gate)
        agreeing, least = len(whitening) // 2, LEAST_AGREEING_SHARE * len(slots)
        if agreeing < least:
            if self._step is not None:
                # Many landmarks are seldom wrong together; the wheels may be (slip, a lost encoder).
                step, self._step = self._step, self._step.again(wheel_root=self._wheels.slipped())
                still_inliers, still_whitening, _ = select_inliers(
                    innovations, self._spread(slots), self._gate
                )
                still_agreeing = len(still_whitening) // 2
                if still_agreeing >= max(LEAST_AGREEING, least):
                    self._wheels.increase()
                    reason = f"the wheels are refuted by {still_agreeing} of {len(slots)} landmarks"
                    return Judgement(innovations, still_inliers, still_whitening, Health.SLIP, reason)
                self._step = step
            # A few that agree among many that do not may as well be the wrong ones.
            reason = f"{agreeing} of {len(slots)} landmarks agree"
            return Judgement.of_none(innovations, Health.DISAGREEMENT, reason)
        if len(slots) >= MANY:
            self._noise.learn(median / MEDIAN)
        elif agreeing < LEAST_AGREEING:
            reason = f"{agreeing} of {len(slots)} landmarks in view agree, {LEAST_AGREEING} are needed"
            return Judgement(innovations, inliers, whitening, Health.FEW, reason)
        return Judgement(innovations, inliers, whitening)

    def _correct(self, measurement: ImageMeasurement, judged: Judgement) -> tuple[float, str]:
        """Update with the accepted measurements.

        The image measures the robot's turn better than the wheels do, so the step is linearised at the turn
        that the image suggests. Without this each step leaves a second-order error of one sign, an
        expansion of the image that looks like a drive forward (docs/decisions/ekf-parametrisation.md).
        Wheels that an image refutes get more noise; wheels that report a standstill carry no information for
        a while.

        Returns:
            Their NIS over its degrees of freedom; and what is wrong with the wheels, empty if nothing is.
        """
        slip, slots, slopes = "", measurement.slots, measurement.slopes
        residual, whitening = judged.innovations, judged.whitening
        if judged.agreeing < len(slots):
            slots, slopes = slots[judged.inliers], slopes[judged.inliers]
            residual = residual[judged.inliers]
        for _ in range(RELINEARISATIONS):
            if self._step is None:
                break
            at = self._step.at
            likely, surprise = self._step.in_hindsight(slots, residual, whitening)
            if surprise > SLIP_SIGMAS and not slip:
                slip = f"the landmarks refute the wheels by {surprise:.0f} sigmas"
                root = self._wheels.refuted(self._step.measured, surprise)
                self._step = self._step.again(at=likely, wheel_root=root)
            elif (
                abs(likely.forward - at.forward) >= SAME_STEP[0] or abs(likely.turn - at.turn) >= SAME_STEP[1]
            ):
                self._step = self._step.again(at=likely)
                if self._wheels.increased:
                    slip = slip or "the wheels were refuted a moment ago, and are again"
            else:
                break
            residual = slopes - self._rays[slots, :2]
            whitening = whiten(self._spread(slots))
        state, squares = self.state.corrected(slots, residual, whitening)
        self._settle(state)
        return squares / residual.size, slip

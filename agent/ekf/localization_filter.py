"""The localization filter: pose in a node's frame and the node's landmarks, 3 + 2n (paper section 6)."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.arrays import among
from mapweave.agent.ekf.gating import GATE_PROBABILITY, pixel_gate
from mapweave.agent.ekf.inverse_depth import project_anchored, rays_of_points
from mapweave.agent.ekf.iterated import LandmarkMeasurements, iterated_update
from mapweave.agent.ekf.landmark_estimates import Ids, NodeLandmarks
from mapweave.agent.ekf.localization_state import NEAREST_SCALE, LocalizationState
from mapweave.agent.ekf.measurement_model import slots_of
from mapweave.agent.ekf.motion import WIDEST_SLOPE, WheelNoise, move_pose
from mapweave.agent.ekf.update_report import Health, UpdateReport
from mapweave.agent.observation import Odometry
from mapweave.agent.settings import FilterSettings
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array, PoseGaussian
from mapweave.registration.planar_pose import PlanarPoseSettings, solve_planar_pose

ITERATIONS = 4
"""Linearisations of one update at most; a second is made only if the first did not hold."""
LINEAR_PX = 0.1
"""A pixel whose second-order part stays below this is linear, px."""
LOOSE_HEADING = 0.15
"""A heading less certain than this is first fixed by static least squares, rad."""
LOST_POSITION = 1.0
"""Uncertainty of a position that was refuted, m (the paper's 1 m)."""
LOST_HEADING = 1.0
"""Uncertainty of a heading that was refuted, rad (the paper's 1 rad)."""
LEAST_FIXED = 4
"""Landmarks that a static fix needs (paper, section 6)."""
LEAST_REFOUND = 6
"""Landmarks that a static fix needs to replace a pose that was refuted."""
LEAST_AGREEING = 3
"""An update with fewer accepted landmarks is bad."""
LEAST_AGREEING_SHARE = 0.35
"""An update that accepts a smaller share of the landmarks seen is bad."""
PATIENCE = 3
"""Bad updates in a row that make the filter unhealthy."""
WIDEST_SIGMA = 0.5
"""A position less certain than this makes the filter unhealthy, m."""
NEAREST = 0.05
"""Landmarks nearer than this to the node's optical centre cannot be anchored at it, m."""


class LocalizationFilter:
    """Iterated extended Kalman filter over [node_from_robot (3), landmarks (a, w) x n].

    Each landmark keeps the vertical slope b at the node that the map gives it. Its error is the same in
    every image, so it is no noise: it is carried as a considered state
    (mapweave.agent.ekf.localization_state).

    Attributes:
        ids: (n,) landmark ids in the state's order.
    """

    def __init__(
        self,
        camera: Camera,
        axle: float,
        wheel_noise: float,
        prior: PoseGaussian,
        ids: Ids,
        points_in_node: Array,
        covariances: Array,
        scale_share: float = 0.0,
        settings: FilterSettings | None = None,
        side_slip: float = 0.0,
    ) -> None:
        """Start from a pose, however uncertain, and a node's landmarks.

        Args:
            camera: of the robot that drives; the node's may be another.
            axle: distance between the wheels, m.
            wheel_noise: standard deviation of a wheel's way as a share of the way.
            prior: node_from_robot.
            ids: (n,) landmark ids as they will come in update.
            points_in_node: (n, 3) m, in the node's robot frame; those that cannot be anchored are left out.
            covariances: (n, 3, 3) m^2, in the node's robot frame.
            scale_share: common relative error of the points and the prior's position, on top of that; the
                wheels measure it.
            settings: see there.
            side_slip: standard deviation of a step's slip aside, as a share of the wheels' way.

        Raises:
            InvalidValue: shapes that do not belong together, or an id twice.
        """
        n = len(ids)
        if points_in_node.shape != (n, 3) or covariances.shape != (n, 3, 3):
            raise InvalidValue("localization: ids, points and covariances do not belong together")
        if len(np.unique(ids)) != n:
            raise InvalidValue("localization: a landmark can be given only once")
        self._settings = settings or FilterSettings()
        self._side_slip = side_slip
        self._camera = camera
        self._wheels = WheelNoise(axle, wheel_noise)
        self._focal = np.array([camera.fx, camera.fy])
        self._centre = np.array([camera.cx, camera.cy])
        self._bad = 0
        self._bad_reason = ""
        self._rng = np.random.default_rng(0)
        rays, by_point = rays_of_points(points_in_node, camera.mount_forward, camera.mount_height)
        fit = _anchorable(rays) & np.isfinite(covariances).all(axis=(1, 2))
        own = by_point[fit] @ covariances[fit] @ np.swapaxes(by_point[fit], 1, 2)
        self.ids: Ids = np.asarray(ids, np.int64)[fit]
        self._state = LocalizationState.of_prior(prior, rays[fit], own).of_unknown_scale(scale_share)

    def predict(self, odometry: Odometry) -> None:
        """Move by one step of the wheels. The landmarks do not move in the node's frame."""
        pose_vector, by_pose, by_input = move_pose(self._state.pose_vector, odometry)
        aside = self._side_slip * (abs(odometry.forward) + self._wheels.axle * abs(odometry.turn))
        noise = np.column_stack([by_input[:, :2] @ self._wheels.root(odometry), aside * by_input[:, 2]])
        p = self._state.covariance.copy()
        p[:3, 3:] = by_pose @ p[:3, 3:]
        p[3:, :3] = p[:3, 3:].T
        own = by_pose @ p[:3, :3] @ by_pose.T + noise @ noise.T
        p[:3, :3] = 0.5 * (own + own.T)
        self._state = replace(self._state, pose_vector=pose_vector, covariance=p)

    def update(self, ids: Ids, pixels: Array) -> UpdateReport:
        """Correct pose and landmarks by the pixels of one image.

        Args:
            ids: (N,) what is seen; ids that the filter does not hold are ignored.
            pixels: (N, 2) px, undistorted; rows with NaN are ignored.
        """
        mount = self._camera.mount_forward
        slots, rows = self._slots(ids)
        seen = np.isfinite(pixels[rows]).all(axis=1)
        slots, rows = slots[seen], rows[seen]
        start = self._start(slots, pixels[rows])
        scales = [
            project_anchored(start, rays[slots], mount).scale
            for rays in (self._state.rays, self._state.first)
        ]
        ahead = np.minimum(*scales) > NEAREST_SCALE
        slots, rows = slots[ahead], rows[ahead]
        if not len(slots):
            return self._judge(UpdateReport.blind(len(ids), "no landmark of the node is in view"))
        slopes = (pixels[rows] - self._centre) / self._focal
        variances, linear = (self._settings.pixel_sigma / self._focal) ** 2, LINEAR_PX / self._camera.fx
        gate = pixel_gate(GATE_PROBABILITY)
        measurement = LandmarkMeasurements(slots, slopes, variances, gate, ITERATIONS, linear)
        fit = iterated_update(self._state, start, measurement, mount)
        if fit is None:
            return self._judge(UpdateReport.blind(len(ids), "the pose is too uncertain to be corrected"))
        accepted = np.zeros(len(ids), np.bool_)
        # A few that agree among many that do not may as well be the wrong ones.
        if fit.accepted.mean() >= LEAST_AGREEING_SHARE:
            self._state = fit.state
            accepted[rows[fit.accepted]] = True
        innovations_px = np.full((len(ids), 2), np.nan)
        innovations_px[rows] = fit.innovations * self._focal
        kept = int(fit.accepted.sum())
        health, reason = Health.GOOD, ""
        if kept < LEAST_AGREEING_SHARE * len(slots):
            health, reason = Health.DISAGREEMENT, f"{kept} of {len(slots)} landmarks agree"
        elif kept < LEAST_AGREEING:
            health, reason = Health.FEW, f"{kept} of {len(slots)} landmarks agree"
        return self._judge(UpdateReport(accepted, innovations_px, fit.mean_nis, health, reason))

    def remove(self, ids: Ids) -> None:
        """Forget landmarks; ids that are not there are ignored."""
        kept = ~among(self.ids, ids)
        self._state, self.ids = self._state.kept(kept), self.ids[kept]

    @property
    def state(self) -> LocalizationState:
        """The whole state, a value: for figures and tests."""
        return self._state

    @property
    def pose(self) -> PoseGaussian:
        """`node_from_robot`."""
        return self._state.pose

    @property
    def healthy(self) -> bool:
        """Whether the pose may be driven by."""
        return not self.reason

    @property
    def reason(self) -> str:
        """Why it may not, in words; empty if healthy."""
        if self._bad >= PATIENCE:
            return self._bad_reason
        sigma = math.sqrt(float(np.linalg.eigvalsh(self._state.covariance[:2, :2])[-1]))
        return f"position known to {sigma:.1f} m only" if sigma > WIDEST_SIGMA else ""

    def predict_pixels(self, ids: Ids) -> Array:
        """(N, 2) px where landmarks are expected now; NaN if behind the camera, or if the filter has none."""
        projected = project_anchored(self._state.pose_vector, self._state.rays, self._camera.mount_forward)
        ahead = (projected.scale > NEAREST_SCALE)[:, None]
        pixels = np.where(ahead, self._centre + self._focal * projected.rays[:, :2], np.nan)
        # The last row is of those that are not held, whose slot is -1.
        return np.append(pixels, [[np.nan, np.nan]], axis=0)[slots_of(self.ids, ids)]

    def landmarks_in_node(self) -> NodeLandmarks:
        """All landmarks as they are known now."""
        return NodeLandmarks(self.ids.copy(), *self._state.points(self._camera))

    def _slots(self, ids: Ids) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Places in the state of those ids that are held, and their rows among the ids given."""
        _, slots, rows = np.intersect1d(self.ids, ids, return_indices=True)
        return slots, rows

    def _start(self, slots: NDArray[np.intp], pixels: Array) -> Array:
        """Pose at which to linearise first: the static fix where the own is too loose or was refuted.

        The fix is a point of linearisation only, so that no pixel is used twice. A refuted pose loses
        its certainty; the landmarks keep theirs.
        """
        state = self._state
        refuted = self._bad >= PATIENCE
        if not (refuted or state.covariance[2, 2] > LOOSE_HEADING**2):
            return state.pose_vector
        least = LEAST_REFOUND if refuted else LEAST_FIXED
        points, covariances = state.points(self._camera)
        fix = solve_planar_pose(
            points[slots],
            pixels,
            self._camera,
            rng=self._rng,
            point_covariances=covariances[slots],
            settings=PlanarPoseSettings(pixel_sigma=self._settings.pixel_sigma, least_inliers=least),
        )
        if fix is None:
            return state.pose_vector
        start = fix.node_from_robot.mean.vector
        if refuted:
            p = state.covariance.copy()
            p[:3, :] = p[:, :3] = 0.0
            p[[0, 1, 2], [0, 1, 2]] = LOST_POSITION**2, LOST_POSITION**2, LOST_HEADING**2
            self._state = replace(state, pose_vector=start.copy(), covariance=p)
        # The same turn of the circle as the prior's heading.
        start[2] += 2 * math.pi * round((self._state.pose_vector[2] - start[2]) / (2 * math.pi))
        return start

    def _judge(self, report: UpdateReport) -> UpdateReport:
        self._bad = 0 if report.healthy else self._bad + 1
        self._bad_reason = report.reason
        return report


def _anchorable(rays: Array) -> NDArray[np.bool_]:
    """(N,) which landmarks the node's camera sees ahead of it, not too near and not far aside."""
    near = rays[:, 2] * NEAREST > 1.0
    aside = ~(np.abs(rays[:, 0]) <= WIDEST_SLOPE)
    return np.asarray((rays[:, 2] > 0) & ~near & ~aside, np.bool_)

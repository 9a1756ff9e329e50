"""The mapping filter's model in FilterPy: the rival in speed, and a second implementation to agree with.

State [x, y, heading, (a, b, w) of each landmark] as in mapweave.agent.ekf.mapping_state, as a user of
FilterPy would write it: dense F, Q and H in numpy, all landmarks at once, no gates, no step linearised
twice. The formulas are written here again and share no code with mapweave.agent.ekf.
"""

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from mapweave.agent.observation import Odometry
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array


class FilterPyMapping(ExtendedKalmanFilter):  # type: ignore[misc]
    """FilterPy's extended Kalman filter over [pose (3), landmarks (n x 3)].

    Attributes:
        x: (3 + 3n,) state.
        P: (3 + 3n, 3 + 3n) covariance.
    """

    def __init__(
        self,
        camera: Camera,
        axle: float,
        wheel_noise: float,
        pixels: Array,
        pixel_sigma: float,
        prior_depth: float,
        prior_spread: float,
        wheel_floor: float = 1e-5,
    ) -> None:
        """Start at the anchor with the landmarks of its image.

        Args:
            camera: intrinsics and mount.
            axle: distance between the wheels, m.
            wheel_noise: standard deviation of a wheel's way as a share of the way.
            pixels: (n, 2) px, landmarks in the first image.
            pixel_sigma: px.
            prior_depth: depth at which landmarks are expected, m.
            prior_spread: sigma of the inverse depth, in units of 1 / prior_depth.
            wheel_floor: standard deviation of a wheel's way in a step without any, m.
        """
        n = len(pixels)
        super().__init__(dim_x=3 + 3 * n, dim_z=2 * n)
        self._focal = np.array([camera.fx, camera.fy])
        self._centre = np.array([camera.cx, camera.cy])
        self._mount = camera.mount_forward
        self._axle, self._share, self._floor = axle, wheel_noise, wheel_floor
        self._variances = (pixel_sigma / self._focal) ** 2
        # Where each landmark's three rows and columns lie in F and in the state.
        self._entry = 3 + 3 * np.arange(n)
        rays = np.column_stack([(pixels - self._centre) / self._focal, np.full(n, 1.0 / prior_depth)])
        self.x = np.concatenate([np.zeros(3), rays.ravel()])
        own = [*self._variances, (prior_spread / prior_depth) ** 2]
        self.P = np.diag(np.concatenate([np.zeros(3), np.tile(own, n)]))

    def move(self, odometry: Odometry) -> None:
        """Predict by one step of the wheels."""
        by_input = self._linearise(odometry)
        self.Q = by_input @ self._wheel_covariance(odometry) @ by_input.T
        self.predict(odometry)

    def predict_x(self, u: Odometry) -> None:
        """The non-linear motion of the state."""
        u1, u2 = u.forward, u.turn
        a, b, w = self.x[3::3], self.x[4::3], self.x[5::3]
        c, s = np.cos(u2), np.sin(u2)
        tx = u1 * np.cos(u2 / 2) + self._mount * (c - 1)
        ty = u1 * np.sin(u2 / 2) + self._mount * s
        depth = c * (1 - tx * w) - s * (a + ty * w)
        right = s * (1 - tx * w) + c * (a + ty * w)
        middle = self.x[2] + u2 / 2
        pose_vector = self.x[:3] + np.array([u1 * np.cos(middle), u1 * np.sin(middle), u2])
        self.x = np.concatenate(
            [pose_vector, np.stack([right / depth, b / depth, w / depth], axis=1).ravel()]
        )

    def see(self, pixels: Array) -> None:
        """Correct by an image, pixels (n, 2) px with NaN for landmarks that are not seen."""
        seen = np.isfinite(pixels[:, 0])
        entries = (self._entry[seen][:, None] + [0, 1]).ravel()
        h = np.zeros((len(entries), self.dim_x))
        h[np.arange(len(entries)), entries] = 1.0
        slopes = (pixels[seen] - self._centre) / self._focal
        noise = np.diag(np.tile(self._variances, len(slopes)))
        self.update(slopes.ravel(), lambda _: h, lambda x: x[entries], R=noise)

    def _linearise(self, odometry: Odometry) -> Array:
        """Set F and return the Jacobian by (u1, u2), (3 + 3n, 2), at the state before the step."""
        u1, u2 = odometry.forward, odometry.turn
        a, b, w = self.x[3::3], self.x[4::3], self.x[5::3]
        c, s, ch, sh = np.cos(u2), np.sin(u2), np.cos(u2 / 2), np.sin(u2 / 2)
        tx, ty = u1 * ch + self._mount * (c - 1), u1 * sh + self._mount * s
        tx1, tx2 = ch, -u1 * sh / 2 - self._mount * s
        ty1, ty2 = sh, u1 * ch / 2 + self._mount * c
        depth = c * (1 - tx * w) - s * (a + ty * w)
        right = s * (1 - tx * w) + c * (a + ty * w)
        one = np.ones_like(a)
        # Each new coordinate is top / depth: rows of the tops' and the depth's derivatives by a, b, w.
        depth_by = np.stack([-s * one, 0 * a, -(c * tx + s * ty) * one], axis=1)
        tops = np.stack([right, b, w], axis=1)
        tops_by = np.zeros((len(a), 3, 3))
        tops_by[:, 0, 0], tops_by[:, 0, 2] = c, c * ty - s * tx
        tops_by[:, 1, 1] = tops_by[:, 2, 2] = 1.0
        blocks = tops_by / depth[:, None, None]
        blocks -= tops[:, :, None] * depth_by[:, None, :] / depth[:, None, None] ** 2
        depth_by_u = np.stack([-w * (c * tx1 + s * ty1), -right - w * (c * tx2 + s * ty2)], axis=1)
        tops_by_u = np.zeros((len(a), 3, 2))
        tops_by_u[:, 0, 0] = w * (c * ty1 - s * tx1)
        tops_by_u[:, 0, 1] = depth + w * (c * ty2 - s * tx2)
        rays_by_u = tops_by_u / depth[:, None, None]
        rays_by_u -= tops[:, :, None] * depth_by_u[:, None, :] / depth[:, None, None] ** 2
        cm, sm = np.cos(self.x[2] + u2 / 2), np.sin(self.x[2] + u2 / 2)
        self.F = np.zeros((self.dim_x, self.dim_x))
        self.F[:3, :3] = [[1, 0, -u1 * sm], [0, 1, u1 * cm], [0, 0, 1]]
        rows = self._entry[:, None] + np.arange(3)
        self.F[rows[:, :, None], rows[:, None, :]] = blocks
        pose_by_u = np.array([[cm, -u1 * sm / 2], [sm, u1 * cm / 2], [0, 1]])
        return np.concatenate([pose_by_u, rays_by_u.reshape(-1, 2)])

    def _wheel_covariance(self, odometry: Odometry) -> Array:
        """(2, 2) covariance of (u1 m, u2 rad), from two wheels that err independently."""
        half = self._axle * odometry.turn / 2
        ways = np.array([odometry.forward + half, odometry.forward - half])
        by_wheels = np.array([[0.5, 0.5], [1 / self._axle, -1 / self._axle]])
        return np.asarray(by_wheels @ np.diag((self._share * ways) ** 2 + self._floor**2) @ by_wheels.T)

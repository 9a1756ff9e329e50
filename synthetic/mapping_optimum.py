"""The independent optimum: all poses and landmarks of a mapping run at once, by GTSAM."""

import gtsam
import numpy as np

from mapweave.agent.observation import Odometry
from mapweave.hybridmap.pose import Array, Pose2
from synthetic.mapping_run import AXLE, WHEEL_NOISE, MappingRun

_RIGID = 1e-6
"""Sigma of what the wheels and the floor forbid, m and rad: small, and not so small as to cost digits."""


def batch_optimum(run: MappingRun, prior_depth: float, prior_spread: float) -> tuple[Array, Array]:
    """Maximum a posteriori of a run, from the same measurements, noise and priors as the filter's.

    It starts at the truth, so that it is the optimum near the truth and not the luck of a start.

    Returns:
        The last pose in the first robot frame, (3,), and the landmarks in it, (N, 3) m.
    """
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    camera = run.camera
    lens = gtsam.Cal3_S2(camera.fx, camera.fy, 0.0, camera.cx, camera.cy)
    pixel = gtsam.noiseModel.Isotropic.Sigma(2, run.pixel_sigma)
    for k, pose in enumerate(run.poses):
        values.insert(_x(k), _camera_pose(run, pose))
    for i, point in enumerate(run.points):
        values.insert(_l(i), np.asarray(point))
        graph.add(_inverse_depth_prior(run, i, prior_depth, prior_spread))
    graph.add(gtsam.NonlinearEqualityPose3(_x(0), _camera_pose(run, Pose2())))
    for k, odometry in enumerate(run.odometry):
        between = _camera_pose(run, Pose2()).inverse() * _camera_pose(run, odometry.motion())
        graph.add(gtsam.BetweenFactorPose3(_x(k), _x(k + 1), between, _wheel_model(run, odometry)))
    for k, i in np.argwhere(np.isfinite(run.pixels[:, :, 0])):
        measured = run.pixels[k, i]
        graph.add(gtsam.GenericProjectionFactorCal3_S2(measured, pixel, _x(k), _l(i), lens))
    settings = gtsam.LevenbergMarquardtParams()
    settings.setRelativeErrorTol(1e-9)
    best = gtsam.LevenbergMarquardtOptimizer(graph, values, settings).optimize()
    last = best.atPose3(_x(len(run.odometry))) * _camera_pose(run, Pose2()).inverse()
    world = last.matrix()
    pose_vector = np.array([world[0, 3], world[1, 3], np.arctan2(world[1, 0], world[0, 0])])
    return pose_vector, np.array([best.atPoint3(_l(i)) for i in range(len(run.points))])


def _x(k: int) -> int:
    return int(gtsam.symbol("x", k))


def _l(i: int) -> int:
    return int(gtsam.symbol("l", i))


def _camera_pose(run: MappingRun, pose: Pose2) -> gtsam.Pose3:
    """world_from_camera of a robot pose; the camera is x right, y down, z forward."""
    c, s = np.cos(pose.heading), np.sin(pose.heading)
    world_from_robot = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    robot_from_camera = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    mount = world_from_robot @ np.array([run.camera.mount_forward, 0.0, run.camera.mount_height])
    position = mount + np.array([pose.x, pose.y, 0.0])
    return gtsam.Pose3(gtsam.Rot3(world_from_robot @ robot_from_camera), position)


def _wheel_model(run: MappingRun, odometry: Odometry) -> gtsam.noiseModel.Gaussian:
    """Noise of a step in the camera's tangent (rotation, translation), by differences of the motion."""
    half = 0.5 * AXLE * odometry.turn
    sigmas = [np.hypot(WHEEL_NOISE * (odometry.forward + way), 1e-5) for way in (half, -half)]
    middle = _camera_pose(run, odometry.motion())
    columns = []
    for sigma, side in zip(sigmas, (1.0, -1.0), strict=True):
        perturbed = Odometry(odometry.forward + 0.5 * sigma, odometry.turn + side * sigma / AXLE)
        columns.append(gtsam.Pose3.Logmap(middle.inverse() * _camera_pose(run, perturbed.motion())))
    root = np.column_stack(columns)
    return gtsam.noiseModel.Gaussian.Covariance(root @ root.T + _RIGID**2 * np.eye(6))


def _inverse_depth_prior(run: MappingRun, i: int, depth: float, spread: float) -> gtsam.CustomFactor:
    """The filter's prior of a new landmark: w = 1 / depth with sigma spread / depth, at the first image."""

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        ahead = values.atPoint3(_l(i))[0] - run.camera.mount_forward
        if jacobians is not None:
            jacobians[0] = np.array([[-depth / (spread * ahead**2), 0.0, 0.0]])
        return np.array([(depth / ahead - 1.0) / spread])

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), [_l(i)], error)

"""Known points in the image of a planar robot: how likely they are there, and which pose they imply.

With q the point in the axes of a robot at (x, y, heading), forward, left and up, and the camera
`mount_forward` ahead of the axle, looking along the robot's x axis,
    X = q_x - mount_forward,  a = q_y / X,  b = (q_z - mount_height) / X,  u = cx - fx a,  v = cy - fy b.
By the point, in the robot's axes, du = (fx a, -fx, 0) / X and dv = (fy b, 0, -fy) / X.

The camera may look up by an angle t against the points' frame, unknown but small. To a level camera, a pixel
with slopes (a', b') is then the one with
    a = a' / r,  b = (sin t + b' cos t) / r,  r = cos t - b' sin t;  da/dt = a b,  db/dt = 1 + b^2.
t is estimated with the pose, in units of its prior's standard deviation, so that a sigma of 0 holds it at 0.
Where inverted, the pixel's camera is the other one, and looks down by t against the first.

These are kernels (mapweave.hybridmap.jit): the code for sighting n runs for each in turn or for all
at once.
"""

import math
from typing import NamedTuple

import numpy as np

from mapweave.hybridmap.jit import Cube, Flags, Index, Matrix, Vector, compiled, for_each, for_each_pair

NEAREST = 0.05
"""Points less than this ahead of the optical centre count as not visible, m."""

GATE = 9.21
"""Chi-square 99 % point for 2 degrees of freedom."""

DEPTH_DECADES = math.log(100.0)
"""A wrong match's depth may be anything over two decades, evenly in its logarithm."""

LOG_DEPTH_DENSITY = math.log(DEPTH_DECADES) - 0.5 * math.log(2.0 * math.pi)

SMALL_STEP = 1e-4
"""Gauss-Newton ends when no component moves more, m and rad: far below any pose's uncertainty."""


class Optics(NamedTuple):
    """A camera as the kernels take it: focal lengths px, mount m, image's area px^2."""

    fx: float
    fy: float
    mount_height: float
    mount_forward: float
    area: float


class CameraSightings(NamedTuple):
    """N sightings of one camera.

    Attributes:
        points: (N, 3) m.
        covariances: (N, 3, 3) m^2.
        slopes: (N, 2) a and b of each pixel.
        depths: (N,) m; 1 where not measured.
        depth_variances: (N,) m^2; 1 where not measured.
        measured: (N,) where the image gives a depth too.
        pixel_variance: px^2.
        pitch_variance: rad^2, by which the camera may be pitched; counts as noise of each pixel alone.
        optics: of the camera.
    """

    points: Matrix
    covariances: Cube
    slopes: Matrix
    depths: Vector
    depth_variances: Vector
    measured: Flags
    pixel_variance: float
    pitch_variance: float
    optics: Optics


class PoseHypotheses(NamedTuple):
    """H poses of the robot in the points' frame: (H,) m, m and the heading's cosine and sine."""

    x: Vector
    y: Vector
    cos: Vector
    sin: Vector


@for_each_pair
def _log_ratio(h: Index, n: Index, seen: CameraSightings, poses: PoseHypotheses) -> Vector:
    """Log likelihood ratio of sighting n under pose h against a wrong match, nats; see `log_ratios`."""
    optics, p = seen.optics, seen.covariances
    c, s = poses.cos[h], poses.sin[h]
    dx, dy = seen.points[n, 0] - poses.x[h], seen.points[n, 1] - poses.y[h]
    depth = c * dx + s * dy - optics.mount_forward
    ahead = np.maximum(depth, NEAREST)
    a = (c * dy - s * dx) / ahead
    b = (seen.points[n, 2] - optics.mount_height) / ahead
    # The point's covariance in the robot's axes.
    xx = c * c * p[n, 0, 0] + 2.0 * c * s * p[n, 0, 1] + s * s * p[n, 1, 1]
    yy = p[n, 0, 0] + p[n, 1, 1] - xx
    xy = c * s * (p[n, 1, 1] - p[n, 0, 0]) + (c * c - s * s) * p[n, 0, 1]
    xz, yz = c * p[n, 0, 2] + s * p[n, 1, 2], c * p[n, 1, 2] - s * p[n, 0, 2]
    # And in the image.
    fu, fv = optics.fx / ahead, optics.fy / ahead
    ru, rv = optics.fx * (a - seen.slopes[n, 0]), optics.fy * (b - seen.slopes[n, 1])
    uu = fu * fu * (a * (a * xx - 2.0 * xy) + yy) + seen.pixel_variance
    vv = fv * fv * (b * (b * xx - 2.0 * xz) + p[n, 2, 2]) + seen.pixel_variance
    uv = fu * fv * (b * (a * xx - xy) - a * xz + yz)
    pitch_u = optics.fx * seen.slopes[n, 0] * seen.slopes[n, 1]
    pitch_v = optics.fy * (1.0 + seen.slopes[n, 1] * seen.slopes[n, 1])
    uu = uu + seen.pitch_variance * pitch_u * pitch_u
    vv = vv + seen.pitch_variance * pitch_v * pitch_v
    uv = uv + seen.pitch_variance * pitch_u * pitch_v
    determinant = uu * vv - uv * uv
    distance2 = (ru * (vv * ru - 2.0 * uv * rv) + uu * rv * rv) / determinant
    # The depth is treated as independent of the pixel here; the refinement does not.
    variance = xx + seen.depth_variances[n]
    off = depth - seen.depths[n]
    depth2 = seen.measured[n] * off * off / variance
    gain = seen.measured[n] * (np.log(seen.depths[n]) + LOG_DEPTH_DENSITY - 0.5 * np.log(variance))
    ratio = math.log(optics.area / (2.0 * math.pi)) - 0.5 * (np.log(determinant) + distance2 + depth2) + gain
    kept = (depth > NEAREST) & (distance2 < GATE) & (depth2 < GATE)
    nats: Vector = kept * np.maximum(ratio, 0.0)
    return nats


@compiled
def log_ratios(seen: CameraSightings, poses: PoseHypotheses) -> Matrix:
    """(H, N) log likelihood ratios of sightings under poses against wrong matches, nats; 0 where the point is
    behind the camera or outside the 99 % gate.
    """
    return _log_ratio(len(poses.x), len(seen.points), seen, poses)


class Stack(NamedTuple):
    """All sightings of one problem, in columns; each has its own camera and direction.

    Attributes:
        points: (N, 3) m.
        covariances: (N, 3, 3) m^2.
        observed: (N, 3) u px, v px, depth m; the depth is 0 where not measured.
        noise: (N, 3) variances of these.
        measured: (N,) where the depth is.
        gates: (N,) largest squared normalised residual of an inlier.
        log_wrong: (N,) what -log of a right match's density is compared with, nats.
        inverted: (N,) the point is in the robot's frame, and the image was taken where the wanted pose's
            frame has its origin.
        optics: (N, 6) fx, fy, cx, cy px, mount_height, mount_forward m.
        pitch_sigma: rad, prior of the pitch.
    """

    points: Matrix
    covariances: Cube
    observed: Matrix
    noise: Matrix
    measured: Flags
    gates: Vector
    log_wrong: Vector
    inverted: Flags
    optics: Matrix
    pitch_sigma: float


class Linear(NamedTuple):
    """A stack linearised at a pose and at points.

    Attributes:
        reprojection_px: (N, 2) observed, levelled, minus predicted, against the points where they are now.
        white: (N, 3, 5) for u px, v px and depth m the residual against the point where it was given, and how
            it shrinks by the pose's x, y and heading, perturbed on the right as in PoseGaussian, and by the
            pitch, in sigmas; whitened by the inverse of the residuals' Cholesky factor. 0 where not visible.
        factor: (N, 6) Cholesky's, 00 10 11 20 21 22, of the covariance of the residuals.
        by_point: (N, 4) du by forward and left, dv by forward and up, px/m, in the axes of the robot whose
            camera it is. The depth's derivative is forward.
        axes: (N, 2) cosine and sine of that robot's heading in the points' frame.
        distance2: (N,) squared normalised residuals.
        log_ratios: (N,) nats against a wrong match, not cut.
        inliers: (N,).
        weights: (N,) probability that a sighting is right, 0 for outliers.
    """

    reprojection_px: Matrix
    white: Cube
    factor: Matrix
    by_point: Matrix
    axes: Matrix
    distance2: Vector
    log_ratios: Vector
    inliers: Flags
    weights: Vector


@for_each
def _linearise(n: Index, stack: Stack, pose: Vector, points: Matrix, out: Linear) -> None:
    """Fill in the result of `linearise` for sighting n."""
    fx, fy, cx, cy = stack.optics[n, 0], stack.optics[n, 1], stack.optics[n, 2], stack.optics[n, 3]
    x, y, cos, sin = pose[0], pose[1], math.cos(pose[2]), math.sin(pose[2])
    # Pose of the camera's robot in the points' frame: the pose, or its inverse.
    inverse = 1.0 * stack.inverted[n]
    direct = 1.0 - inverse
    c, s = cos, sin * (direct - inverse)
    dx = points[n, 0] - direct * x + inverse * (cos * x + sin * y)
    dy = points[n, 1] - direct * y - inverse * (sin * x - cos * y)
    forward, left = c * dx + s * dy, c * dy - s * dx
    depth = forward - stack.optics[n, 5]
    ahead = np.maximum(depth, NEAREST)
    a, b = left / ahead, (points[n, 2] - stack.optics[n, 4]) / ahead
    u_x, u_y, v_x, v_z = fx * a / ahead, -fx / ahead, fy * b / ahead, -fy / ahead

    # The pixel levelled. The depth stays: it changes by less than its uncertainty, a share of b t.
    by_sigma = (direct - inverse) * stack.pitch_sigma
    up, down = np.cos(by_sigma * pose[3]), np.sin(by_sigma * pose[3])
    seen_b = (cy - stack.observed[n, 1]) / fy
    ray = up - seen_b * down
    level_a, level_b = (cx - stack.observed[n, 0]) / fx / ray, (down + seen_b * up) / ray

    # Observed minus predicted; and back from where the point is now to where it was given.
    off_u, off_v = fx * (a - level_a), fy * (b - level_b)
    off_d = stack.observed[n, 2] - depth
    bx, by = stack.points[n, 0] - points[n, 0], stack.points[n, 1] - points[n, 1]
    back_x, back_y, back_z = c * bx + s * by, c * by - s * bx, stack.points[n, 2] - points[n, 2]

    # Cholesky's factor of the residuals' covariance: the depth's variance may be a million times a pixel's.
    p, noise = stack.covariances, stack.noise
    xx = c * c * p[n, 0, 0] + 2.0 * c * s * p[n, 0, 1] + s * s * p[n, 1, 1]
    yy, zz = p[n, 0, 0] + p[n, 1, 1] - xx, p[n, 2, 2]
    xy = c * s * (p[n, 1, 1] - p[n, 0, 0]) + (c * c - s * s) * p[n, 0, 1]
    xz, yz = c * p[n, 0, 2] + s * p[n, 1, 2], c * p[n, 1, 2] - s * p[n, 0, 2]
    f00 = np.sqrt(u_x * (u_x * xx + 2.0 * u_y * xy) + u_y * u_y * yy + noise[n, 0])
    f10 = (v_x * (u_x * xx + u_y * xy) + v_z * (u_x * xz + u_y * yz)) / f00
    f20 = (u_x * xx + u_y * xy) / f00
    f11 = np.sqrt(v_x * (v_x * xx + 2.0 * v_z * xz) + v_z * v_z * zz + noise[n, 1] - f10 * f10)
    f21 = (v_x * xx + v_z * xz - f20 * f10) / f11
    f22 = np.sqrt(xx + noise[n, 2] - f20 * f20 - f21 * f21)

    # A step of the pose moves the point in the robot's axes by -(1, 0, -left) and -(0, 1, forward); where
    # inverted, inverse(pose @ d) = inverse(pose) @ (-Ad(pose) d) to first order.
    visible = depth > NEAREST
    white = out.white
    for k in range(5):
        if k == 0:
            u = off_u - u_x * back_x - u_y * back_y
            v = off_v - v_x * back_x - v_z * back_z
            d = stack.measured[n] * (off_d - back_x)
        elif k == 4:
            u, v = by_sigma * fx * level_a * level_b, by_sigma * fy * (1.0 + level_b * level_b)
            d = 0.0 * depth
        else:
            if k == 1:
                along, aside = inverse * cos - direct, inverse * sin
            elif k == 2:
                along, aside = -inverse * sin, inverse * cos - direct
            else:
                along, aside = (
                    inverse * y + (direct - inverse) * left,
                    -inverse * x + (inverse - direct) * forward,
                )
            u, v, d = u_x * along + u_y * aside, v_x * along, along
        white[n, 0, k] = visible * u / f00
        white[n, 1, k] = (visible * v - f10 * white[n, 0, k]) / f11
        white[n, 2, k] = (visible * d - f20 * white[n, 0, k] - f21 * white[n, 1, k]) / f22

    distance2 = white[n, 0, 0] ** 2 + white[n, 1, 0] ** 2 + white[n, 2, 0] ** 2
    ratio = stack.log_wrong[n] - np.log(f00 * f11 * f22) - 0.5 * distance2
    inlier = visible & (distance2 < stack.gates[n]) & (ratio > 0.0)
    out.reprojection_px[n, 0], out.reprojection_px[n, 1] = off_u, off_v
    out.factor[n, 0], out.factor[n, 1], out.factor[n, 2] = f00, f10, f11
    out.factor[n, 3], out.factor[n, 4], out.factor[n, 5] = f20, f21, f22
    out.by_point[n, 0], out.by_point[n, 1], out.by_point[n, 2], out.by_point[n, 3] = u_x, u_y, v_x, v_z
    out.axes[n, 0], out.axes[n, 1] = c, s
    out.distance2[n], out.log_ratios[n], out.inliers[n] = distance2, ratio, inlier
    out.weights[n] = inlier / (1.0 + np.exp(-np.minimum(np.maximum(ratio, 0.0), 30.0)))


@compiled
def linearise(stack: Stack, pose: Vector, points: Matrix) -> Linear:
    """Linearise sightings at pose and pitch (4,), see `improve`, and at points (N, 3) m near the stack's."""
    count = len(stack.points)
    out = Linear(
        np.empty((count, 2)), np.empty((count, 3, 5)), np.empty((count, 6)), np.empty((count, 4)),
        np.empty((count, 2)), np.empty(count), np.empty(count), np.empty(count, np.bool_), np.empty(count),
    )  # fmt: skip
    _linearise(count, stack, pose, points, out)
    return out


@compiled
def normal_equations(linear: Linear, pitch: float) -> Matrix:
    """(5, 5) products of the columns of all white rows, each counted by its weight, with the pitch's prior.

    Of pose and pitch, [1:, 1:] is the information and [1:, 0] the gradient.

    Args:
        linear: the rows.
        pitch: at which they were linearised, in sigmas.
    """
    rows = (linear.white * np.sqrt(linear.weights)[:, None, None]).reshape(-1, 5)
    products = rows.T @ rows
    products[4, 4] += 1.0
    products[4, 0] -= pitch
    products[0, 4] -= pitch
    return products


@compiled
def of_pose_alone(products: Matrix) -> Matrix:
    """(3, 3) information of the pose, the pitch marginalised out of the normal equations."""
    information: Matrix = products[1:4, 1:4] - np.outer(products[1:4, 4], products[4, 1:4]) / products[4, 4]
    return information


@compiled
def determined(information: Matrix) -> bool:
    """Whether a pose's (3, 3) information is well conditioned; lengths are compared with angles at 1 m."""
    if not np.isfinite(information).all():
        return False
    values = np.linalg.eigvalsh(information)
    return bool(values[0] > 1e-9 * max(values[2], 1e-300))


@for_each
def _move_point(n: Index, stack: Stack, linear: Linear, step: Vector, out: Matrix) -> None:
    """Put point n where it fits best after a step of the pose, within its uncertainty.

    An outlier's too: whether it is one depends on where it is linearised. Put back, it would be an inlier
    where it was given and none where it fits best, in turns.
    """
    white, factor, p = linear.white, linear.factor, stack.covariances
    # The residual that is left, times the inverse of its covariance.
    left0 = white[n, 0, 0] - white[n, 0, 1] * step[0] - white[n, 0, 2] * step[1] - white[n, 0, 3] * step[2]
    left1 = white[n, 1, 0] - white[n, 1, 1] * step[0] - white[n, 1, 2] * step[1] - white[n, 1, 3] * step[2]
    left2 = white[n, 2, 0] - white[n, 2, 1] * step[0] - white[n, 2, 2] * step[1] - white[n, 2, 3] * step[2]
    left0, left1 = left0 - white[n, 0, 4] * step[3], left1 - white[n, 1, 4] * step[3]
    left2 = left2 - white[n, 2, 4] * step[3]
    d = left2 / factor[n, 5]
    v = (left1 - factor[n, 4] * d) / factor[n, 2]
    u = (left0 - factor[n, 1] * v - factor[n, 3] * d) / factor[n, 0]
    # By the point: in the robot's axes, then in the points' frame.
    forward = linear.by_point[n, 0] * u + linear.by_point[n, 2] * v + d
    left, z = linear.by_point[n, 1] * u, linear.by_point[n, 3] * v
    x = linear.axes[n, 0] * forward - linear.axes[n, 1] * left
    y = linear.axes[n, 1] * forward + linear.axes[n, 0] * left
    for k in range(3):
        out[n, k] = stack.points[n, k] + p[n, k, 0] * x + p[n, k, 1] * y + p[n, k, 2] * z


@compiled
def improve(stack: Stack, start: Vector, rounds: int) -> tuple[bool, Vector, Matrix]:
    """Bring a pose to its best near a first one by Gauss-Newton, with iteratively reweighted rows.

    What becomes least is pitch^2 / 2 - sum of ln(1 + exp(ratio)) over the sightings inside their gates: each
    is a right match, Gaussian, or a wrong one, anywhere (a mixture as in MLESAC: Torr and Zisserman, CVIU 78,
    2000), with its point where it fits best (variable projection: Golub and Pereyra, SIAM J. Numer. Anal. 10,
    1973). The rows' weights are that cost's; that the residuals' covariance depends on the pose is left out
    of each step.

    Args:
        stack: the sightings.
        start: (4,) m, m, rad, and the pitch in sigmas.
        rounds: at most.

    Returns:
        Whether the inliers determine a pose; pose and pitch (4,); and the points (N, 3) m that fit them best.
    """
    pose, points = start.copy(), stack.points.copy()
    for _ in range(rounds):
        linear = linearise(stack, pose, points)
        products = normal_equations(linear, pose[3])
        # Copies: a compiled kernel takes and solves dense arrays.
        information, gradient = products[1:, 1:].copy(), products[1:, 0].copy()
        c, s = math.cos(pose[2]), math.sin(pose[2])
        if not determined(of_pose_alone(products)):
            return False, pose, points
        step = np.linalg.solve(information, gradient).astype(np.float64)
        pose[0] += c * step[0] - s * step[1]
        pose[1] += s * step[0] + c * step[1]
        pose[2] = (pose[2] + step[2] + math.pi) % (2.0 * math.pi) - math.pi
        pose[3] += step[3]
        _move_point(len(points), stack, linear, step, points)
        if np.abs(step).max() < SMALL_STEP:
            break
    return True, pose, points

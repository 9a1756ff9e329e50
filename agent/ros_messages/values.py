"""Poses, cameras and mounts that ROS messages tell."""

import math
from typing import Any, NamedTuple

import numpy as np

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import DeviceError, InvalidValue
from mapweave.hybridmap.pose import Array
from mapweave.vision.lens import LensModel

LENS_MODELS = {
    "plumb_bob": LensModel.RADIAL_TANGENTIAL,
    "rational_polynomial": LensModel.RADIAL_TANGENTIAL,
    "": LensModel.RADIAL_TANGENTIAL,
    "equidistant": LensModel.EQUIDISTANT,
    "fisheye": LensModel.EQUIDISTANT,
}
"""Lens models by ROS' names of them; some drivers write `fisheye`."""
ODOMETRY_TYPE, CAMERA_TYPE, TF_TYPE = (
    "nav_msgs/msg/Odometry", "sensor_msgs/msg/CameraInfo", "tf2_msgs/msg/TFMessage",
)  # fmt: skip
KIDNAP_TYPE = "irobot_create_msgs/msg/KidnapStatus"
IMAGE_TYPES = ("sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image")
FOOTPRINT, BASE = BASES = ("base_footprint", "base_link")
"""Frames of a robot on the floor, and above it (REP 105)."""
CAMERA_FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""(3, 3) from x right, y down, z forward to x forward, y left, z up (REP 103)."""


class Mount(NamedTuple):
    """Where a sensor is on the robot.

    Attributes:
        forward: m.
        left: m.
        up: above the floor, m.
        heading: of its x axis, rad; of the viewing direction if its frame is a camera's optical one.
        pitch: likewise, rad below the horizon.
    """

    forward: float
    left: float
    up: float
    heading: float
    pitch: float = 0.0


def stamp_of(message: Any) -> int:
    """When it was measured, ns, by its header; 0 if it does not say."""
    header = getattr(message, "header", None)
    return 0 if header is None else header.stamp.sec * 1_000_000_000 + header.stamp.nanosec


def heading_of(qx: float, qy: float, qz: float, qw: float) -> float:
    """Heading of a rotation about the vertical, rad, from a quaternion of any length but zero."""
    return math.atan2(2.0 * (qw * qz + qx * qy), qw * qw + qx * qx - qy * qy - qz * qz)


def pose_of(message: Any) -> tuple[float, float, float]:
    """X m, y m and heading rad of an Odometry, PoseStamped or PoseWithCovarianceStamped.

    The heading is not a number if the quaternion is all zeros: the sender has left it empty.
    """
    pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
    return pose.position.x, pose.position.y, _heading(pose.orientation)


def planar_pose_of(transform: Any) -> tuple[float, float, float]:
    """X m, y m and heading rad of a Transform; likewise."""
    return transform.translation.x, transform.translation.y, _heading(transform.rotation)


def _heading(q: Any) -> float:
    return heading_of(q.x, q.y, q.z, q.w) if any((q.x, q.y, q.z, q.w)) else math.nan


def camera_of(message: Any, rectified: bool = False) -> tuple[Camera, LensModel, tuple[float, ...]]:
    """The camera of a CameraInfo, with no mount; `lens_of` makes the ideal camera and the lens of it.

    Args:
        message: of ROS 2, or of ROS 1.
        rectified: whether it is the camera of images from which the distortion has been removed.

    Returns:
        The camera of the real image, the model of its lens, and the coefficients.

    Raises:
        DeviceError: its lens is not supported, or its numbers are of no camera.
    """
    name = str(message.distortion_model)
    if name not in LENS_MODELS:
        known = " and ".join(name for name in LENS_MODELS if name)
        raise DeviceError(f"lens model {name!r} is not supported; {known} are")
    model = LENS_MODELS[name]
    # ROS 1 writes these in capitals.
    k, d, p = (
        np.asarray(getattr(message, name, getattr(message, name.upper(), ())), float) for name in "kdp"
    )
    if rectified:
        k, d, model = np.delete(p, [3, 7, 11]), d[:0], LensModel.RADIAL_TANGENTIAL
    if len(d) > 5 and np.any(d[5:]):
        raise DeviceError(
            f"a lens of {len(d)} coefficients is not supported; measure five: mapweave calibrate camera"
        )
    count = 4 if model is LensModel.EQUIDISTANT else 5
    try:
        camera = Camera(int(message.width), int(message.height), k[0], k[4], k[2], k[5], 0.0)
    except (InvalidValue, IndexError) as error:
        raise DeviceError(str(error)) from None
    return camera, model, tuple([*d.tolist(), *[0.0] * count][:count])


class FixedTransforms:
    """The transforms of /tf_static: where sensors are on the robot."""

    def __init__(self) -> None:
        """Start without any."""
        self._parents: dict[str, tuple[str, Array]] = {}

    def add(self, message: Any) -> None:
        """Take in a TFMessage."""
        for one in message.transforms:
            parent = one.header.frame_id.lstrip("/")
            self._parents[one.child_frame_id.lstrip("/")] = parent, matrix_of(one.transform)

    def camera(self, frame: str) -> Mount | None:
        """The mount of a camera whose optical frame is given; None if it is unknown."""
        return _mount(self._robot_from(frame), np.linalg.inv(CAMERA_FROM_OPTICAL)[:, 0])

    def sensor(self, frame: str) -> Mount | None:
        """The mount of a sensor that looks along the x axis of a frame; None if it is unknown."""
        return _mount(self._robot_from(frame), np.array([1.0, 0.0, 0.0]))

    def _robot_from(self, frame: str) -> Array | None:
        """(4, 4) robot_from_frame: by the footprint if there is one, else by the base."""
        at, chain = frame.lstrip("/"), np.eye(4)
        robot: Array | None = None
        # A chain has no more steps than there are transforms, even if they make a circle.
        for _ in range(len(self._parents) + 1):
            if at.rpartition("/")[2] in BASES:
                robot = chain
                # Some robots hang the footprint below the base.
                prefix = at.removesuffix(BASE)
                below, step = self._parents.get(prefix + FOOTPRINT, ("", np.eye(4)))
                if below == at:
                    robot = np.linalg.inv(step) @ chain
            if at not in self._parents:
                break
            at, step = self._parents[at]
            chain = step @ chain
        return robot


def matrix_of(transform: Any) -> Array:
    """(4, 4) of a Transform."""
    q, t = transform.rotation, transform.translation
    x, y, z, w = np.array([q.x, q.y, q.z, q.w]) / max(math.hypot(q.x, q.y, q.z, q.w), 1e-12)
    out = np.eye(4)
    out[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    out[:3, 3] = t.x, t.y, t.z
    return out


def _mount(robot_from_frame: Array | None, ahead: Array) -> Mount | None:
    if robot_from_frame is None:
        return None
    x, y, z = robot_from_frame[:3, 3].tolist()
    direction = robot_from_frame[:3, :3] @ ahead
    pitch = -math.asin(min(max(float(direction[2]), -1.0), 1.0))
    return Mount(x, y, z, math.atan2(direction[1], direction[0]), pitch)

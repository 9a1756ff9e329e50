"""The agent's values as ROS messages."""

import math
from typing import Any

import numpy as np

from mapweave.agent.observation import Command
from mapweave.agent.ros_messages.values import FOOTPRINT
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.vision.equidistant import Equidistant
from mapweave.vision.lens import NO_DISTORTION, Distortion
from mapweave.wire.ros2.messages import make

OPTICAL = "camera_optical_frame"
"""Frame of a camera, by REP 103: x right, y down, z forward."""


def header(stamp_ns: int, frame: str) -> Any:
    """A Header."""
    sec, nanosec = divmod(stamp_ns, 1_000_000_000)
    stamp = make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def pose(at: Pose2) -> Any:
    """A Pose."""
    position = make("geometry_msgs/msg/Point", x=at.x, y=at.y, z=0.0)
    return make("geometry_msgs/msg/Pose", position=position, orientation=quaternion(at.heading))


def pose_with_covariance(at: PoseGaussian) -> Any:
    """A PoseWithCovariance: its position's covariance is along the axes of the frame, not of the robot."""
    c, s = math.cos(at.mean.heading), math.sin(at.mean.heading)
    turned = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    covariance = np.zeros((6, 6))
    covariance[np.ix_((0, 1, 5), (0, 1, 5))] = turned @ at.covariance @ turned.T
    name = "geometry_msgs/msg/PoseWithCovariance"
    return make(name, pose=pose(at.mean), covariance=covariance.ravel())


def quaternion(heading: float) -> Any:
    """A Quaternion about the vertical."""
    half = heading / 2
    return make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sin(half), w=math.cos(half))


def transform(stamp_ns: int, parent: str, child: str, parent_from_child: Pose2) -> Any:
    """A TransformStamped on the floor."""
    at = make("geometry_msgs/msg/Vector3", x=parent_from_child.x, y=parent_from_child.y, z=0.0)
    turn = quaternion(parent_from_child.heading)
    moved = make("geometry_msgs/msg/Transform", translation=at, rotation=turn)
    name, head = "geometry_msgs/msg/TransformStamped", header(stamp_ns, parent)
    return make(name, header=head, child_frame_id=child, transform=moved)


def twist(command: Command) -> Any:
    """A Twist."""
    linear = make("geometry_msgs/msg/Vector3", x=command.forward, y=0.0, z=0.0)
    angular = make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=command.turn)
    return make("geometry_msgs/msg/Twist", linear=linear, angular=angular)


def mount(stamp_ns: int, camera: Camera) -> Any:
    """A TransformStamped: the camera in the robot. It looks ahead, turned into the optical axes."""
    at = make("geometry_msgs/msg/Vector3", x=camera.mount_forward, y=0.0, z=camera.mount_height)
    turn = make("geometry_msgs/msg/Quaternion", x=-0.5, y=0.5, z=-0.5, w=0.5)
    moved = make("geometry_msgs/msg/Transform", translation=at, rotation=turn)
    name, head = "geometry_msgs/msg/TransformStamped", header(stamp_ns, FOOTPRINT)
    return make(name, header=head, child_frame_id=OPTICAL, transform=moved)


def camera_info(head: Any, camera: Camera, lens: Distortion = NO_DISTORTION) -> Any:
    """A CameraInfo.

    Args:
        head: of the image.
        camera: ideal, into which images are rectified.
        lens: of the real one.
    """
    name = "sensor_msgs/msg/RegionOfInterest"
    region = make(name, x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    real, model, d = (
        (lens, "equidistant", lens.k) if isinstance(lens, Equidistant) else (camera, "plumb_bob", lens)
    )
    k = np.array([real.fx, 0.0, real.cx, 0.0, real.fy, real.cy, 0.0, 0.0, 1.0])
    p = np.array([camera.fx, 0.0, camera.cx, 0.0, 0.0, camera.fy, camera.cy, 0.0, 0.0, 0.0, 1.0, 0.0])
    return make(
        "sensor_msgs/msg/CameraInfo", header=head, height=camera.height, width=camera.width, k=k, p=p,
        r=np.eye(3).ravel(), distortion_model=model, d=np.array(d), binning_x=0, binning_y=0, roi=region,
    )  # fmt: skip

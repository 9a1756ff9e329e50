"""A known geometry put to use: a level lens, the camera that it makes, and corrected odometry.

Everything behind the lens knows a camera that looks straight ahead, and a robot that turns about the point
below which its camera stands sideways. So a camera that looks a little aside or down is turned level in the
lens; its principal point moves by as much as its pixels, so that images stay where they are.
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.calibration.camera_motions import ROBOT_FROM_LEVEL, robot_from_camera
from mapweave.agent.drive_geometry import DriveGeometry
from mapweave.agent.observation import Observation, Odometry, RobotDescription
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.vision.lens import Distortion, Lens


class LevelLens(Lens):
    """A lens whose ideal image is that of a camera which looks straight ahead."""

    def __init__(
        self, camera: Camera, distortion: Distortion, level: Camera, level_from_camera: Array
    ) -> None:
        """Take the camera as it is and the level one.

        Args:
            camera: intrinsics of the images.
            distortion: of the lens.
            level: intrinsics of the ideal image.
            level_from_camera: (3, 3) rotation.
        """
        super().__init__(camera, distortion)
        self._own, self._level = _matrix(camera), _matrix(level)
        self._turn = level_from_camera

    def undistort(self, raw: NDArray[Any]) -> Array:
        """(N, 2) px in the real image -> (N, 2) px in the ideal one."""
        return _turned(super().undistort(raw), self._own, self._turn, self._level)

    def distort(self, pixels: NDArray[Any]) -> Array:
        """(N, 2) px in the ideal image -> (N, 2) px in the real one."""
        pixels = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
        return super().distort(_turned(pixels, self._level, self._turn.T, self._own))


def geometry_of(description: RobotDescription) -> DriveGeometry:
    """What a robot declares."""
    camera = description.camera
    declared = description.geometry or DriveGeometry()
    return replace(declared, forward=camera.mount_forward, height=camera.mount_height)


def declaring(description: RobotDescription, geometry: DriveGeometry) -> RobotDescription:
    """A robot that declares this geometry."""
    camera = replace(description.camera, mount_forward=geometry.forward, mount_height=geometry.height)
    return replace(description, camera=camera, geometry=geometry)


def corrected(description: RobotDescription, geometry: DriveGeometry) -> tuple[RobotDescription, Lens]:
    """The robot as everything behind the lens shall know it, and the lens.

    Args:
        description: as declared; its camera has the intrinsics of the images.
        geometry: to use.
    """
    camera = replace(description.camera, mount_forward=geometry.forward, mount_height=geometry.height)
    angles = (geometry.heading, geometry.pitch, geometry.roll)
    if not any(angles):
        lens = Lens(camera, description.distortion)
    else:
        turn = ROBOT_FROM_LEVEL.T @ robot_from_camera(*angles)
        # A camera that looks down sees the horizon above its middle.
        level = replace(
            camera,
            cx=camera.cx + camera.fx * math.tan(geometry.heading),
            cy=camera.cy - camera.fy * math.tan(geometry.pitch),
        )
        lens, camera = LevelLens(camera, description.distortion, level, turn), level
    axle = description.axle * geometry.wheel_scale / geometry.turn_scale
    return replace(description, camera=camera, axle=axle), lens


def frame_change(before: DriveGeometry, after: DriveGeometry) -> Pose2:
    """`old_from_new` of the robot's frame when another geometry is used: the camera stays where it is."""
    old_from_camera, new_from_camera = (Pose2(g.forward, 0.0, g.heading) for g in (before, after))
    return old_from_camera @ new_from_camera.inverse()


class OdometryCorrection:
    """Odometry as wheels without errors would report it, at the time of the image."""

    def __init__(self) -> None:
        """Begin with a robot of which it is unknown whether it moves."""
        self._stamp_ns = 0
        self._before: tuple[float, float] | None = None

    def step(self, observation: Observation, geometry: DriveGeometry) -> Observation:
        """Correct the odometry of the next observation.

        With U(t) what the wheels have counted, U(t + delay) is needed. Within one reading they go on as they
        did in the last: U(t_k + d) = U_k + d U'_k, and the increment becomes u_k + d (U'_k - U'_(k-1)).
        """
        wheels = observation.odometry
        span = 1e-9 * (observation.stamp_ns - self._stamp_ns)
        first = self._stamp_ns == 0 or span <= 0.0
        self._stamp_ns = observation.stamp_ns
        extra = (0.0, 0.0)
        if not first:
            rate = wheels.forward / span, wheels.turn / span
            # A recording may begin at any speed, and so may a process that is started again.
            before = self._before or rate
            extra = geometry.delay * (rate[0] - before[0]), geometry.delay * (rate[1] - before[1])
            self._before = rate
        way = geometry.wheel_scale * (wheels.forward + extra[0])
        turn = geometry.turn_scale * (wheels.turn + extra[1]) + geometry.drift * way
        if (way, turn) == (wheels.forward, wheels.turn) and not geometry.left:
            return observation
        # The point below the camera moves ahead less in turns to its side.
        return replace(observation, odometry=Odometry(way - geometry.left * turn, turn))


def _matrix(camera: Camera) -> Array:
    return np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])


def _turned(pixels: Array, before: Array, turn: Array, after: Array) -> Array:
    """(N, 2) px by the homography of a camera that turns on the spot."""
    homography = after @ turn @ np.linalg.inv(before)
    there = np.column_stack([pixels, np.ones(len(pixels))]) @ homography.T
    return np.asarray(there[:, :2] / there[:, 2:])

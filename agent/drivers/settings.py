"""The `[robot]` table of a settings file: which driver, its options, the camera, and the body's geometry."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

from mapweave.agent.observation import RobotDescription
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import SettingsError

REMOTE = "remote"
"""The driver of a body behind Zenoh keys, for example a simulated one."""


@dataclass(frozen=True)
class CameraSettings:
    """Where images come from, and the camera that takes them. Names as in the `camera.toml` of recordings.

    Attributes:
        width: px.
        height: px.
        fx: focal length, px.
        fy: focal length, px.
        cx: principal point, px.
        cy: principal point, px.
        height_m: of the optical centre above the floor.
        forward_m: how far the optical centre stands ahead of the axle.
        distortion: (k1, k2, p1, p2, k3) of the lens, OpenCV's order.
        source: number or path of a video device, a video file, or the URL of an RTSP or HTTP stream.
        delay: time from the middle of the exposure until the frame is here, s; subtracted from the stamps.
        lock_exposure: leave exposure and white balance alone after the first second.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    height_m: float
    forward_m: float = 0.0
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    source: str = "0"
    delay: float = 0.0
    lock_exposure: bool = False

    @property
    def intrinsics(self) -> Camera:
        """The ideal camera on the robot."""
        return Camera(
            self.width, self.height, self.fx, self.fy, self.cx, self.cy, self.height_m, self.forward_m
        )


@dataclass(frozen=True)
class Geometry:
    """The body. A driver knows its robot's; what a settings file gives goes over that. None: not given.

    Attributes:
        radius: of the footprint, m.
        axle: distance between the wheels, m.
        wheel_noise: standard deviation of a wheel's way, as a share of the way.
        max_forward: speed limit, m/s.
        max_turn: rate limit, rad/s.
        ranger_bearings_deg: directions of the proximity sensors, 0 ahead, positive to the left.
        ranger_reach: the proximity sensors' maximum, m.
    """

    radius: float | None = None
    axle: float | None = None
    wheel_noise: float | None = None
    max_forward: float | None = None
    max_turn: float | None = None
    ranger_bearings_deg: tuple[float, ...] | None = None
    ranger_reach: float | None = None

    def over(self, defaults: Geometry) -> Geometry:
        """These values where they are given, the defaults elsewhere."""
        given = {f.name: getattr(self, f.name) for f in fields(self) if getattr(self, f.name) is not None}
        return replace(defaults, **given)


@dataclass(frozen=True)
class RobotSettings:
    """One robot.

    Attributes:
        driver: name of a driver, as `mapweave robots` lists them, or `FILE.py:CLASS`.
        options: the driver's own table.
        camera: where images come from; a driver that has images of its own needs none.
        geometry: what differs from what the driver knows of its robot.
    """

    driver: str = REMOTE
    options: Mapping[str, Any] = field(default_factory=dict)
    camera: CameraSettings | None = None
    geometry: Geometry = field(default_factory=Geometry)

    def describe(self, known: Geometry) -> RobotDescription:
        """What the agent is told of the robot.

        Args:
            known: what the driver knows of the body.

        Raises:
            SettingsError: there is no camera, or a length is missing or no length.
        """
        if self.camera is None:
            raise SettingsError(
                "the settings have no [robot.camera]: give source, width, height, fx, fy, cx, cy and height_m"
            )
        body = self.geometry.over(known)
        for name in ("radius", "axle", "max_forward", "max_turn"):
            value = getattr(body, name)
            if value is None:
                raise SettingsError(f"[robot.geometry] {name} is missing: the driver cannot know it")
            if not value > 0.0:
                raise SettingsError(f"[robot.geometry] {name} = {value:g} must be positive")
        assert body.radius and body.axle and body.max_forward and body.max_turn
        given = RobotDescription(
            self.camera.intrinsics,
            self.camera.distortion,
            radius=body.radius,
            axle=body.axle,
            max_forward=body.max_forward,
            max_turn=body.max_turn,
            ranger_bearings=tuple(math.radians(b) for b in body.ranger_bearings_deg or ()),
            ranger_reach=body.ranger_reach or 0.0,
        )
        return given if body.wheel_noise is None else replace(given, wheel_noise=body.wheel_noise)

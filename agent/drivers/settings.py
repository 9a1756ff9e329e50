"""The `[robot]` table of a settings file: which driver, its options, the camera, and the robot's geometry."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any, TypeVar

from msgspec import Meta

from mapweave.agent.drive_geometry import FARTHEST, check_mount
from mapweave.agent.observation import RobotDescription
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import InvalidValue, SettingsError
from mapweave.storage.settings_file import build
from mapweave.vision.lens import Distortion, LensModel, lens_of

REMOTE = "remote"
"""The driver of a robot base behind Zenoh keys, for example a simulated one."""

Positive = Annotated[float, Meta(gt=0.0)]

T = TypeVar("T")


@dataclass(frozen=True)
class CameraSettings:
    """Source of the images and calibration of the camera. Names as in the `camera.toml` of recordings.

    Attributes:
        width: width of the image, px.
        height: height of the image, px.
        fx: horizontal focal length of the real image, px.
        fy: vertical focal length, px.
        cx: column of the principal point, px.
        cy: row of the principal point, px.
        height_m: height of the optical centre above the floor, m.
        forward_m: how far the optical centre stands ahead of the axle, m.
        lens: model of the lens: `radial-tangential`, or `equidistant` for a fisheye lens.
        distortion: (k1, k2, p1, p2, k3), or (k1, k2, k3, k4) of an equidistant lens, OpenCV's order.
        source: number or path of a video device, a video file, or the URL of an RTSP or HTTP stream.
        delay: time from the middle of the exposure until the frame is here, s; subtracted from the stamps.
        lock_exposure: fix exposure and white balance after the first second.
    """

    width: Annotated[int, Meta(ge=16, le=16384)]
    height: Annotated[int, Meta(ge=16, le=16384)]
    fx: Positive
    fy: Positive
    cx: float
    cy: float
    height_m: float
    forward_m: float = 0.0
    lens: LensModel = LensModel.RADIAL_TANGENTIAL
    distortion: tuple[float, ...] = ()
    source: str = "0"
    delay: Annotated[float, Meta(ge=0.0, le=5.0)] = 0.0
    lock_exposure: bool = False

    @property
    def optics(self) -> tuple[Camera, Distortion]:
        """The ideal camera on the robot, and the lens.

        Raises:
            InvalidValue: the coefficients are not those of such a lens, it folds, or the mount
                cannot be right.
        """
        check_mount(self.height_m, self.forward_m)
        image = Camera(
            self.width, self.height, self.fx, self.fy, self.cx, self.cy, self.height_m, self.forward_m
        )
        return lens_of(image, self.lens, self.distortion)

    def __post_init__(self) -> None:
        """Refuse what no camera can be; see `optics`."""
        _ = self.optics


@dataclass(frozen=True)
class Geometry:
    """Dimensions and limits of a robot. The settings file overrides the driver's values; None is not given.

    Attributes:
        radius: radius of the footprint, m.
        axle: distance between the wheels, m.
        wheel_noise: standard deviation of a wheel's way, as a share of the way.
        max_forward: speed limit, m/s.
        max_turn: rate limit, rad/s.
        ranger_bearings_deg: directions of the proximity sensors, 0 ahead, positive to the left, degrees.
        ranger_reach: the proximity sensors' maximum, m.
    """

    radius: Positive | None = None
    axle: Positive | None = None
    wheel_noise: Annotated[float, Meta(ge=0.0, le=1.0)] | None = None
    max_forward: Positive | None = None
    max_turn: Positive | None = None
    ranger_bearings_deg: tuple[float, ...] | None = None
    ranger_reach: Positive | None = None

    def __post_init__(self) -> None:
        """Refuse what no robot can be."""
        for name, value in (("radius", self.radius), ("axle", self.axle)):
            if value is not None and value > FARTHEST:
                raise InvalidValue(f"geometry: {name} is {value:g}; it is in metres, at most {FARTHEST:g}")

    def over(self, defaults: Geometry) -> Geometry:
        """These values where given, the defaults elsewhere."""
        given = {f.name: getattr(self, f.name) for f in fields(self) if getattr(self, f.name) is not None}
        return replace(defaults, **given)


@dataclass(frozen=True)
class RobotSettings:
    """One robot.

    Attributes:
        driver: name of a driver, as `mapweave robots` lists them, or `FILE.py:CLASS`.
        options: the driver's own table.
        camera: source and calibration; None for a driver with images of its own.
        geometry: overrides the driver's values.
    """

    driver: str = REMOTE
    options: Mapping[str, Any] = field(default_factory=dict)
    camera: CameraSettings | None = None
    geometry: Geometry = field(default_factory=Geometry)

    def options_as(self, cls: type[T]) -> T:
        """The driver's own table as its dataclass.

        Raises:
            SettingsError: a value is missing or wrong; it says where to write it.
        """
        try:
            return build(cls, self.options, "[robot.options]")
        except SettingsError as error:
            words = str(error)
            if not words.endswith("is missing"):
                raise
            found = "; `mapweave find-port` finds it" if words.endswith(" port is missing") else ""
            raise SettingsError(
                f"{words}: write it in the robot's settings file, and give that with --robot FILE.toml "
                f"(docs/drivers.md){found}"
            ) from None

    def check_remote(self) -> None:
        """Refuse a table that describes a robot on this computer where no driver is named.

        Raises:
            SettingsError: it has a camera, options or a geometry, which a base behind Zenoh keys has itself.
        """
        tables = {"options": self.options, "camera": self.camera, "geometry": self.geometry != Geometry()}
        given = [f"[robot.{name}]" for name, there in tables.items() if there]
        if given:
            raise SettingsError(
                f"the settings have {' and '.join(given)}, which the driver {REMOTE}, the default, does not "
                "use: name the robot's driver by a line `driver = ...` in [robot] (`mapweave robots` lists "
                "them), or by --robot NAME; for a robot behind the network or a simulated one: "
                f"--robot {REMOTE}"
            )

    def describe(self, known: Geometry) -> RobotDescription:
        """Description of the robot for the agent.

        Args:
            known: values of the driver.

        Raises:
            SettingsError: there is no camera, or a dimension is missing.
        """
        if self.camera is None:
            raise SettingsError(
                "the settings have no [robot.camera]: give source, width, height, fx, fy, cx, cy and height_m"
            )
        geometry = self.geometry.over(known)
        for name in ("radius", "axle", "max_forward", "max_turn"):
            if getattr(geometry, name) is None:
                raise SettingsError(f"[robot.geometry] {name} is missing: the driver cannot know it")
        assert geometry.radius and geometry.axle and geometry.max_forward and geometry.max_turn
        given = RobotDescription(
            *self.camera.optics,
            radius=geometry.radius,
            axle=geometry.axle,
            max_forward=geometry.max_forward,
            max_turn=geometry.max_turn,
            ranger_bearings=tuple(math.radians(b) for b in geometry.ranger_bearings_deg or ()),
            ranger_reach=geometry.ranger_reach or 0.0,
        )
        return given if geometry.wheel_noise is None else replace(given, wheel_noise=geometry.wheel_noise)

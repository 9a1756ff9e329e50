"""Setup of a simulated robot, made from the tables of a scenario file."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

from msgspec import Meta

from mapweave.agent.observation import RobotDescription
from mapweave.hybridmap.errors import InvalidValue, SettingsError
from mapweave.hybridmap.ids import check_name
from mapweave.hybridmap.limits import Coordinate
from mapweave.hybridmap.pose import Pose2
from mapweave.sim.body import BodySettings
from mapweave.sim.camera import CAMERAS, CameraSetup
from mapweave.storage.settings_file import build

MOST_ROBOTS = 16
"""In one simulation."""


@dataclass(frozen=True)
class RobotSetup:
    """One robot.

    Attributes:
        name: of the robot.
        camera: what it sees with.
        body: how its wheels and motors differ from the ideal.
        start: where it starts, (x m, y m, heading rad) in world; chosen from the seed if not given.
        rangers: number of proximity sensors, evenly around it.
        ranger_reach: the rangers' maximum, m.
        range_noise: standard deviation of a range, as a share of it.
        max_forward: speed limit, m/s.
        max_turn: rate limit, rad/s.
    """

    name: str
    camera: CameraSetup = field(default_factory=CameraSetup)
    body: BodySettings = field(default_factory=BodySettings)
    start: tuple[Coordinate, Coordinate, Coordinate] | None = None
    rangers: Annotated[int, Meta(ge=0, le=256)] = 16
    ranger_reach: Annotated[float, Meta(ge=0.1, le=50.0)] = 3.0
    range_noise: Annotated[float, Meta(ge=0.0, le=0.5)] = 0.01
    max_forward: Annotated[float, Meta(ge=0.01, le=1.0)] = 0.3
    max_turn: Annotated[float, Meta(ge=0.01, le=3.0)] = 0.8

    def __post_init__(self) -> None:
        """Refuse a name that cannot be one (InvalidValue)."""
        check_name(self.name)

    @property
    def pose(self) -> Pose2 | None:
        """Where it starts, `world_from_robot`, if that is given."""
        return None if self.start is None else Pose2(*self.start)

    def describe(self) -> RobotDescription:
        """The description that the robot's agent gets."""
        ideal = RobotDescription(self.camera.intrinsics)
        return replace(
            ideal,
            wheel_noise=math.hypot(ideal.wheel_noise, self.body.wheel_noise(ideal.tick)),
            distortion=self.camera.distortion,
            ranger_bearings=tuple(k * math.tau / self.rangers for k in range(self.rangers)),
            ranger_reach=self.ranger_reach if self.rangers else 0.0,
            max_forward=self.max_forward,
            max_turn=self.max_turn,
            ranges_see_robots=True,
        )


def robot_from_table(table: Mapping[str, Any], where: str = "robot") -> RobotSetup:
    """Make a robot from a table of a scenario file.

    Its `camera` is a name (`camera = "wide"`), or a table of what differs from the camera that its `like`
    names (`camera = { like = "wide", read_noise = 4.0 }`), from the webcam if none is named.

    Raises:
        SettingsError: an unknown name, or a value of the wrong kind or out of range.
        InvalidValue: a name of a robot that cannot be one.
    """
    values = dict(table)
    if "camera" in values:
        values["camera"] = camera_from_table(values["camera"], f"{where}: camera")
    return build(RobotSetup, values, where)


def camera_from_table(value: Any, where: str = "camera") -> CameraSetup:
    """Make a camera from its name, or from a table of what differs from a camera with a name.

    Raises:
        SettingsError: an unknown name, or a value of the wrong kind or out of range.
        InvalidValue: a lens that shows one point in two places, or too large an image.
    """
    if isinstance(value, CameraSetup):
        return value
    changes = {"like": value} if isinstance(value, str) else value
    if not isinstance(changes, Mapping):
        raise SettingsError(f"{where}: must be a name ({', '.join(CAMERAS)}) or a table")
    changes = dict(changes)
    name = changes.pop("like", "webcam")
    if not isinstance(name, str) or name not in CAMERAS:
        raise SettingsError(f"{where}: no camera {name!r}; there are {', '.join(CAMERAS)}")
    return build(CameraSetup, _changed(dataclasses.asdict(CAMERAS[name]), changes), where)


def _changed(defaults: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """The defaults with the changes in them, table by table."""
    merged = dict(defaults)
    for name, value in changes.items():
        default = merged.get(name)
        both = isinstance(default, Mapping) and isinstance(value, Mapping)
        merged[name] = _changed(default, value) if both and default is not None else value
    return merged


def robot_setups(robots: Sequence[str | RobotSetup]) -> tuple[RobotSetup, ...]:
    """Names alone become standard robots.

    Raises:
        InvalidValue: no robot, too many, or two of the same name.
    """
    setups = tuple(RobotSetup(robot) if isinstance(robot, str) else robot for robot in robots)
    if not 1 <= len(setups) <= MOST_ROBOTS:
        raise InvalidValue(f"{len(setups)} robots: the simulator carries 1 to {MOST_ROBOTS}")
    if len({setup.name for setup in setups}) != len(setups):
        raise InvalidValue("two robots have the same name")
    return setups

"""What a person sets of a robot's program: the part `[agent]` of a settings file."""

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated

from msgspec import Meta

from mapweave.registration.selection import SelectionSettings
from mapweave.vision.sift import SiftSettings

Positive = Annotated[float, Meta(gt=0.0)]


@dataclass(frozen=True, slots=True)
class FilterSettings:
    """How the mapping filter and the localization filter weigh pixels.

    Attributes:
        pixel_sigma: standard deviation of a tracked pixel, px.
    """

    pixel_sigma: Positive = 0.7


@dataclass(frozen=True)
class TrackingSettings:
    """How landmarks are kept up while a view is mapped.

    Attributes:
        filtered: landmarks in the mapping filter; further tracks are triangulated against its trajectory.
    """

    filtered: Annotated[int, Meta(ge=4)] = 36


@dataclass(frozen=True)
class ExplorerSettings:
    """How the robot explores.

    Attributes:
        drive_speed: speed of the drive back and forth that maps a view, m/s.
        turn_rate: largest rate of turns on the spot and on the way, rad/s.
        travel_speed: speed on the way to the next place, m/s.
        ask_fleet: whether to ask the fleet what others have mapped, and to leave that to them.
        random: explore by chance, as the paper does (section 4.1), instead of place by place.
        without_rangers: whether a robot without proximity sensors may explore, slowly, by its camera and by
            touch; it will touch things.
    """

    drive_speed: Positive = 0.25
    turn_rate: Positive = 0.6
    travel_speed: Positive = 0.26
    ask_fleet: bool = True
    random: bool = False
    without_rangers: bool = False


@dataclass(frozen=True)
class NavigatorSettings:
    """How the robot drives to a goal.

    Attributes:
        speed: speed between nodes, m/s.
        turn_rate: largest rate of turns between nodes, rad/s.
        blind_distance: way without any landmark in sight after which the robot must find itself again, m.
        blocked_first: how long it avoids an edge that was blocked for the first time, s: people walk on.
        blocked_longest: each further time it avoids it twice as long, up to this, s: walls stay.
        patience: a goal is given up when no further edge on the way was driven to for so long, s.
        make_room: whether a robot that has parked at its goal, or has explored all, makes room for another
            one in whose way it stands: it drives to a node off that way, and stays there.
    """

    speed: Positive = 0.26
    turn_rate: Positive = 0.6
    blind_distance: Positive = 2.0
    blocked_first: Positive = 15.0
    blocked_longest: Positive = 120.0
    patience: Positive = 300.0
    make_room: bool = True


@dataclass(frozen=True)
class PortalSettings:
    """What a robot does at lifts, ramps and doors through which it asks to be taken.

    Attributes:
        command: program and arguments that take it through, for example by calling the lift; none waits for
            people alone. Exit status 0 says that it is through; see docs/floors.md.
        patience: how long it waits at one portal altogether before it gives its goal up, s. The command is
            ended then, too.
    """

    command: tuple[str, ...] = ()
    patience: Positive = 1800.0


@dataclass(frozen=True)
class OccupancyGridSettings:
    """What the robot keeps of what its proximity sensors saw.

    Attributes:
        cell: side of a cell, m.
        side: side of the whole grid, m; its middle is where the map began.
        clearance: room kept between the footprint's edge and anything seen, m.
    """

    cell: Positive = 0.1
    side: Positive = 48.0
    clearance: Annotated[float, Meta(ge=0.0)] = 0.1


class WithoutServer(StrEnum):
    """What a robot does while no map server is in reach."""

    GO_ON = "go on"
    STAND = "stand"
    HOME = "home"
    """It parks at the first node of its map."""


@dataclass(frozen=True)
class AgentSettings:
    """A robot's program.

    Attributes:
        seed: seed of all that the robot does by chance.
        without_server: what it does while no map server is in reach: "go on" with its mission, "stand", or go
            "home", to the first node of its map. Its mission goes on when the server is back.
        keep_views: whether it keeps a small image of each node in a folder beside its maps. The map server
            shows it to people who may read the map. If not, no image leaves the robot.
        sift: features of an image.
        landmarks: which landmarks a node keeps.
        filter: both Kalman filters.
        tracking: of landmarks while a view is mapped.
        exploration: where to map next.
        navigation: to a goal.
        portals: lifts, ramps and doors through which it asks to be taken.
        occupancy_grid: of what the proximity sensors saw.
    """

    seed: Annotated[int, Meta(ge=0)] = 0
    without_server: WithoutServer = WithoutServer.GO_ON
    keep_views: bool = False
    sift: SiftSettings = field(default_factory=SiftSettings)
    landmarks: SelectionSettings = field(default_factory=SelectionSettings)
    filter: FilterSettings = field(default_factory=FilterSettings)
    tracking: TrackingSettings = field(default_factory=TrackingSettings)
    exploration: ExplorerSettings = field(default_factory=ExplorerSettings)
    navigation: NavigatorSettings = field(default_factory=NavigatorSettings)
    portals: PortalSettings = field(default_factory=PortalSettings)
    occupancy_grid: OccupancyGridSettings = field(default_factory=OccupancyGridSettings)

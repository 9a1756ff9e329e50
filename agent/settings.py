"""What a person sets of a robot's program: the part `[agent]` of a settings file."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated

from msgspec import Meta

from mapweave.registration.selection import SelectionSettings
from mapweave.vision.sift import SiftSettings

Positive = Annotated[float, Meta(gt=0.0)]
Count = Annotated[int, Meta(ge=1)]


@dataclass(frozen=True)
class TrackerSettings:
    """How image points are followed from frame to frame.

    Attributes:
        window_px: side of the patch that is matched, px.
        anchored: whether points are held to the patches in which they were first seen. What is tracked over
            one frame only gains nothing by it.
    """

    window_px: Annotated[int, Meta(ge=3, le=101)] = 11
    anchored: bool = True


@dataclass(frozen=True, slots=True)
class FilterSettings:
    """How the mapping filter and the localization filter weigh pixels and wheels.

    Attributes:
        pixel_sigma: standard deviation of a tracked pixel, px.
        adaptation: how much of an image's noise beyond `pixel_sigma` the mapping filter takes over at once: a
            floor that is not flat, shaking and blur make all pixels worse than any tracker knows.
        wheel_floor: standard deviation of a wheel's way in a step without any, m.
        slip_sigmas: wheels that an image refutes by more than so many sigmas have slipped.
        relinearisations: how often at most a step is linearised again in the light of its image.
        gate_probability: share of true measurements that each gate lets pass.
        widest_slope: landmarks further aside than this |a| are let go, or cannot be anchored at a node.
    """

    pixel_sigma: Positive = 0.7
    adaptation: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.1
    wheel_floor: Annotated[float, Meta(ge=0.0)] = 1e-5
    slip_sigmas: Positive = 4.5
    relinearisations: Annotated[int, Meta(ge=0)] = 3
    gate_probability: Annotated[float, Meta(gt=0.0, lt=1.0)] = 0.999
    widest_slope: Positive = 4.0


@dataclass(frozen=True)
class TrackingSettings:
    """How landmarks are kept up while a view is mapped.

    Attributes:
        filtered: landmarks in the mapping filter; further tracks are triangulated against its trajectory.
        refill: with fewer left than this, further tracks are taken into the filter: those that were chosen
            first may all be on the side that the robot turns away from.
        patience: images in a row that show other things than they should before the robot takes itself for
            carried off. A person who walks by is gone by then.
        blank_patience: the same for images that show nothing: the light was switched off.
    """

    filtered: Annotated[int, Meta(ge=4)] = 36
    refill: Annotated[int, Meta(ge=0)] = 18
    patience: Count = 30
    blank_patience: Count = 100


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
        looks: failed views in a row after which it is lost; in between it drives on by odometry.
        further: how far it drives on by odometry after a failed view, m: it is off by a few percent, and to
            turn back to what it knows, and about again, takes longer.
        parking_patience: time without getting nearer to the goal's pose after which it is blocked, s.
        blocked_first: how long it avoids an edge that was blocked for the first time, s: people walk on.
        blocked_longest: each further time it avoids it twice as long, up to this, s: walls stay.
        patience: a goal is given up when no further edge on the way was driven to for so long, s.
        make_room: whether a robot that has parked at its goal, or has explored all, makes room for another
            one in whose way it stands: it drives to a node off that way, and stays there.
    """

    speed: Positive = 0.26
    turn_rate: Positive = 0.6
    blind_distance: Positive = 2.0
    looks: Annotated[int, Meta(ge=0)] = 2
    further: Positive = 1.0
    parking_patience: Positive = 30.0
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
        tracker: of image points.
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
    tracker: TrackerSettings = field(default_factory=TrackerSettings)
    filter: FilterSettings = field(default_factory=FilterSettings)
    tracking: TrackingSettings = field(default_factory=TrackingSettings)
    exploration: ExplorerSettings = field(default_factory=ExplorerSettings)
    navigation: NavigatorSettings = field(default_factory=NavigatorSettings)
    portals: PortalSettings = field(default_factory=PortalSettings)
    occupancy_grid: OccupancyGridSettings = field(default_factory=OccupancyGridSettings)

"""Recording of a trial for scoring: ground truth and the messages of robots and server."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.scenarios.lying import Lies
from mapweave.sim.floorplan import BuildingPlan
from mapweave.storage.map_file import MapFile


@dataclass(frozen=True, eq=False)
class TrialTrajectory:
    """Poses over time.

    Attributes:
        stamps_ns: (N,), growing.
        poses: (N, 3) [x m, y m, heading rad].
    """

    stamps_ns: NDArray[np.int64]
    poses: Array


@dataclass(frozen=True)
class RecordedLocalization:
    """How a lost robot was localized.

    Attributes:
        stamp_ns: when.
        node: that it knows itself by.
        node_from_robot: where it is from there.
    """

    stamp_ns: int
    node: NodeId
    node_from_robot: Pose2


@dataclass
class Lost:
    """One robot that was carried away and, perhaps, sent somewhere.

    Attributes:
        robot: who.
        room: where it was put down.
        stamp_ns: when.
        world_from_robot: where exactly (truth).
        goal: node to which it shall go, if any.
        fix: the first after the kidnapping.
        arrived_ns: when it reported that it had arrived.
        legs: nodes of its route.
    """

    robot: str
    room: str
    stamp_ns: int
    world_from_robot: Pose2
    goal: NodeId | None = None
    fix: RecordedLocalization | None = None
    arrived_ns: int | None = None
    legs: int = 0


@dataclass(frozen=True, eq=False)
class RobotRecord:
    """One robot's share.

    Attributes:
        truth: `world_from_robot` at every tick.
        estimates: while mapping, `map_from_robot` of each of its maps (an agent that had to begin a new map
            has several), without the time in which it reported that it was lost.
        collisions: how often it ran into something.
        map_bytes: of changes as they went over the wire.
        wire_bytes: of everything that the agent sent or received over the fleet's network.
        unsaved: changes in its journal that the server does not have.
        map_hash: SHA-256 over the robot's own maps as they would be sent.
    """

    truth: TrialTrajectory
    estimates: Mapping[MapId, TrialTrajectory]
    collisions: int
    map_bytes: int
    wire_bytes: int
    unsaved: int
    map_hash: str


@dataclass(frozen=True)
class TrialEvent:
    """An event of a trial.

    Attributes:
        stamp_ns: when, simulated.
        text: one line.
        trouble: whether the scenario did not go as it was meant to.
    """

    stamp_ns: int
    text: str
    trouble: bool = False


@dataclass(frozen=True, eq=False)
class TrialRecording:
    """A whole trial.

    Attributes:
        scenario: its name.
        seed: of everything.
        robots: by name.
        plan: of the world as it was in the end.
        merged: the server's merged map in the end.
        lost: in order.
        moments: what the scenario did, and what was noticed, in order.
        recoveries_s: wall seconds from the return of a network, server or agent until all was well again.
        sim_s: simulated time.
        wall_s: how long that took.
        wall: s by part, where known.
        photographed: where photographs that are nodes were really taken: `world_from_robot`.
        lies: what came of the lies of a robot, if one has lied.
    """

    scenario: str
    seed: int
    robots: Mapping[str, RobotRecord]
    plan: BuildingPlan
    merged: MapFile
    lost: tuple[Lost, ...] = ()
    moments: tuple[TrialEvent, ...] = ()
    recoveries_s: tuple[float, ...] = ()
    sim_s: float = 0.0
    wall_s: float = 0.0
    wall: Mapping[str, float] = field(default_factory=dict)
    photographed: Mapping[NodeId, Pose2] = field(default_factory=dict)
    lies: Lies | None = None

"""What the bridge needs of a simulation, so that it can be tested without physics."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.observation import Command, Observation, RobotDescription
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.sim.events import SimEvent
from mapweave.sim.floorplan import BuildingPlan
from mapweave.sim.snapshot import Snapshot


class SimulatedWorld(Protocol):
    """Where a simulation takes place."""

    @property
    def plan(self) -> BuildingPlan:
        """The floor plan."""


class Simulated(Protocol):
    """What the bridge needs of a simulation."""

    @property
    def world(self) -> SimulatedWorld:
        """Where it takes place."""

    @property
    def robots(self) -> tuple[str, ...]:
        """Names."""

    @property
    def tick(self) -> int:
        """How many ticks are over."""

    @property
    def stamp_ns(self) -> int:
        """The simulation's time."""

    @property
    def seconds(self) -> Mapping[str, float]:
        """Wall time by part, s."""

    def describe(self, name: str) -> RobotDescription:
        """Camera, footprint, limits."""

    def advance(self, commands: Mapping[str, Command]) -> None:
        """One tick; robots without a command stand still."""

    def observe(self, name: str) -> Observation:
        """What a robot senses now, with its odometry since it was asked before."""

    def apply(self, event: SimEvent, /) -> str:
        """Execute an event between two ticks; returns one line for people."""

    def snapshot(self) -> Snapshot:
        """The view from above, and the robots' last images."""

    def kidnap(self, name: str, world_from_robot: Pose2, /) -> None:
        """Put a robot elsewhere."""

    def truth(self, name: str) -> Pose2:
        """`world_from_robot` now."""

    def truth_at(self, name: str, stamp_ns: int) -> Pose2:
        """`world_from_robot` at a time that is over."""

    def trajectory(self, name: str) -> tuple[NDArray[np.int64], Array]:
        """(N,) ns and (N, 3) `world_from_robot` of each tick."""

    def collisions(self, name: str) -> int:
        """Number of a robot's collisions."""

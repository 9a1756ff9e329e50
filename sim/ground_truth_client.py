"""Ground truth and intervention, for scoring a run: robots and servers never use it.

The questions that `mapweave.sim.ground_truth_service` answers, as methods.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.drivers.messages import AGAIN
from mapweave.hybridmap.errors import InvalidValue, NotConnected
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.sim.floorplan import FloorPlan, Rectangle
from mapweave.sim.keys import SimKeys
from mapweave.sim.snapshot import Snapshot
from mapweave.wire.bus import Bus
from mapweave.wire.packing import MAX_NUMBER, MAX_STAMP_NS, Reader, pack

MAX_BYTES = 64 * 2**20
MAX_RECTANGLES = 100_000
MAX_VALUES = 8 * MAX_RECTANGLES
MAX_ROBOTS = 1024
FARTHEST = 1e6
"""m, and the like for angles: larger numbers are no poses."""


@dataclass(frozen=True, slots=True)
class RobotStatus:
    """One robot, seen from above.

    Attributes:
        world_from_robot: true pose.
        collisions: their number.
        active: whether its agent takes part.
    """

    world_from_robot: Pose2
    collisions: int
    active: bool


@dataclass(frozen=True)
class SimStatus:
    """The simulation now.

    Attributes:
        tick: ticks that are over.
        stamp_ns: the simulation's time.
        robots: by name.
        wall: s of the wall's clock by part: `waiting` for agents, `replying`, `control`, and the parts of the
            simulation.
    """

    tick: int
    stamp_ns: int
    robots: dict[str, RobotStatus] = field(default_factory=dict)
    wall: dict[str, float] = field(default_factory=dict)


class SimControl:
    """Client of the ground truth service.

    Every method raises NotConnected if no simulator answers, InvalidValue if it refuses (with its reason),
    and InvalidMessage if its answer is broken.
    """

    def __init__(self, bus: Bus, fleet: str, timeout: float = 10.0) -> None:
        """Prepare the client.

        Args:
            bus: the connection.
            fleet: which fleet.
            timeout: how long to wait for an answer, s; it comes between two ticks.
        """
        self._bus = bus
        self._key = SimKeys(fleet).control()
        self._timeout = timeout

    def kidnap(self, robot: str, world_from_robot: Pose2) -> None:
        """Put a robot elsewhere."""
        self._ask("kidnap", robot=robot, pose=world_from_robot.vector.tolist())

    def status(self) -> SimStatus:
        """The simulation now."""
        reader = self._ask("status")
        wall = reader.table("wall", 64)
        robots = {}
        for name, value in reader.table("robots", MAX_ROBOTS).items():
            parts = reader.as_array(value, name, 5)
            if len(parts) != 5 or type(parts[4]) is not bool:
                raise reader.error(f"{name} must be [x, y, heading, collisions, active]")
            pose = Pose2(*(reader.as_number(number, name, -FARTHEST, FARTHEST) for number in parts[:3]))
            robots[name] = RobotStatus(pose, reader.as_integer(parts[3], name, 0, MAX_NUMBER), parts[4])
        return SimStatus(
            tick=reader.integer("tick", 0, MAX_NUMBER),
            stamp_ns=reader.integer("t", 0, MAX_STAMP_NS),
            robots=robots,
            wall={part: reader.as_number(seconds, part, 0.0, 1e12) for part, seconds in wall.items()},
        )

    def truth_at(self, robot: str, stamps_ns: Sequence[int]) -> list[Pose2]:
        """`world_from_robot` at times that are over."""
        reader = self._ask("truth_at", robot=robot, t=[int(stamp) for stamp in stamps_ns])
        return [Pose2.from_vector(row) for row in _read_poses(reader, len(stamps_ns))]

    def trajectory(self, robot: str) -> tuple[NDArray[np.int64], Array]:
        """(N,) ns and (N, 3) `world_from_robot` (m, m, rad) of each tick."""
        reader = self._ask("trajectory", robot=robot)
        data = reader.binary("t", MAX_BYTES)
        if len(data) % 8:
            raise reader.error(f"t has {len(data)} bytes, no multiple of 8")
        stamps = np.frombuffer(data, "<i8").astype(np.int64)
        return stamps, _read_poses(reader, len(stamps))

    def plan(self) -> FloorPlan:
        """The floor plan."""
        reader = self._ask("plan")
        rooms, walls, furniture = (
            tuple(_read_rectangle(reader, value) for value in reader.array(name, MAX_RECTANGLES))
            for name in ("rooms", "walls", "furniture")
        )
        return FloorPlan(rooms, walls, furniture)

    def apply(self, event: Mapping[str, object]) -> str:
        """Execute an event given as a scenario's table; returns what has happened, in words."""
        return self._ask("apply", event=dict(event)).text("said", 500)

    def advance(self, tick: int, patience: float) -> bool:
        """Let time pass until a tick is over and every robot has finished with it; then time stops.

        From the first call on time passes only so. Asking again for the same tick is no error.

        Args:
            tick: the one to reach.
            patience: how long to wait, s.

        Returns:
            Whether it was reached in time.
        """
        question = pack({"op": "advance", "tick": tick})
        replies = self._bus.ask(self._key, question, patience)
        if replies and replies[0].error and AGAIN not in replies[0].error:
            raise InvalidValue(f"the simulator refuses advance: {replies[0].error}")
        return any(not reply.error for reply in replies)

    def snapshot(self) -> Snapshot:
        """The view from above, and the robots' last images."""
        reader = self._ask("snapshot")
        actors, furniture = (
            tuple(_read_rectangle(reader, value) for value in reader.array(name, MAX_RECTANGLES))
            for name in ("actors", "furniture")
        )
        poses = {
            name: Pose2(*_numbers(reader, name, value, 3))
            for name, value in reader.table("robots", MAX_ROBOTS).items()
        }
        images = {
            name: _read_image(reader, value) for name, value in reader.table("images", MAX_ROBOTS).items()
        }
        return Snapshot(
            tick=reader.integer("tick", 0, MAX_NUMBER),
            stamp_ns=reader.integer("t", 0, MAX_STAMP_NS),
            robots=poses,
            actors=actors,
            furniture=furniture,
            images={name: images.get(name) for name in poses},
        )

    def stop(self) -> None:
        """End the simulation and notify its agents."""
        self._ask("stop")

    def _ask(self, operation: str, **fields: object) -> Reader:
        replies = self._bus.ask(self._key, pack({"op": operation, **fields}), self._timeout)
        if not replies:
            raise NotConnected(f"{self._key}: no answer; start the simulator with: mapweave sim serve")
        if replies[0].error:
            raise InvalidValue(f"the simulator refuses {operation}: {replies[0].error}")
        return Reader(replies[0].payload, f"answer to {operation}", MAX_BYTES, MAX_VALUES)


def _read_rectangle(reader: Reader, value: object) -> Rectangle:
    parts = reader.as_array(value, "rectangle", 6)
    if len(parts) != 6:
        raise reader.error("rectangle must be [x, y, length, width, heading, name]")
    x, y, length, width, heading = (
        reader.as_number(number, "rectangle", -FARTHEST, FARTHEST) for number in parts[:5]
    )
    return Rectangle(x, y, length, width, heading, reader.as_text(parts[5], "rectangle's name", 256))


def _read_poses(reader: Reader, count: int) -> Array:
    data = reader.binary("p", MAX_BYTES)
    if len(data) != 24 * count:
        raise reader.error(f"p has {len(data)} bytes instead of {24 * count}")
    poses = np.frombuffer(data, "<f8").astype(np.float64).reshape(count, 3)
    if not np.isfinite(poses).all():
        raise reader.error("p holds numbers that are not finite")
    return poses


def _numbers(reader: Reader, name: str, value: object, count: int) -> list[float]:
    parts = reader.as_array(value, name, count)
    if len(parts) != count:
        raise reader.error(f"{name} must be {count} numbers")
    return [reader.as_number(number, name, -FARTHEST, FARTHEST) for number in parts]


def _read_image(reader: Reader, value: object) -> NDArray[np.uint8]:
    height, width, data = (*reader.as_array(value, "image", 3), 0, 0, 0)[:3]
    rows, columns = (reader.as_integer(side, "image", 1, 1 << 14) for side in (height, width))
    pixels = reader.as_binary(data, "image", MAX_BYTES)
    if len(pixels) != rows * columns:
        raise reader.error(f"an image of {columns}x{rows} px cannot have {len(pixels)} bytes")
    return np.frombuffer(pixels, np.uint8).reshape(rows, columns)

"""Truth and intervention, for whoever scores a run: robots and servers never ask here.

One question on the key `sim/control`, a MessagePack map with the operation's name in `op`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hybridmap.errors import InvalidValue, NotConnected
from hybridmap.pose import Array, Pose2
from sim.floorplan import FloorPlan, Rectangle
from sim.simulated import Simulated
from wire.bus import Bus
from wire.keys import Keys
from wire.packing import MAX_NUMBER, MAX_STAMP_NS, Reader, pack

MAX_BYTES = 64 * 2**20
MAX_STAMPS = 100_000
MAX_RECTANGLES = 100_000
MAX_ROBOTS = 1024
FARTHEST = 1e6
"""m, and the like for angles: larger numbers are no postures."""


@dataclass(frozen=True, slots=True)
class RobotStatus:
    """One robot, seen from above.

    Attributes:
        world_from_robot: true posture.
        collisions: how often it has hit something.
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


class ControlDesk:
    """Answers control questions. Call it between ticks only."""

    def __init__(
        self,
        simulation: Simulated,
        active: Callable[[], set[str]],
        wall: Mapping[str, float],
        stop: Callable[[], None],
    ) -> None:
        """Put the desk in front of a simulation.

        Args:
            simulation: whose truth is told.
            active: names of the robots that take part now.
            wall: s by part beside the simulation's own, kept by the caller.
            stop: ends the run.
        """
        self._simulation = simulation
        self._active = active
        self._wall = wall
        self._stop = stop
        self._operations: dict[str, Callable[[Reader], dict[str, object]]] = {
            "kidnap": self._kidnap,
            "status": self._status,
            "truth_at": self._truth_at,
            "trajectory": self._trajectory,
            "plan": self._plan,
            "stop": self._end,
        }

    def answer(self, question: bytes) -> bytes:
        """Do what is asked.

        Raises:
            MapweaveError: the question is broken, or the simulation refuses.
        """
        reader = Reader(question, "control", MAX_BYTES)
        operation = reader.text("op", 32)
        if operation not in self._operations:
            raise reader.error(f"no operation {operation!r}; there are {', '.join(self._operations)}")
        return pack(self._operations[operation](reader))

    def _robot(self, reader: Reader) -> str:
        name = reader.name("robot")
        if name not in self._simulation.robots:
            raise InvalidValue(f"no robot {name!r}; there are {', '.join(self._simulation.robots)}")
        return name

    def _kidnap(self, reader: Reader) -> dict[str, object]:
        values = reader.array("pose", 3)
        if len(values) != 3:
            raise reader.error("pose must be [x, y, heading]")
        numbers = [reader.as_number(value, "pose", -FARTHEST, FARTHEST) for value in values]
        self._simulation.kidnap(self._robot(reader), Pose2(*numbers))
        return {}

    def _status(self, reader: Reader) -> dict[str, object]:
        simulation, active = self._simulation, self._active()
        robots = {
            name: [
                *simulation.truth(name).vector.tolist(),
                simulation.collisions(name),
                name in active,
            ]
            for name in simulation.robots
        }
        return {
            "tick": simulation.tick,
            "t": simulation.stamp_ns,
            "robots": robots,
            "wall": {**simulation.seconds, **self._wall},
        }

    def _truth_at(self, reader: Reader) -> dict[str, object]:
        name = self._robot(reader)
        stamps = [reader.as_integer(s, "t", 0, MAX_STAMP_NS) for s in reader.array("t", MAX_STAMPS)]
        poses = [self._simulation.truth_at(name, stamp).vector for stamp in stamps]
        return {"p": np.array(poses, "<f8").tobytes()}

    def _trajectory(self, reader: Reader) -> dict[str, object]:
        stamps, poses = self._simulation.trajectory(self._robot(reader))
        return {"t": stamps.astype("<i8").tobytes(), "p": poses.astype("<f8").tobytes()}

    def _plan(self, reader: Reader) -> dict[str, object]:
        plan = self._simulation.world.plan
        return {
            "rooms": list(map(_pack_rectangle, plan.rooms)),
            "walls": list(map(_pack_rectangle, plan.walls)),
            "furniture": list(map(_pack_rectangle, plan.furniture)),
        }

    def _end(self, reader: Reader) -> dict[str, object]:
        self._stop()
        return {}


class SimControl:
    """Asks the simulator.

    Every method raises NotConnected if no simulator answers, InvalidValue if it refuses (with its reason),
    and InvalidMessage if its answer is broken.
    """

    def __init__(self, bus: Bus, fleet: str, timeout: float = 10.0) -> None:
        """Nothing is asked yet.

        Args:
            bus: the connection.
            fleet: which fleet.
            timeout: how long to wait for an answer, s; it comes between two ticks.
        """
        self._bus = bus
        self._key = Keys(fleet).sim_control()
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
        """What stands where."""
        reader = self._ask("plan")
        rooms, walls, furniture = (
            tuple(_read_rectangle(reader, value) for value in reader.array(name, MAX_RECTANGLES))
            for name in ("rooms", "walls", "furniture")
        )
        return FloorPlan(rooms, walls, furniture)

    def stop(self) -> None:
        """End the simulation; its agents are told."""
        self._ask("stop")

    def _ask(self, operation: str, **fields: object) -> Reader:
        replies = self._bus.ask(self._key, pack({"op": operation, **fields}), self._timeout)
        if not replies:
            raise NotConnected(f"{self._key}: nobody answers; start the simulator with: mapweave sim")
        if replies[0].error:
            raise InvalidValue(f"the simulator refuses {operation}: {replies[0].error}")
        return Reader(replies[0].payload, f"answer to {operation}", MAX_BYTES)


def _pack_rectangle(box: Rectangle) -> list[object]:
    return [float(n) for n in (box.x, box.y, box.length, box.width, box.heading)] + [box.name]


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

"""Ground truth and intervention, for scoring a run. Robots and servers never use it.

One question on the key `sim/ground_truth_client`, a MessagePack map with the operation in `op`;
`mapweave.sim.ground_truth_client` asks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Pose2
from mapweave.sim.events import parse_event
from mapweave.sim.floorplan import Rectangle
from mapweave.sim.simulation_interface import Simulated
from mapweave.wire.packing import MAX_NUMBER, MAX_STAMP_NS, Reader, pack

MAX_BYTES = 1 << 20
MAX_STAMPS = 100_000
MAX_FIELDS = 64
FARTHEST = 1e6
"""m, and the like for angles: larger numbers are no poses."""


class GroundTruthService:
    """Answers control questions. Call it between ticks only."""

    def __init__(
        self,
        simulation: Simulated,
        active: Callable[[], set[str]],
        wall: Mapping[str, float],
        stop: Callable[[], None],
    ) -> None:
        """Serve the ground truth of a simulation.

        Args:
            simulation: whose truth is served.
            active: names of the robots that take part now.
            wall: s by part, in addition to the simulation's own, kept by the caller.
            stop: ends the run.
        """
        self._simulation = simulation
        self._active = active
        self._wall = wall
        self._stop = stop
        self._operations: dict[str, Callable[[Reader], dict[str, object]]] = {
            "kidnap": self._kidnap,
            "apply": self._apply,
            "snapshot": self._snapshot,
            "status": self._status,
            "truth_at": self._truth_at,
            "trajectory": self._trajectory,
            "plan": self._plan,
            "stop": self._end,
        }

    def answer(self, question: bytes) -> bytes:
        """Answer a question.

        Raises:
            MapweaveError: the question is broken, or the simulation refuses.
        """
        reader = Reader(question, "control", MAX_BYTES, MAX_BYTES)
        operation = reader.text("op", 32)
        if operation not in self._operations:
            raise reader.error(f"no operation {operation!r}; there are {', '.join(self._operations)}")
        return pack(self._operations[operation](reader))

    def advances_to(self, question: bytes) -> int | None:
        """The tick to which the simulation shall go, if that is the question; its answer comes then.

        Raises:
            MapweaveError: the question is broken.
        """
        reader = Reader(question, "control", MAX_BYTES, MAX_BYTES)
        return reader.integer("tick", 0, MAX_NUMBER) if reader.text("op", 32) == "advance" else None

    def reached(self) -> bytes:
        """The answer when the simulation has got there and every robot has finished the tick."""
        return pack({"tick": self._simulation.tick})

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

    def _apply(self, reader: Reader) -> dict[str, object]:
        return {"said": self._simulation.apply(parse_event(reader.table("event", MAX_FIELDS)))}

    def _snapshot(self, reader: Reader) -> dict[str, object]:
        shot = self._simulation.snapshot()
        return {
            "tick": shot.tick,
            "t": shot.stamp_ns,
            "robots": {name: pose.vector.tolist() for name, pose in shot.robots.items()},
            "actors": list(map(_pack_rectangle, shot.actors)),
            "furniture": list(map(_pack_rectangle, shot.furniture)),
            "images": {
                name: [*image.shape, image.tobytes()]
                for name, image in shot.images.items()
                if image is not None
            },
        }

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


def _pack_rectangle(box: Rectangle) -> list[object]:
    return [float(n) for n in (box.x, box.y, box.length, box.width, box.heading)] + [box.name]

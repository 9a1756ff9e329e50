"""Ground truth and intervention, for scoring a run: robots and servers never use it.

The questions of `mapweave.sim.ground_truth_messages`, as methods.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.drivers.messages import AGAIN
from mapweave.hybridmap.errors import InvalidMessage, InvalidValue, NotConnected
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.sim.floorplan import BuildingPlan
from mapweave.sim.ground_truth_messages import (
    ANSWER,
    Advance,
    Apply,
    AskPlan,
    AskSnapshot,
    AskStatus,
    AskTrajectory,
    AskTruth,
    Done,
    KidnapRequest,
    Question,
    SimStatus,
    TrueTrajectory,
)
from mapweave.sim.keys import SimKeys
from mapweave.sim.snapshot import Snapshot
from mapweave.wire.bus import Bus
from mapweave.wire.packing import pack
from mapweave.wire.typed import decode, packed

Answer = TypeVar("Answer")


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
        pose = world_from_robot
        self._ask(KidnapRequest(robot, (pose.x, pose.y, pose.heading)), Done)

    def status(self) -> SimStatus:
        """The simulation now."""
        return self._ask(AskStatus(), SimStatus)

    def truth_at(self, robot: str, stamps_ns: Sequence[int]) -> list[Pose2]:
        """`world_from_robot` at times that are over."""
        stamps = [int(stamp) for stamp in stamps_ns]
        truth = self._ask(AskTruth(robot, stamps), TrueTrajectory)
        if truth.stamps_ns.tolist() != stamps:
            raise InvalidMessage(f"{len(truth.stamps_ns)} poses are no answer for {len(stamps)} times")
        return [Pose2.from_vector(row) for row in truth.world_from_robot]

    def truth_of(self, nodes: Iterable[Node]) -> dict[NodeId, Pose2]:
        """`world_from_robot` when each node's image was taken, by the robot that made the node."""
        by_robot: dict[str, list[Node]] = {}
        for node in nodes:
            by_robot.setdefault(node.id.agent, []).append(node)
        truth: dict[NodeId, Pose2] = {}
        for robot, own in by_robot.items():
            poses = self.truth_at(robot, [node.stamp_ns for node in own])
            truth.update(zip((node.id for node in own), poses, strict=True))
        return truth

    def trajectory(self, robot: str) -> tuple[NDArray[np.int64], Array]:
        """(N,) ns and (N, 3) `world_from_robot` (m, m, rad) of each tick."""
        driven = self._ask(AskTrajectory(robot), TrueTrajectory)
        return driven.stamps_ns, driven.world_from_robot

    def plan(self) -> BuildingPlan:
        """The floor plan."""
        return self._ask(AskPlan(), BuildingPlan)

    def apply(self, event: Mapping[str, object]) -> str:
        """Execute an event given as a scenario's table; returns what has happened, in words."""
        return self._ask(Apply(dict(event)), Done).said

    def advance(self, tick: int, patience: float) -> bool:
        """Let time pass until a tick is over and every robot has finished with it; then time stops.

        From the first call on time passes only so. Asking again for the same tick is no error.

        Args:
            tick: the one to reach.
            patience: how long to wait, s.

        Returns:
            Whether it was reached in time.
        """
        replies = self._bus.ask(self._key, pack(packed(Advance(tick))), patience)
        if replies and replies[0].error and AGAIN not in replies[0].error:
            raise InvalidValue(f"the simulator refuses advance: {replies[0].error}")
        return any(not reply.error for reply in replies)

    def snapshot(self) -> Snapshot:
        """What a bird sees, and what the robots saw last."""
        return self._ask(AskSnapshot(), Snapshot)

    def _ask(self, question: Question, answer: type[Answer]) -> Answer:
        fields: dict[str, Any] = packed(question)
        replies = self._bus.ask(self._key, pack(fields), self._timeout)
        if not replies:
            raise NotConnected(f"{self._key}: no answer; start the simulator with: mapweave sim serve")
        if replies[0].error:
            raise InvalidValue(f"the simulator refuses {fields['op']}: {replies[0].error}")
        return decode(replies[0].payload, answer, ANSWER)

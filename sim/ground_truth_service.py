"""Ground truth and intervention, for scoring a run. Robots and servers never use it.

The questions are those of `mapweave.sim.ground_truth_messages`; `mapweave.sim.ground_truth_client` asks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Pose2
from mapweave.sim.events import parse_event
from mapweave.sim.ground_truth_messages import (
    ANSWER,
    QUESTION,
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
    RobotStatus,
    SimStatus,
    TrueTrajectory,
)
from mapweave.wire.packing import unpack
from mapweave.wire.typed import encode

if TYPE_CHECKING:
    from mapweave.sim.simulation import Simulation


class GroundTruthService:
    """Answers control questions. Call it between ticks only."""

    def __init__(
        self,
        simulation: Simulation,
        active: Callable[[], set[str]],
        wall: Mapping[str, float],
    ) -> None:
        """Serve the ground truth of a simulation.

        Args:
            simulation: whose truth is served.
            active: names of the robots that take part now.
            wall: s by part, in addition to the simulation's own, kept by the caller.
        """
        self._simulation = simulation
        self._active = active
        self._wall = wall

    def answer(self, question: bytes) -> bytes:
        """Answer a question.

        Raises:
            MapweaveError: the question is broken, or the simulation refuses.
        """
        return encode(self._answer(unpack(question, Question, QUESTION)), ANSWER)

    def advances_to(self, question: bytes) -> int | None:
        """The tick to which the simulation shall go, if that is the question; its answer comes then.

        Raises:
            MapweaveError: the question is broken.
        """
        asked = unpack(question, Question, QUESTION)
        return asked.tick if isinstance(asked, Advance) else None

    def reached(self) -> bytes:
        """The answer when the simulation has got there and every robot has finished the tick."""
        return encode(Done(), ANSWER)

    def _answer(self, question: Question) -> Any:
        simulation = self._simulation
        match question:
            case KidnapRequest():
                simulation.kidnap(self._robot(question.robot), Pose2(*question.world_from_robot))
            case Apply():
                return Done(simulation.apply(parse_event(question.event)))
            case AskSnapshot():
                return simulation.snapshot()
            case AskStatus():
                return self._status()
            case AskTruth():
                name = self._robot(question.robot)
                poses = [simulation.truth_at(name, stamp).vector for stamp in question.stamps_ns]
                return TrueTrajectory(np.array(question.stamps_ns, np.int64), np.array(poses).reshape(-1, 3))
            case AskTrajectory():
                return TrueTrajectory(*simulation.trajectory(self._robot(question.robot)))
            case AskPlan():
                return simulation.world.plan
        return Done()

    def _robot(self, name: str) -> str:
        if name not in self._simulation.robots:
            raise InvalidValue(f"no robot {name!r}; there are {', '.join(self._simulation.robots)}")
        return name

    def _status(self) -> SimStatus:
        simulation, active = self._simulation, self._active()
        robots = {
            name: RobotStatus(simulation.truth(name), simulation.collisions(name), name in active)
            for name in simulation.robots
        }
        wall = {**simulation.seconds, **self._wall}
        return SimStatus(simulation.tick, simulation.stamp_ns, robots, wall)

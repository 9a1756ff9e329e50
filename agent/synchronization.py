"""What a robot's loop waits for between ticks: nothing on a robot, everything in a repeatable simulation."""

import logging
from collections.abc import Callable
from typing import Protocol

from mapweave.agent.fleet_client import FleetClient
from mapweave.agent.mission import ServerAnswer
from mapweave.agent.replication.replicator import Replicator

log = logging.getLogger(__name__)

ANSWER_TIMEOUT = 3.0
"""How long a robot waits for an answer of the fleet, s."""
LOCKSTEP_PATIENCE = 30.0
"""How long a tick in lock-step waits for the disk, for a server in reach and for answers, s."""


class Synchronization(Protocol):
    """Ties the robot's loop to its disk and its fleet. The composition root chooses one.

    Attributes:
        answer_timeout: after which a question counts as unanswered, s.
    """

    @property
    def answer_timeout(self) -> float:
        """After which a question counts as unanswered, s."""

    def changes_submitted(self, replicator: Replicator, fleet: FleetClient) -> None:
        """Called when a tick has handed over changes of the map."""

    def before_questions(self) -> None:
        """Called before questions are sent."""

    def answers(self, fleet: FleetClient) -> tuple[ServerAnswer, ...]:
        """Answers to the questions that were just sent, as far as the loop waits for them."""


class FreeRunning:
    """A real robot: its loop waits for nothing."""

    answer_timeout = ANSWER_TIMEOUT

    def changes_submitted(self, replicator: Replicator, fleet: FleetClient) -> None:
        """Nothing: the replicator works beside the loop."""

    def before_questions(self) -> None:
        """Nothing."""

    def answers(self, fleet: FleetClient) -> tuple[ServerAnswer, ...]:
        """None: they come with a later tick."""
        return ()


class LockstepWaiting:
    """Simulated time stops until disk, server and answers are done, however slow the machine is."""

    answer_timeout = LOCKSTEP_PATIENCE

    def __init__(self, rendezvous: Callable[[], None] = lambda: None) -> None:
        """Wait, where several processes share the simulation, for the other robots.

        Args:
            rendezvous: returns when all robots have finished the tick.
        """
        self._rendezvous = rendezvous

    def changes_submitted(self, replicator: Replicator, fleet: FleetClient) -> None:
        """Wait until the robot's disk, and a server that is in reach, have the changes."""
        saved = replicator.flush(LOCKSTEP_PATIENCE)
        if saved and fleet.server_in_reach():
            saved = replicator.wait_acknowledged(LOCKSTEP_PATIENCE)
            # A network failure in between is part of the scenario and is not reported.
            saved = saved or not fleet.server_in_reach()
        if not saved:
            log.warning(
                "what was mapped was not saved within %g s: this run may not repeat itself", LOCKSTEP_PATIENCE
            )

    def before_questions(self) -> None:
        """Wait until every other robot has finished the tick: the server then has all that it will have."""
        self._rendezvous()

    def answers(self, fleet: FleetClient) -> tuple[ServerAnswer, ...]:
        """Wait for every answer."""
        return fleet.answers(wait=True)

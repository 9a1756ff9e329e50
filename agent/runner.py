"""The robot's loop: sense, plan, act. Connects the driver, the pipeline and the fleet."""

import logging
import math
import threading
import time
from collections.abc import Callable
from dataclasses import replace

from mapweave.agent.drivers.robot import Robot
from mapweave.agent.fleet_client import FleetClient
from mapweave.agent.mapping_monitor import MappingMonitor
from mapweave.agent.mission import Question, ServerAnswer
from mapweave.agent.mission_control import MissionControl
from mapweave.agent.observation import Observation
from mapweave.agent.pipeline import Pipeline, TickResult
from mapweave.agent.replication.replicator import Replicator
from mapweave.agent.synchronization import FreeRunning, Synchronization

log = logging.getLogger(__name__)

REPORT_EVERY = 5
"""Ticks between two status reports, unless servers want fewer."""


class Runner:
    """Runs one robot until its driver ends, it is stopped, or it must begin a new map.

    A robot's driver gives its newest image. Images that come while a tick takes too long are skipped, so that
    the robot never acts on old ones.

    Attributes:
        skipped: images that were skipped so far.
        busy: how long the tick before took, s; 0 before the second.
        why_no_node: why the last tick gave no node, in words, as far as it is known.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        fleet: FleetClient,
        replicator: Replicator,
        missions: MissionControl,
        monitor: MappingMonitor,
        synchronization: Synchronization | None = None,
        on_step: Callable[[Observation, TickResult], None] = lambda observation, step: None,
        print_line: Callable[[str], None] = lambda line: None,
        clock: Callable[[], float] = time.monotonic,
        recorded: bool = False,
    ) -> None:
        """Put the parts together.

        Args:
            pipeline: decides what the robot does.
            fleet: questions and status.
            replicator: where changes go: to the own disk, then to the server.
            missions: what the pipeline shall do.
            monitor: says why there are no nodes.
            synchronization: what the loop waits for; nothing if not given.
            on_step: called after each tick, for progress.
            print_line: takes lines for people.
            clock: s, only grows.
            recorded: whether the driver is a recording, which waits for the loop: it skips nothing.
        """
        self.skipped, self.busy = 0, 0.0
        self._monitor = monitor
        self._print = print_line
        self._clock, self._recorded = clock, recorded
        self._previous: tuple[int, float] | None = None
        self._waits_since: float | None = None
        self._faulty = ""
        self._pipeline = pipeline
        self._fleet = fleet
        self._replicator = replicator
        self._missions = missions
        self._synchronization = synchronization or FreeRunning()
        self._on_step = on_step
        self._questions: tuple[Question, ...] = ()
        self._answers: tuple[ServerAnswer, ...] = ()
        self._ticks, self._reported = 0, -math.inf
        self.why_no_node = ""

    def tick(self, observation: Observation) -> TickResult:
        """Take one observation; changes and status go their way, questions wait for `exchange`."""
        step = self._think(observation)
        self._hand_over(observation, step)
        return step

    def _think(self, observation: Observation) -> TickResult:
        home = min(self._pipeline.map.nodes, default=None)
        mission = self._missions.next(self._fleet.server_in_reach(), observation.stamp_ns * 1e-9, home)
        if mission is not None:
            self._pipeline.set_mission(mission)
        if self._missions.taken_through():
            self._pipeline.taken_through()
        answers, self._answers = (*self._answers, *self._fleet.answers()), ()
        step = self._pipeline.step(observation, answers, self._fleet.driven())
        self._questions = step.questions
        return step

    def _hand_over(self, observation: Observation, step: TickResult) -> None:
        """Changes come before the status: one that counts a node also counts that it is not sent yet."""
        if step.changes:
            self._replicator.submit(step.changes, observation.stamp_ns)
            self._synchronization.changes_submitted(self._replicator, self._fleet)
        self._report_fault(step)
        line = self._monitor.see(observation, step.status, step.command)
        self.why_no_node = self._monitor.reason(step.status)
        if line:
            self._print(line)
        changed = self._missions.follow(step.status)
        now = self._ticks % REPORT_EVERY == 0 and self._due()
        now = now or bool(step.questions) or changed
        self._reported = self._clock() if now else self._reported
        step = replace(step, status=self._missions.explained(step.status))
        status = self._monitor.explained(step.status)
        self._fleet.report(
            status, observation.stamp_ns, observation.battery, now, self.skipped, observation.silent
        )
        self._ticks += 1
        self._on_step(observation, step)

    def _due(self) -> bool:
        """Whether servers want a status again of which nothing new is known."""
        return self._clock() - self._reported >= self._replicator.status_period

    def _report_fault(self, step: TickResult) -> None:
        """One line when a sensor fails, and one when it is back."""
        faulty = "" if step.fault is None else step.fault.sensor
        if faulty == self._faulty:
            return
        self._faulty, before = faulty, self._faulty
        self._print(step.fault.words if step.fault is not None else f"believes its {before} again")

    @property
    def has_questions(self) -> bool:
        """Whether the last tick had questions."""
        return bool(self._questions)

    def exchange(self) -> None:
        """Ask what the last tick wanted to know."""
        self._synchronization.before_questions()
        for question in self._questions:
            self._fleet.ask(question)
        self._questions = ()
        self._answers = self._synchronization.answers(self._fleet)

    def run(self, robot: Robot, stop: threading.Event) -> int:
        """Loop until there are no more observations, `stop` is set or the pipeline requests a new map.

        Returns:
            How many ticks were run.
        """
        first, tick = self._ticks, robot.describe().tick
        while not (stop.is_set() or self._pipeline.lost):
            self._waits_since = self._clock()
            try:
                observation = robot.sense()
            finally:
                self._waits_since = None
            if observation is None:
                break
            observation = _kept(observation)
            self._count_skipped(observation.stamp_ns, tick)
            began = self._clock()
            step = self._think(observation)
            robot.act(step.command)
            self._hand_over(observation, step)
            if self.has_questions:
                self.exchange()
            self.busy = self._clock() - began
            self._previous = observation.stamp_ns, self.busy
        return self._ticks - first

    @property
    def waiting(self) -> float:
        """How long the loop has waited for an observation, s; 0 while it works on one. From any thread."""
        since = self._waits_since
        return 0.0 if since is None else self._clock() - since

    def _count_skipped(self, stamp_ns: int, tick: float) -> None:
        """Count the images that came while the tick before took too long.

        Images that a recording lacks, or that a camera has dropped, came while the loop was waiting.
        """
        if self._previous is None or self._recorded:
            return
        before_ns, busy = self._previous
        missed = min(round((stamp_ns - before_ns) * 1e-9 / tick) - 1, int(busy / tick))
        if busy <= tick or missed <= 0:
            return
        self.skipped += missed
        # Reported less and less often: 1, 2, 4, 8 ...
        if self.skipped.bit_length() > (self.skipped - missed).bit_length():
            log.warning(
                "a tick took %.0f ms instead of %.0f: %d images skipped so far",
                1e3 * busy, 1e3 * tick, self.skipped,
            )  # fmt: skip


def _kept(observation: Observation) -> Observation:
    """An observation of plain values that stays as it is: a driver may write its next image over the last."""
    image = None if observation.image is None else observation.image.copy()
    return replace(observation, stamp_ns=int(observation.stamp_ns), image=image)

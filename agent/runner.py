"""The robot's loop: sense, plan, act. Connects the driver, the pipeline and the fleet."""

from __future__ import annotations

import threading
from collections.abc import Callable

from mapweave.agent.drivers.robot import Robot
from mapweave.agent.fleet_client import FleetClient
from mapweave.agent.mission import Answer, Question
from mapweave.agent.mission_control import MissionControl
from mapweave.agent.observation import Observation
from mapweave.agent.pipeline import Pipeline, Step
from mapweave.agent.replication.replicator import Replicator
from mapweave.agent.synchronization import FreeRunning, Synchronization

REPORT_EVERY = 5
"""Ticks between two status reports."""


class Runner:
    """Runs one robot until its driver ends, it is stopped, or it must begin a new map."""

    def __init__(
        self,
        pipeline: Pipeline,
        fleet: FleetClient,
        replicator: Replicator,
        missions: MissionControl,
        synchronization: Synchronization | None = None,
        on_step: Callable[[Observation, Step], None] = lambda observation, step: None,
    ) -> None:
        """Put the parts together.

        Args:
            pipeline: the mind.
            fleet: questions and status.
            replicator: where changes go: to the own disk, then to the server.
            missions: what the pipeline shall do.
            synchronization: what the loop waits for; nothing if not given.
            on_step: called after each tick, for progress.
        """
        self._pipeline = pipeline
        self._fleet = fleet
        self._replicator = replicator
        self._missions = missions
        self._synchronization = synchronization or FreeRunning()
        self._on_step = on_step
        self._questions: tuple[Question, ...] = ()
        self._answers: tuple[Answer, ...] = ()
        self._ticks = 0

    def tick(self, observation: Observation) -> Step:
        """Take one observation; changes and status go their way, questions wait for `exchange`."""
        home = min(self._pipeline.map.nodes, default=None)
        mission = self._missions.next(self._fleet.server_in_reach(), observation.stamp_ns * 1e-9, home)
        if mission is not None:
            self._pipeline.set_mission(mission)
        answers, self._answers = (*self._answers, *self._fleet.answers()), ()
        step = self._pipeline.step(observation, answers, self._fleet.driven())
        if step.changes:
            self._replicator.submit(step.changes, observation.stamp_ns)
            self._synchronization.changes_submitted(self._replicator, self._fleet)
        self._questions = step.questions
        changed = self._missions.follow(step.status)
        now = self._ticks % REPORT_EVERY == 0 or bool(step.questions) or changed
        self._fleet.report(step.status, observation.stamp_ns, observation.battery, publish=now)
        self._ticks += 1
        self._on_step(observation, step)
        return step

    @property
    def curious(self) -> bool:
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
        first = self._ticks
        while not (stop.is_set() or self._pipeline.lost):
            observation = robot.sense()
            if observation is None:
                break
            robot.act(self.tick(observation).command)
            if self.curious:
                self.exchange()
        return self._ticks - first

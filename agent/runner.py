"""The robot's loop: sense, think, act. The only place where body, mind and fleet meet."""

from __future__ import annotations

import threading
from collections.abc import Callable

from agent.drivers.robot import Robot
from agent.fleet import FleetLink
from agent.pipeline import Pipeline, Step
from agent.replication import Replicator

REPORT_EVERY = 5
"""Ticks between two status reports."""


class Runner:
    """Runs one robot until its body ends, or it is told to stop."""

    def __init__(
        self,
        robot: Robot,
        pipeline: Pipeline,
        fleet: FleetLink,
        replicator: Replicator,
        lockstep: bool = False,
        on_step: Callable[[Step], None] = lambda step: None,
    ) -> None:
        """Put the parts together.

        Args:
            robot: the body.
            pipeline: the mind.
            fleet: questions, missions, status.
            replicator: where changes go: to the own disk, then to the server.
            lockstep: wait for answers before the next tick (simulation only).
            on_step: called after each tick, for progress.
        """
        self._robot = robot
        self._pipeline = pipeline
        self._fleet = fleet
        self._replicator = replicator
        self._lockstep = lockstep
        self._on_step = on_step

    def run(self, stop: threading.Event) -> int:
        """Loop until the body has no more observations or `stop` is set.

        Returns:
            How many ticks were run.
        """
        ticks = 0
        while not stop.is_set():
            observation = self._robot.sense()
            if observation is None:
                break
            for mission in self._fleet.missions():
                self._pipeline.set_mission(mission)
            step = self._pipeline.step(observation, self._fleet.answers(wait=self._lockstep))
            self._robot.act(step.command)
            if step.changes:
                self._replicator.submit(step.changes, observation.stamp_ns)
            for question in step.questions:
                self._fleet.ask(question)
            if ticks % REPORT_EVERY == 0 or step.questions:
                self._fleet.report(step.status, observation.stamp_ns)
            self._on_step(step)
            ticks += 1
        return ticks

"""An agent as a process: it runs until its robot ends, says what it does, and hands its map over."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import cv2

from mapweave.agent.drivers.robot import Robot
from mapweave.agent.observation import Observation, RobotDescription
from mapweave.agent.pipeline import TickResult
from mapweave.agent.settings import AgentSettings
from mapweave.extras import need
from mapweave.hybridmap.counted import counted
from mapweave.hybridmap.errors import InvalidFile
from mapweave.processes.agent import Agent, AgentOptions
from mapweave.processes.agent_progress import AgentProgress
from mapweave.processes.ros2_publisher import Ros2Publisher
from mapweave.processes.service_manager import ServiceManager
from mapweave.storage.os_errors import DISK_FULL, NO_ROOM
from mapweave.terminal import EventLog, plain_or_terminal
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus
from mapweave.wire.zenoh_bus import ZenohBus

if TYPE_CHECKING:
    from mapweave.processes.agent_metrics import AgentMetrics
    from mapweave.processes.tick_log import TickLog

SILENCE = 2.0
"""s; a longer wait for the robot is reported."""

ARRIVAL = 2.0
"""s that an agent at its end waits for a map server to come in reach: a session takes a moment to find it."""


def run_agent(
    robot: Robot,
    bus: ZenohBus | MemoryBus,
    keys: Keys,
    settings: AgentSettings,
    options: AgentOptions,
    stop: threading.Event,
) -> None:
    """Run a robot until its driver ends or `stop` is set, then write its map file.

    Raises:
        MapweaveError: the driver cannot be read, or the disk cannot be written; one line gives the reason.
    """
    # One core a robot: OpenCV's own threads would only fight over it.
    cv2.setNumThreads(1)
    console = plain_or_terminal()
    say = EventLog(console)
    show, manager = AgentProgress(console, options.name, options.total), ServiceManager()
    describe = partial(_describe, robot, say, options.name)
    publisher = None if options.ros2 is None else Ros2Publisher(options.ros2, options.name)
    logs = tick_logs(options)
    metrics = None if options.metrics is None else _metrics(options.name)

    def stepped(observation: Observation, step: TickResult) -> None:
        manager.alive()
        show(observation, step)
        if publisher is not None:
            publisher.step(observation, bool(step.changes), agent.pipeline, agent.merged_poses)
        for log in logs:
            log.step(observation, step, agent.pipeline)
        if metrics is not None:
            metrics.step(step, agent.runner.busy)

    with contextlib.ExitStack() as closing:
        if publisher is not None:
            closing.callback(publisher.close)
        for log in logs:
            closing.callback(_end_log, log, say, options.name)
        if metrics is not None and options.metrics is not None:
            closing.callback(metrics.serve(options.metrics))
        agent = Agent(describe, bus, keys, settings, options, stepped, say, manager.alive)
        if metrics is not None:
            metrics.read(agent.sources())
        manager.ready()
        closing.enter_context(show)
        try:
            agent.run(robot, stop)
        finally:
            robot.close()
            try:
                agent.finish()
                path = agent.write_map()
                nodes, edges = len(agent.pipeline.map.nodes), len(agent.pipeline.map.edges)
                why = agent.runner.why_no_node if options.recorded and not nodes else ""
                what = f"{counted(nodes, 'node')} and {counted(edges, 'edge')}"
                say(f"{options.name}: {what} in {path}{'; ' * bool(why)}{why}")
            finally:
                # The journal is complete also where a full disk takes no map file.
                _hand_over(say, agent, bus, options)
                agent.close()
        status = agent.replicator.status()
        if status.waiting:
            lost = f"{counted(status.waiting, 'change')} {'is' if status.waiting == 1 else 'are'} lost"
            # The process has ended: room that is made now lets nothing be written.
            why = status.failure.replace(DISK_FULL, NO_ROOM)
            again = ", and replay the recording again" if options.recorded else ""
            raise InvalidFile(f"{options.name}: {lost}: {why}{again}")


def _metrics(robot: str) -> AgentMetrics:
    """Metrics of an agent; the library is an extra, so it is imported here."""
    from mapweave.processes.agent_metrics import AgentMetrics

    return AgentMetrics(robot)


def tick_logs(options: AgentOptions) -> list[TickLog]:
    """The logs that the options ask for.

    Raises:
        MissingExtra: one needs an extra that is not installed.
        SettingsError: one cannot be where it is asked for.
    """
    logs: list[TickLog] = []
    if options.rerun is not None:
        need("rerun")
        # It takes a second to import, and is an extra: so it is imported here.
        from mapweave.processes.rerun_log import RerunLog

        logs.append(RerunLog(options.rerun, options.name))
    if options.mcap_log is not None:
        from mapweave.processes.mcap_log import McapLog

        logs.append(McapLog(options.mcap_log))
    return logs


def _end_log(log: TickLog, say: Callable[[str], None], name: str) -> None:
    if missing := log.close():
        say(f"{name}: not in the {log.title}: {missing}")


def _describe(robot: Robot, print_line: Callable[[str], None], name: str) -> RobotDescription:
    """Description of the robot; a long wait for it is reported."""
    patience = threading.Timer(SILENCE, print_line, [f"{name}: waits for its robot"])
    patience.daemon = True
    patience.start()
    try:
        return robot.describe()
    finally:
        patience.cancel()


def _hand_over(
    say: Callable[[str], None], agent: Agent, bus: ZenohBus | MemoryBus, options: AgentOptions
) -> None:
    replicator = agent.replicator
    if not replicator.flush(10.0):
        return  # closing it says what is lost
    status = replicator.status()
    if not (status.newest or status.unacknowledged):
        return  # nothing was mapped, and no server may be there
    if options.patience <= 0:
        line = "offline: the map stays in the journal and is sent when a server can be reached"
    elif replicator.wait_acknowledged(options.patience, _recently(lambda: agent.server_in_reach)):
        line = f"server {options.server} has it all"
    elif not bus.connected():
        line = "no server in reach: the map stays in the journal and is sent when one can be reached"
    elif not agent.server_in_reach:
        line = f"no map server {options.server} in reach: the map stays in the journal until it can be sent"
    else:
        line = f"server {options.server} has not acknowledged everything: the rest stays in the journal"
    say(f"{options.name}: {line}")


def _recently(holds: Callable[[], bool]) -> Callable[[], bool]:
    """Whether something has held within the last ARRIVAL seconds, or has not been asked for longer."""
    held_at = time.monotonic()

    def recently() -> bool:
        nonlocal held_at
        if holds():
            held_at = time.monotonic()
        return time.monotonic() - held_at < ARRIVAL

    return recently

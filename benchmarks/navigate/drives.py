"""One drive of the navigation benchmark: put down, relocalize, drive, park; judged by the truth."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.navigate.office import ROBOT, Office
from benchmarks.navigate.plots import Plot
from mapweave.hybridmap.agent_status import Status
from mapweave.hybridmap.mission_order import MissionKind
from mapweave.hybridmap.pose import Array, wrap_angle

PATIENCE = 240.0
"""A drive that takes longer has failed, simulated s."""
CLOSE, CLOSE_TURN = 0.05, 5.0
"""Within this of where the goal's image was taken, m and degrees, a robot is at its goal at all."""
LOOK_EVERY = 0.5
"""Simulated s."""


@dataclass(frozen=True, eq=False)
class NavigationOutcome:
    """One drive as it was driven.

    Attributes:
        plot: where from and where to.
        status: what the robot said last.
        reason: why it failed, in words; empty if the robot stands at its goal and has touched nothing.
        found_s: until the robot first knew where it was, s; None if it never did.
        time_s: until it said that it had arrived, or was stopped.
        error_m: from where the goal's image was truly taken.
        error_deg: likewise.
        collisions: on the way.
        driven: length of the way, m.
        events: what the robot did, with the time of each change, s.
        desired: picture from where the goal's image was truly taken.
        reached: what the robot saw at last.
        track: (N, 2) m, its way in world.
    """

    plot: Plot
    status: Status
    reason: str
    found_s: float | None
    time_s: float
    error_m: float
    error_deg: float
    collisions: int
    driven: float
    events: tuple[tuple[float, str], ...]
    desired: NDArray[np.uint8]
    reached: NDArray[np.uint8]
    track: Array

    @property
    def success(self) -> bool:
        """Whether the robot stands at its goal, says so, and has touched nothing."""
        return not self.reason

    @property
    def path_over_shortest(self) -> float:
        """Length of the way over that of the shortest for a robot that knows the floor."""
        return self.driven / max(self.plot.shortest, 1e-9)


def drive(office: Office, plot: Plot, on_time: Callable[[float, str], None]) -> NavigationOutcome:
    """Drive once; the robot knows its map and nothing of where it is.

    Args:
        office: mapped.
        plot: where from, where to.
        on_time: called with the simulated time of the drive and what the robot is doing.
    """
    desired = _picture_from(office, plot)
    office.command(MissionKind.STOP)
    office.control.kidnap(ROBOT, plot.world_from_robot)
    office.advance(0.1)
    before, begin = office.control.status().robots[ROBOT].collisions, office.ticks
    office.command(MissionKind.GO, plot.goal)
    found_s, events = None, list[tuple[float, str]]()
    while True:
        status = office.advance(LOOK_EVERY).status
        time_s = (office.ticks - begin) * 0.1
        if found_s is None and status.fix_node is not None:
            found_s = time_s
        if not events or events[-1][1].partition(":")[0] != status.doing:
            events.append((time_s, f"{status.doing}: {status.detail}"))
        on_time(time_s, status.doing)
        if status.finished or time_s >= PATIENCE:
            break
    truth = office.control.status().robots[ROBOT]
    error = plot.world_from_goal.inverse() @ truth.world_from_robot
    error_m, error_deg = math.hypot(error.x, error.y), math.degrees(abs(wrap_angle(error.heading)))
    track = office.control.trajectory(ROBOT)[1][begin : office.ticks + 1, :2]
    collisions = truth.collisions - before
    return NavigationOutcome(
        plot,
        status,
        _reason(status, error_m, error_deg, collisions),
        found_s,
        time_s,
        error_m,
        error_deg,
        collisions,
        float(np.linalg.norm(np.diff(track, axis=0), axis=1).sum()),
        tuple(events),
        desired,
        _picture(office),
        track,
    )


def _reason(status: Status, error_m: float, error_deg: float, collisions: int) -> str:
    """Why a drive has failed; empty if it has not."""
    if collisions:
        return f"touched something {collisions} times"
    if not status.finished:
        return f"not there within {PATIENCE:.0f} s: {status.doing}; {status.detail}"
    if error_m > CLOSE or error_deg > CLOSE_TURN:
        return f"says that it has arrived, but is {error_m:.2f} m and {error_deg:.0f} degrees off"
    return ""


def _picture_from(office: Office, plot: Plot) -> NDArray[np.uint8]:
    """What the robot sees from where the goal's image was taken; it has no mission meanwhile."""
    office.command(MissionKind.STOP)
    office.control.kidnap(ROBOT, plot.world_from_goal)
    office.advance(0.1)
    return _picture(office)


def _picture(office: Office) -> NDArray[np.uint8]:
    image = office.control.snapshot().images[ROBOT]
    assert image is not None, "its camera never fails here"
    return image

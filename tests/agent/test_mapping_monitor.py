"""Causes of no nodes: each is named, by a robot that drives before photographs or has something broken."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from mapweave import Command, Observation, Odometry, Pose2
from mapweave.agent.mapping_monitor import AGAIN, PATIENCE, MappingMonitor
from mapweave.hybridmap.agent_status import Status

STOPPED = Odometry(0.0, 0.0)
DRIVE = Command(0.1, 0.0)
NOISE = np.random.default_rng(0).normal(0.0, 2.0, (7, 240, 320)).astype(np.float32)
PERIOD = 40
"""Ticks of one drive forth and back."""

Break = Callable[[Observation], Observation]


@pytest.fixture(scope="module")
def drive(walls) -> list[Observation]:
    """Forth and back before photographs at 0.1 m/s."""
    poses = [Pose2(0.01 * min(tick, PERIOD - tick)) for tick in range(PERIOD)]
    return [walls.observe(poses[tick - 1], poses[tick], tick) for tick in range(PERIOD)]


def lines(
    drive: list[Observation], description, broken: Break, seconds: float, command: Command = DRIVE,
    mission: str = "carried", nodes_per_s: float = 0.0,
) -> list[str]:  # fmt: skip
    """What is reported of a robot that drives."""
    monitor, out = MappingMonitor(description), []
    for tick in range(1, round(seconds / description.tick)):
        seen = broken(replace(drive[tick % PERIOD], stamp_ns=tick * 100_000_000))
        if seen.image is not None:
            noisy = np.clip(seen.image + NOISE[tick % len(NOISE)], 0, 255).astype(np.uint8)
            seen = replace(seen, image=noisy)
        status = Status("mapping", "9 tracks", int(0.1 * tick * nodes_per_s), 9, Pose2(), False, mission)
        line = monitor.see(seen, status, command)
        if line:
            out.append(line)
            detail = f"{status.doing}: {monitor.explained(status).detail}"
            assert mission == "idle" or detail.endswith(line.split("s: ", 1)[1])
    return out


def working(seen: Observation) -> Observation:
    return seen


def covered(seen: Observation) -> Observation:
    return replace(seen, image=np.full_like(seen.image, 6))


def defocused(seen: Observation) -> Observation:
    return replace(seen, image=cv2.GaussianBlur(seen.image, (0, 0), 5.0))


def dazzled(seen: Observation) -> Observation:
    return replace(seen, image=np.full_like(seen.image, 255))


def no_camera(seen: Observation) -> Observation:
    return replace(seen, image=None)


def dead_encoders(seen: Observation) -> Observation:
    return replace(seen, odometry=STOPPED)


@pytest.mark.parametrize(("broken", "command", "words"), [
    (covered, DRIVE, "the image is dark"),
    (dazzled, DRIVE, "overexposed"),
    (defocused, DRIVE, "is blurred"),
    (no_camera, DRIVE, "no image for"),
    ("other camera", DRIVE, "the wheels turn and the image stands still"),
    (dead_encoders, DRIVE, "the encoders do not count"),
    (dead_encoders, Command(), "or does neither encoder count"),
    ("dead motors", DRIVE, "the wheels do not obey"),
    ("dead motors", Command(), "the robot stands still"),
])  # fmt: skip
def test_a_cause_is_named_once(drive, description, broken, command, words):
    def other_camera(seen: Observation) -> Observation:
        return replace(seen, image=drive[0].image)

    def dead_motors(seen: Observation) -> Observation:
        return other_camera(dead_encoders(seen))

    broken = {"other camera": other_camera, "dead motors": dead_motors}.get(broken, broken)
    (line,) = lines(drive, description, broken, PATIENCE + 5.0, command)
    assert line.startswith(f"no new node for {PATIENCE:.0f} s: ") and words in line


def test_what_the_pipeline_says_itself_is_reported(drive, description):
    assert lines(drive, description, working, PATIENCE + 5.0) == [
        f"no new node for {PATIENCE:.0f} s: mapping: 9 tracks"
    ]


def test_a_robot_that_explores_says_itself_why_it_stands(drive, description):
    def stands(seen: Observation) -> Observation:
        return replace(dead_encoders(seen), image=drive[0].image)

    (line,) = lines(drive, description, stands, PATIENCE + 5.0, Command(), "explore")
    assert line.endswith(": mapping: 9 tracks")
    (line,) = lines(drive, description, dead_encoders, PATIENCE + 5.0, Command(), "explore")
    assert line.endswith(": mapping: 9 tracks"), "a person moves in front of it"


def test_a_robot_that_is_pushed_has_encoders(drive, description):
    """A person drives it, so it has no commands, and its wheels count."""
    (line,) = lines(drive, description, working, PATIENCE + 5.0, Command())
    assert line.endswith(": mapping: 9 tracks")


def test_an_idle_robot_says_that_it_is_idle(drive, description):
    (line,) = lines(drive, description, working, PATIENCE + 5.0, Command(), "idle")
    assert "the mission is idle" in line


def test_a_robot_that_maps_or_navigates_reports_nothing(drive, description):
    assert lines(drive, description, working, PATIENCE + 5.0, nodes_per_s=0.1) == []
    assert lines(drive, description, covered, PATIENCE + 5.0, mission="goto") == []


@pytest.mark.parametrize("jump", [3600.0, -0.5])
def test_a_clock_that_jumps_is_no_time_without_a_node(drive, description, jump: float):
    """There was no new node for 2522887204 s once its clock was set."""

    def set_once(seen: Observation) -> Observation:
        later = seen.stamp_ns + (int(jump * 1e9) if seen.stamp_ns > 12e9 else 10**9)
        return replace(seen, stamp_ns=later)

    assert lines(drive, description, set_once, 12.0 + PATIENCE - 1.0) == []
    (line,) = lines(drive, description, set_once, 12.0 + PATIENCE + 5.0)
    assert line.startswith(f"no new node for {PATIENCE:.0f} s: ")


def test_another_cause_is_reported_later(drive, description):
    """The lens is covered, and then the camera unplugged."""

    def twice(seen: Observation) -> Observation:
        return (covered if seen.stamp_ns < (PATIENCE + 10.0) * 1e9 else no_camera)(seen)

    first, second = lines(drive, description, twice, PATIENCE + AGAIN + 5.0)
    assert "dark" in first and "no image" in second

"""A robot that is started again knows what it has learned of its camera, says so, and may forget it."""

import json
import math
import threading
from collections.abc import Sequence
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest

from mapweave import Command, MissionKind, Observation, Odometry, Pose2, RobotDescription
from mapweave.agent.calibration.correction import corrected, declaring, frame_change, geometry_of
from mapweave.agent.calibration.learned import LearnedGeometry, LearnedParameter, intrinsics_of
from mapweave.agent.drive_geometry import DriveGeometry, Parameter
from mapweave.agent.recordings.learned_file import read_learned, write_learned
from mapweave.agent.settings import AgentSettings
from mapweave.cli import main
from mapweave.processes.agent import Agent, AgentOptions
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from tests.agent.calibration.room_drive import CAMERA, RoomDrive, drive, render
from tests.agent.conftest import DESCRIPTION, PhotoWalls
from tests.waiting import eventually

KEYS = Keys("fleet")
P = Parameter


@pytest.fixture
def bus(opened) -> MemoryBus:
    """It reaches no one."""
    return opened(MemoryBus(MemoryHub()))


def learned_of(description: RobotDescription, heading: float = 0.02) -> LearnedGeometry:
    parameters = {P.HEADING: LearnedParameter(heading, 0.002)}
    return LearnedGeometry(geometry_of(description), intrinsics_of(description), parameters)


def started(bus: MemoryBus, folder: Path, said: list[str], **options: object) -> Agent:
    given = AgentOptions("r0", folder, epoch=1, mission=MissionKind.CARRIED, patience=0.0, **options)  # type: ignore[arg-type]
    return Agent(lambda: DESCRIPTION, bus, KEYS, AgentSettings(), given, print_line=said.append)


def test_the_start_says_what_was_learned_and_how_to_forget_it(bus: MemoryBus, tmp_path):
    said: list[str] = []
    file = tmp_path / "r0.learned.toml"
    write_learned(file, learned_of(DESCRIPTION, math.radians(-0.3)), date(2026, 11, 29))
    agent = started(bus, tmp_path, said)
    assert agent.pipeline.calibration.geometry.heading == math.radians(-0.3)
    agent.close()
    line = f"r0: camera's heading -0.3 degrees (declared 0.0); learned on 2026-11-29; forget with `rm {file}`"
    assert line in said
    assert read_learned(file) == (learned_of(DESCRIPTION, math.radians(-0.3)), date(2026, 11, 29))
    file.unlink()
    again = started(bus, tmp_path, said)
    assert again.pipeline.calibration.geometry.heading == 0.0
    again.close()
    assert not file.exists()


def test_a_correction_is_on_the_disk_before_the_process_ends(bus: MemoryBus, tmp_path, opened):
    """It may be killed. That a correction is found is tested with the calibration."""
    agent = opened(started(bus, tmp_path, []))
    calibration, file = agent.pipeline.calibration, tmp_path / "r0.learned.toml"
    walls, here = PhotoWalls(), Pose2(-1.0)
    agent.tick(walls.observe(here, here, 1))
    assert not file.exists()
    # As if a solution had been adopted.
    calibration._used[P.HEADING], calibration._sigmas[P.HEADING] = True, 0.002
    after = replace(calibration.geometry, heading=0.05)
    calibration._next, change = after, frame_change(calibration.geometry, after)
    calibration.pending = (*corrected(DESCRIPTION, after), change)
    calibration.switched()
    agent.tick(walls.observe(here, here, 2))
    eventually(file.exists, 10.0)
    read = read_learned(file)
    assert read is not None and read[0].parameters == {P.HEADING: LearnedParameter(0.05, 0.002)}


def test_a_recording_is_the_same_map_whatever_was_learned(bus: MemoryBus, tmp_path, opened):
    write_learned(tmp_path / "r0.learned.toml", learned_of(DESCRIPTION), date(2026, 11, 29))
    agent = opened(started(bus, tmp_path, [], recorded=True))
    assert agent.pipeline.calibration.geometry.heading == 0.0


@pytest.mark.parametrize("damaged", [True, False])
def test_what_cannot_be_used_is_said_and_stops_no_robot(bus: MemoryBus, tmp_path, damaged: bool):
    said: list[str] = []
    file = tmp_path / "r0.learned.toml"
    other = declaring(DESCRIPTION, replace(geometry_of(DESCRIPTION), forward=0.5))
    write_learned(file, learned_of(other), date(2026, 11, 29))
    if damaged:
        file.write_text(file.read_text().replace("sigma", "sgima"))
    agent = started(bus, tmp_path, said)
    assert agent.pipeline.calibration.geometry.heading == 0.0
    agent.close()
    (line,) = [line for line in said if "not used" in line]
    assert line.endswith(
        "is not used" if damaged else "is not used: another camera or geometry is declared since"
    )


def test_the_doctor_shows_it(tmp_path, capfd):
    file = tmp_path / "r0.learned.toml"
    write_learned(file, learned_of(DESCRIPTION, math.radians(1.5)), date(2026, 11, 29))
    (tmp_path / "r1.learned.toml").write_text("learned_on = 1\n")
    main(["doctor", "--json", "--offline", "--data", str(tmp_path)])
    findings = json.loads(capfd.readouterr().out)["findings"]
    good, bad = [one for one in findings if one["subject"] == "learned geometry"]
    assert good["verdict"] == "good" and bad["verdict"] == "wrong"
    assert good["detail"] == (
        f"r0: camera's heading 1.5 degrees (declared 0.0); learned on 2026-11-29; forget with `rm {file}`"
    )
    assert "r1.learned.toml: learned_on is no date; r1 does not use it" in bad["detail"]


class Driven:
    """A robot that is driven through a rendered room, with wheels that slip a little."""

    def __init__(self, run: RoomDrive, images: Sequence[np.ndarray], declared: DriveGeometry) -> None:
        self._run, self._images, self._tick = run, images, 0
        way, turn = (
            np.interp(run.stamps, run.wheels.stamps, column) for column in (run.wheels.way, run.wheels.turn)
        )
        self._steps = np.diff(np.column_stack([way, turn]), axis=0, prepend=[[way[0], turn[0]]])
        self._description = declaring(RobotDescription(run.camera, axle=0.25), declared)

    def describe(self) -> RobotDescription:
        return self._description

    def sense(self) -> Observation | None:
        if self._tick == len(self._images):
            return None
        k, self._tick = self._tick, self._tick + 1
        return Observation(10**11 + k * 10**8, Odometry(*map(float, self._steps[k])), self._images[k])

    def act(self, command: Command) -> Command:
        return command

    def close(self) -> None:
        pass


@pytest.mark.slow
def test_a_restarted_robot_maps_on_with_what_it_has_learned(bus: MemoryBus, tmp_path):
    """A camera looks 3 degrees aside of what is declared. In between the process ends; its journal stays."""
    true = DriveGeometry(forward=0.08, height=0.25)
    camera = replace(CAMERA, width=160, height=120, fx=138.5, fy=138.5, cx=79.5, cy=59.5)
    run = drive(np.random.default_rng(6), true, 45.0, camera=camera)
    images = render(run)
    declared = replace(true, heading=math.radians(3.0))
    said: list[list[str]] = [[], []]
    used = []
    for lines, count in zip(said, (len(images), 150), strict=True):
        robot = Driven(run, images[:count], declared)
        options = AgentOptions("r0", tmp_path, mission=MissionKind.CARRIED, patience=0.0)
        agent = Agent(robot.describe, bus, KEYS, AgentSettings(), options, print_line=lines.append)
        used.append(agent.pipeline.calibration.geometry.heading)
        agent.run(robot, threading.Event())
        used.append(agent.pipeline.calibration.geometry.heading)
        agent.close()
    begun, corrected, resumed, kept = np.degrees(used)
    assert begun == pytest.approx(3.0)
    assert corrected == pytest.approx(0.0, abs=0.6) and resumed == pytest.approx(0.0, abs=0.6)
    assert kept == resumed, "the second drive bears it out"
    assert not any("learned on" in line for line in said[0])
    assert any(line.startswith("r0: camera's heading") and "learned on" in line for line in said[1])
    assert not any("contradicted" in line for line in said[1])

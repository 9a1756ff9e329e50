"""`mapweave record` and `mapweave agent --record` with a driver of one's own."""

import errno
from pathlib import Path

import pytest

from mapweave.agent.drivers.replay import Replay
from mapweave.cli import main

DRIVER = """
import numpy as np
from mapweave.agent.observation import Command, Observation, Odometry, RobotDescription
from mapweave.hybridmap.camera import Camera

class Rolling:
    def __init__(self, settings):
        self.count = 0

    def describe(self):
        return RobotDescription(camera=Camera(64, 48, 60.0, 60.0, 31.5, 23.5, mount_height=0.2))

    def sense(self):
        self.count += 1
        if self.count > 20:
            return None
        image = np.random.default_rng(self.count).integers(0, 255, (48, 64)).astype(np.uint8)
        return Observation(1_700_000_000_000_000_000 + self.count * 100_000_000, Odometry(0.02, 0.01), image)

    def act(self, command):
        return Command(min(command.forward, 0.1), command.turn)

    def close(self):
        pass
"""


@pytest.fixture
def driver(tmp_path: Path) -> str:
    (tmp_path / "rolling.py").write_text(DRIVER)
    return f"{tmp_path / 'rolling.py'}:Rolling"


@pytest.mark.parametrize("by", ["record", "agent"])
def test_what_a_robot_senses_is_replayed(by: str, driver: str, tmp_path):
    out = tmp_path / "drive"
    nowhere = ["--robot", driver, "--connect", "tcp/127.0.0.1:1"]
    if by == "record":
        assert main(["record", "r0", "--out", str(out), "--lossless", *nowhere]) == 0
    else:
        data = ["--data", str(tmp_path / "data"), "--mission", "idle", "--epoch", "1"]
        assert main(["agent", "r0", "--record", str(out), *data, *nowhere]) == 0
    replay = Replay(out)
    assert len(replay) == 20 and replay.describe().camera.width == 64
    steps = [(o.odometry.forward, o.odometry.turn) for o in iter(replay.sense, None)]
    assert steps[1:] == [pytest.approx((0.02, 0.01))] * 19


def test_a_recording_is_not_overwritten(driver: str, tmp_path, capfd):
    (tmp_path / "drive").mkdir()
    (tmp_path / "drive" / "notes.txt").write_text("mine")
    nowhere = ["--robot", driver, "--connect", "tcp/127.0.0.1:1"]
    assert main(["record", "r0", "--out", str(tmp_path / "drive"), *nowhere]) == 1
    assert "not empty" in capfd.readouterr().err
    assert [p.name for p in (tmp_path / "drive").iterdir()] == ["notes.txt"]


def test_no_robot_is_opened_for_a_folder_that_is_in_use(driver: str, tmp_path, capfd):
    """It stayed open, and the thread of its camera aborted the process while that ended: status 134."""
    (tmp_path / "rolling.py").write_text(DRIVER.replace("self.count = 0", "raise SystemExit('it is opened')"))
    (tmp_path / "drive").mkdir()
    (tmp_path / "drive" / "notes.txt").write_text("mine")
    out = ["--out", str(tmp_path / "drive"), "--robot", driver, "--connect", "tcp/127.0.0.1:1"]
    assert main(["record", "r0", *out]) == 1
    assert "not empty" in capfd.readouterr().err


def test_a_full_disk_ends_the_command(driver: str, tmp_path, monkeypatch, capfd):
    endless = (tmp_path / "rolling.py").read_text().replace("self.count > 20", "time.sleep(0.01)")
    (tmp_path / "rolling.py").write_text(f"import time\n{endless}")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("mapweave.agent.recordings.mcap_writer._Part.write", full)
    out = str(tmp_path / "drive")
    assert main(["record", "r0", "--out", out, "--robot", driver, "--connect", "tcp/127.0.0.1:1"]) == 1
    output = capfd.readouterr()
    assert output.err.count("the recording ends here, the disk is full; make room") == 1
    assert "r0: at most 0 observations in" in output.out

"""`mapweave agent` with a driver from a file; a router without server; a second agent is refused."""

import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.waiting import eventually, free_port

DRIVER = """
import time
import numpy as np
from mapweave.agent.observation import Command, Observation, Odometry, RobotDescription
from mapweave.hybridmap.camera import Camera

class Still:
    '''A robot that looks at noise and writes down its commands.'''
    def __init__(self, settings):
        self.log = open(settings.options["log"], "a", buffering=1)
        self.image = np.random.default_rng(0).integers(0, 255, (48, 64), dtype=np.uint8)
    def describe(self):
        return RobotDescription(Camera(64, 48, 60.0, 60.0, 32.0, 24.0, 0.3))
    def sense(self):
        time.sleep(0.1)
        return Observation({stamp}, Odometry(0.0, 0.0), self.image)
    def act(self, command):
        print(command, file=self.log)
        return command
    def close(self):
        print("closed", file=self.log)
"""


class Started:
    """A `mapweave` process; its output is in a file."""

    def __init__(self, folder: Path, name: str, *arguments: object) -> None:
        self.said = folder / f"{name}.txt"
        with self.said.open("w") as output:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "mapweave", *map(str, arguments)], stdout=output, stderr=output
            )

    def says(self, words: str) -> bool:
        return words in self.said.read_text()

    def end(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(30)


def started_agent(folder: Path, name: str, endpoint: str, driver: str) -> Started:
    """An agent `r0` with this driver, which writes into `name`.log."""
    program, settings = folder / "still.py", folder / f"{name}.toml"
    program.write_text(driver)
    settings.write_text(f'[robot.options]\nlog = "{folder / name}.log"\n')
    return Started(
        folder, name, "agent", "r0", "--robot", f"{program}:Still", "--connect", endpoint,
        "--settings", settings, "--data", folder / name, "--epoch", "1",
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.waits
def test_a_second_agent_of_a_robot_is_refused_before_it_moves_anything(tmp_path):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    router = Started(tmp_path, "router", "router", "--listen", endpoint)
    started = [router]
    try:
        eventually(lambda: router.says(f"router listens at {endpoint}"))

        def agent(name: str) -> Started:
            driver = DRIVER.replace("{stamp}", "time.time_ns()")
            started.append(started_agent(tmp_path, name, endpoint, driver))
            return started[-1]

        first = agent("first")
        eventually(lambda: (tmp_path / "first.log").exists() and (tmp_path / "first.log").stat().st_size)
        second = agent("second")
        assert second.process.wait(40) == 1
        assert second.said.read_text().splitlines()[-1] == (
            "mapweave: another agent drives r0; stop it, or give this robot another name. "
            "One that hangs, or has lost the network, is gone after 10 s"
        )
        assert not (tmp_path / "second.log").exists()
        assert not (tmp_path / "second").exists()
        assert first.process.poll() is None
        # The same name on the robot that takes over: an agent that was killed is not waited for long.
        first.process.kill()
        first.process.wait()
        third = agent("third")
        eventually(lambda: (tmp_path / "third.log").exists() and (tmp_path / "third.log").stat().st_size)
        assert third.end() == 0
        assert (tmp_path / "third.log").read_text().endswith("closed\n")
        assert router.end() == 0
    finally:
        for item in started:
            item.process.kill()
            item.process.wait()


@pytest.mark.slow
@pytest.mark.waits
@pytest.mark.parametrize(("stamp", "words"), [
    ("time.time()", "stamp_ns .* whole nanoseconds"), ("7", "stamp_ns stands still at 7"),
])  # fmt: skip
def test_a_mistake_of_the_driver_is_one_line(stamp: str, words: str, tmp_path, closed: str):
    agent = started_agent(tmp_path, "agent", closed, DRIVER.replace("{stamp}", stamp))
    assert agent.process.wait(60) == 1
    *_, last = agent.said.read_text().splitlines()
    assert re.match(f"mapweave: driver: {words}", last), last
    assert (tmp_path / "agent.log").read_text().endswith("closed\n")


@pytest.mark.slow
@pytest.mark.waits
def test_a_driver_that_hangs_does_not_keep_the_process(tmp_path, closed: str):
    hangs = DRIVER.replace("time.sleep(0.1)", "print('hangs', file=self.log); time.sleep(1000)")
    agent = started_agent(tmp_path, "agent", closed, hangs.replace("{stamp}", "time.time_ns()"))
    try:
        log = tmp_path / "agent.log"
        eventually(lambda: log.exists() and "hangs" in log.read_text())
        assert agent.end() == 1
        *_, last = agent.said.read_text().splitlines()
        assert re.search(
            r"the driver's sense\(\) has not returned for \d+ s: the process ends without it$", last
        )
        assert log.read_text().endswith("closed\n")
    finally:
        agent.process.kill()
        agent.process.wait()

"""With keys, what server and agent write is for their own user alone; without, as the umask says."""

import signal
import sys
from pathlib import Path

import pytest

from mapweave.identities.key_folder import KeyFolder, Profile
from mapweave.wire.credentials import Role
from tests.programs import going
from tests.quick import first_quick
from tests.waiting import eventually, free_port

DRIVER = """
import time
import numpy as np
from mapweave.agent.observation import Observation, Odometry, RobotDescription
from mapweave.hybridmap.camera import Camera

class Standing:
    def __init__(self, settings):
        self.image = np.zeros((48, 64), np.uint8)
    def describe(self):
        return RobotDescription(Camera(64, 48, 60.0, 60.0, 32.0, 24.0, 0.3))
    def sense(self):
        time.sleep(0.1)
        return Observation(time.time_ns(), Odometry(0.0, 0.0), self.image)
    def act(self, command):
        return command
    def close(self):
        pass
"""


def modes(folder: Path) -> dict[str, int]:
    """What other users may do with what is in a folder; it itself is `.`."""
    paths = [folder, *folder.rglob("*")]
    return {str(path.relative_to(folder)): path.stat().st_mode & 0o077 for path in paths if path.exists()}


@pytest.mark.parametrize(("process", "keys"), first_quick([
    ("server", False), ("server", True), ("agent", True), ("agent", False),
], 2))  # fmt: skip
def test_files_are_for_their_owner_alone_if_there_are_keys(keys: bool, process: str, tmp_path):
    folder = KeyFolder.create(tmp_path / "keys", "demo", Profile.PRODUCTION, [], "s0", free_port())
    folder.add("r0", Role.ROBOT)
    (tmp_path / "standing.py").write_text(DRIVER)
    at = f"{'tls' if keys else 'tcp'}/127.0.0.1:{free_port()}"
    words = {
        "server": ["server", "--listen", at, *(["--keys", "keys"] * keys)],
        "agent": ["agent", "r0", "--connect", at, "--robot", "standing.py:Standing",
                  *(["--keys", str(folder.key_file("r0"))] * keys)],
    }[process]  # fmt: skip
    data, made = {
        "server": (tmp_path / "out/server", "s0.sqlite"), "agent": (tmp_path / "out/agents", "r0.sqlite"),
    }[process]  # fmt: skip
    program = [sys.executable, "-m", "mapweave", *words]
    with (
        (tmp_path / "log.txt").open("w") as output,
        going(*program, cwd=tmp_path, stdout=output, stderr=output, umask=0o022) as running,
    ):
        eventually(lambda: (data / made).exists() or running.poll() is not None)
        running.send_signal(signal.SIGTERM)
        running.wait(30)
    found = modes(data)
    assert made in found, (tmp_path / "log.txt").read_text()
    if keys:
        assert set(found.values()) == {0}
    else:
        assert found["."] == 0o055 and found[made] == 0o044

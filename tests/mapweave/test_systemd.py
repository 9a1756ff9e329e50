"""The systemd units: systemd takes them, their commands exist, and the processes report to it."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from mapweave.cli import main, parser
from mapweave.scenarios.children import free_port

UNITS = sorted((Path(__file__).parents[2] / "examples" / "systemd").glob("*.service"))
INSTALLED = "/opt/mapweave/bin/mapweave"


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.name)
def test_systemd_has_nothing_to_say_about_a_unit(unit: Path, tmp_path: Path) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("needs systemd-analyze")
    copy = tmp_path / unit.name.replace("@", "@r0")
    copy.write_text(unit.read_text().replace(INSTALLED, "/bin/true"))
    done = subprocess.run(["systemd-analyze", "verify", copy], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout + done.stderr) == (0, "")


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.name)
def test_its_command_parses(unit: Path) -> None:
    (line,) = [line for line in unit.read_text().splitlines() if line.startswith("ExecStart=")]
    program, *words = line.removeprefix("ExecStart=").replace("%i", "r0").split()
    assert program == INSTALLED
    arguments = parser().parse_args(words)
    assert str(arguments.data).startswith("/var/lib/mapweave")


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[socket.socket]:
    """What systemd listens at."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        listening.settimeout(30.0)
        yield listening


def test_an_agent_is_ready_and_alive(manager, recording, monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", manager.getsockname())
    assert (
        main(["replay", str(recording), "--offline", "--data", str(tmp_path / "agents"), "--name", "walk"])
        == 0
    )
    assert [manager.recv(64), manager.recv(64)] == [b"READY=1", b"WATCHDOG=1"]


def test_a_server_is_ready_and_alive(manager, tmp_path) -> None:
    command = [sys.executable, "-m", "mapweave", "server", "--listen", f"tcp/127.0.0.1:{free_port()}"]
    environment = os.environ | {"NOTIFY_SOCKET": manager.getsockname()}
    with subprocess.Popen(
        [*command, "--data", str(tmp_path / "server")], env=environment, stdout=subprocess.DEVNULL
    ) as server:
        try:
            assert [manager.recv(64), manager.recv(64)] == [b"READY=1", b"WATCHDOG=1"]
        finally:
            server.terminate()

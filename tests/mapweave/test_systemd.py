"""The systemd units: systemd takes them, their commands exist, and the processes report to it."""

import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from mapweave.cli import main, parser
from mapweave.doctor.ports import PATTERNS
from mapweave.scenarios.children import free_port
from tests.programs import ran

UNITS = sorted((Path(__file__).parents[2] / "examples" / "systemd").glob("*.service"))
INSTALLED = "/opt/mapweave/bin/mapweave"


def analyzed(unit: Path, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """What systemd-analyze says about a copy of a unit."""
    if shutil.which("systemd-analyze") is None:
        pytest.skip("needs systemd-analyze")
    copy = folder / unit.name.replace("@", "@r0")
    copy.write_text(unit.read_text().replace(INSTALLED, "/bin/true"))
    return ran("systemd-analyze", *words, copy)


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.name)
def test_systemd_has_nothing_to_say_about_a_unit(unit: Path, tmp_path):
    done = analyzed(unit, tmp_path, "verify")
    assert (done.returncode, done.stdout + done.stderr) == (0, "")


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.name)
def test_its_command_parses(unit: Path):
    (line,) = [line for line in unit.read_text().splitlines() if line.startswith("ExecStart=")]
    program, *words = line.removeprefix("ExecStart=").replace("%i", "r0").split()
    assert program == INSTALLED
    arguments = parser().parse_args(words)
    assert str(arguments.data).startswith("/var/lib/mapweave")


def directives(unit: Path) -> dict[str, list[str]]:
    """All values of each directive."""
    given: dict[str, list[str]] = {}
    for line in unit.read_text().splitlines():
        name, equals, value = line.partition("=")
        if equals and not line.startswith("#"):
            given.setdefault(name, []).append(value)
    return given


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.name)
def test_it_is_hardened_and_writes_only_where_it_may(unit: Path):
    given = directives(unit)
    for name in ("NoNewPrivileges", "PrivateTmp", "ProtectHome", "DynamicUser", "RestrictSUIDSGID"):
        assert given[name] == ["yes"], name
    assert given["ProtectSystem"] == ["strict"] and given["CapabilityBoundingSet"] == [""]
    assert given["MemoryMax"] and given["TasksMax"]
    writable = [
        Path("/var/lib") / given["StateDirectory"][0],
        Path("/var/cache") / given["CacheDirectory"][0],
    ]
    words = given["ExecStart"][0].replace("%i", "r0").split()
    used = [Path(words[words.index(flag) + 1]) for flag in ("--data", "--calibration") if flag in words]
    used += [Path(given["WorkingDirectory"][0]), Path(given["Environment"][0].partition("=")[2])]
    arguments = parser().parse_args(words[1:])
    # A default that is relative lies below the working directory.
    used += [value for name, value in vars(arguments).items() if name in ("data", "calibration") and value]
    for path in used:
        assert any((writable[0] / path).is_relative_to(folder) for folder in writable), path


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.name)
def test_systemd_finds_little_exposure(unit: Path, tmp_path):
    done = analyzed(unit, tmp_path, "security", "--offline=true", "--threshold=20", "--no-pager")
    assert done.returncode == 0, done.stdout[-300:] + done.stderr


def test_an_agent_may_compile_at_its_first_start():
    """It took 102 s until it was ready on a busy PC, and a small computer is slower."""
    (unit,) = [unit for unit in UNITS if "agent" in unit.name]
    assert int(directives(unit)["TimeoutStartSec"][0]) >= 300


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[socket.socket]:
    """What systemd listens at."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        listening.settimeout(30.0)
        yield listening


def test_an_agent_may_open_every_port_that_find_port_finds():
    """The UART of a Raspberry Pi with Bluetooth is /dev/ttyS0, that of a Jetson /dev/ttyTHS1."""
    (unit,) = [unit for unit in UNITS if "agent" in unit.name]
    allowed = directives(unit)["DeviceAllow"]
    for name in ("ttyS", *(pattern.removesuffix("*") for pattern in PATTERNS if "cu." not in pattern)):
        assert f"char-{name} rw" in allowed


def test_an_agent_is_ready_and_alive(manager, recording, monkeypatch, tmp_path):
    monkeypatch.setenv("NOTIFY_SOCKET", manager.getsockname())
    assert (
        main(["replay", str(recording), "--offline", "--data", str(tmp_path / "agents"), "--name", "walk"])
        == 0
    )
    assert [manager.recv(64), manager.recv(64)] == [b"READY=1", b"WATCHDOG=1"]


@pytest.mark.slow
def test_a_server_is_ready_and_alive(manager, tmp_path):
    command = [sys.executable, "-m", "mapweave", "server", "--listen", f"tcp/127.0.0.1:{free_port()}"]
    environment = os.environ | {"NOTIFY_SOCKET": manager.getsockname()}
    with subprocess.Popen(
        [*command, "--data", str(tmp_path / "server")], env=environment, stdout=subprocess.DEVNULL
    ) as server:
        try:
            assert [manager.recv(64), manager.recv(64)] == [b"READY=1", b"WATCHDOG=1"]
        finally:
            server.terminate()

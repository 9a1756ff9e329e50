"""A router takes more sessions than Zenoh's own thousand, and than a process has files at first."""

import json
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from mapweave.wire import open_files
from mapweave.wire.open_files import allow_many_files
from tests.waiting import free_port

SESSIONS = 1100
ROUTER = """
import resource, sys
resource.setrlimit(resource.RLIMIT_NOFILE, (256, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.zenoh_bus import ZenohBus
bus = ZenohBus(BusSettings(mode="router", listen=(sys.argv[1],)))
print("open", flush=True)
sys.stdin.readline()
bus.close()
"""
CLIENTS = """
import os, resource, sys
import zenoh
resource.setrlimit(resource.RLIMIT_NOFILE, (resource.getrlimit(resource.RLIMIT_NOFILE)[1],) * 2)
config = zenoh.Config()
for path, value in {"mode": '"client"', "connect/endpoints": f'["{sys.argv[1]}"]',
                    "scouting/multicast/enabled": "false"}.items():
    config.insert_json5(path, value)
sessions = [zenoh.open(config) for _ in range(int(sys.argv[2]))]
print(sum(bool(session.info.routers_zid()) for session in sessions), flush=True)
os._exit(0)
"""


@pytest.mark.slow
def test_a_router_takes_more_than_a_thousand_sessions():
    if resource.getrlimit(resource.RLIMIT_NOFILE)[1] < 2 * SESSIONS:
        pytest.skip("this machine allows too few open files")
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    router = subprocess.Popen(
        [sys.executable, "-c", ROUTER, endpoint], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        assert router.stdout is not None and router.stdout.readline() == "open\n"
        clients = subprocess.run(
            [sys.executable, "-c", CLIENTS, endpoint, str(SESSIONS)],
            capture_output=True, text=True, timeout=120,
        )  # fmt: skip
        assert json.loads(clients.stdout) == SESSIONS, clients.stderr
    finally:
        router.communicate("\n", timeout=60)


def test_the_limit_of_open_files_rises_and_never_falls():
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    script = (
        "import resource; from mapweave.wire.open_files import allow_many_files; "
        "resource.setrlimit(resource.RLIMIT_NOFILE, ({soft}, {hard})); allow_many_files(); "
        "print(resource.getrlimit(resource.RLIMIT_NOFILE)[0])"
    )
    for soft in (64, hard):
        done = subprocess.run(
            [sys.executable, "-c", script.format(soft=soft, hard=hard)],
            capture_output=True, text=True, timeout=60, cwd=Path(__file__).parents[2],
        )  # fmt: skip
        assert int(done.stdout) == max(min(open_files.WANTED, hard), soft), done.stderr


def test_a_system_that_refuses_is_reported(monkeypatch, caplog):
    def refuses(what: int, limits: tuple[int, int]) -> None:
        del what, limits
        raise ValueError("not allowed to raise maximum limit")

    monkeypatch.setattr(resource, "getrlimit", lambda what: (1024, 4096))
    monkeypatch.setattr(resource, "setrlimit", refuses)
    allow_many_files()
    assert "at most 1024 connections: the limit of open files" in caplog.text

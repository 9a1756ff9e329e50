"""Full disks below a server, a PostgreSQL and a robot, as processes: disks that only this test sees."""

import json
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from synthetic.postgres_server import binaries
from tests.disks import own_mounts
from tests.programs import ran

pytestmark = [pytest.mark.slow, pytest.mark.waits, pytest.mark.timeout(900)]


@pytest.fixture(scope="module", params=["sqlite", "postgresql"])
def said(request: pytest.FixtureRequest) -> Iterator[dict[str, Any]]:
    """What was seen, with a store in a file and with one in PostgreSQL."""
    store = str(request.param)
    if store == "postgresql" and (find_spec("psycopg") is None or binaries() is None):
        pytest.skip("there is no PostgreSQL, or the extra `postgres` is not installed")
    if store == "postgresql" and os.geteuid():
        # It runs as a user of its own, of which a namespace of one user knows nothing.
        pytest.skip("a PostgreSQL on a disk of its own needs root")
    unshare = own_mounts(as_user=False)
    # Not below pytest's folder: that is its user's alone, and too long for a socket.
    folder = Path(tempfile.mkdtemp(prefix="disk-"))
    try:
        folder.chmod(0o755)
        program = [*unshare, sys.executable, "-m", "tests.benchmarks.disk_processes"]
        done = ran(*program, store, folder, timeout=800, cwd=Path(__file__).parents[2], env=dict(os.environ))
        logs = "\n".join(path.read_text(errors="replace")[-3000:] for path in folder.glob("*.log"))
        assert done.returncode == 0, done.stderr + logs
        yield dict(json.loads(done.stdout.splitlines()[-1]), store=store)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def test_nothing_is_lost_whichever_disk_is_full(said: dict[str, Any]):
    account = said["account"]
    assert account["sent"] == account["stored"] + account["undone"] > 100
    assert (account["lost"], account["duplicated"], account["out_of_order"]) == (0, 0, 0)
    assert account["maps_equal"] is True


def test_a_server_on_a_full_disk_acknowledges_nothing_and_says_why(said: dict[str, Any]):
    server = said["server"]
    assert server["runs"] is True and server["acknowledged while full"] == 0
    why = {"sqlite": "map store: the disk is full", "postgresql": "No space left on device"}[said["store"]]
    assert why in server["event"] and "\n" not in server["event"]


@pytest.mark.parametrize("process", ["server", "robot"])
def test_a_full_disk_is_one_line_and_so_is_that_it_has_room(said: dict[str, Any], process: str):
    """Which disk, and what to do; whatever else is not written, as the history and what a restart spares."""
    (line,), (again,) = said[process]["lines"], said[process]["room again"]
    assert said[process]["lines after"] == [line], "also behind the recovery"
    if process == "server" and said["store"] == "postgresql":
        assert "postgresql://" in line and "map store" in line
    else:
        assert "make room, and what waits is written" in line
        assert f"(mounted at {said['disks'][process]})" in line
    assert again.endswith("what waited is written")


def test_a_server_that_is_killed_on_a_full_disk_has_what_it_acknowledged(said: dict[str, Any]):
    assert said["server"]["missing after kill"] == 0
    assert said["server"]["started full"] is True


def test_a_full_disk_of_the_write_ahead_log_ends_postgresql_and_no_server(said: dict[str, Any]):
    if said["store"] == "sqlite":
        pytest.skip("a file has no such disk")
    assert said["log"]["runs"] is True and said["log"]["acknowledged while full"] == 0
    assert "the map store cannot be used" in said["log"]["event"]


def test_a_server_does_not_start_on_a_read_only_disk(said: dict[str, Any]):
    if said["store"] == "postgresql":
        pytest.skip("PostgreSQL itself does not start there")
    (line,) = said["read-only"]["lines"]
    assert "the disk is read-only" in line
    assert said["read-only"]["status"] == 1 and said["read-only"]["show"] == 0

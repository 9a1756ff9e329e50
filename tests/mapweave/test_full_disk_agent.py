"""`mapweave agent` on a full disk, as a process: it maps on, says so once, and what is stored is kept."""

import json
import os
import sys
from pathlib import Path
from typing import Any

import pytest

from mapweave.exit_status import FAILED
from tests.disks import own_mounts
from tests.programs import ran

pytestmark = [pytest.mark.slow, pytest.mark.waits, pytest.mark.timeout(600)]


@pytest.fixture(scope="module")
def said(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What was seen of a robot whose disk is full now and then."""
    folder = tmp_path_factory.mktemp("robot")
    program = [*own_mounts(), sys.executable, "-m", "tests.mapweave.full_disk_agent"]
    done = ran(*program, folder, timeout=550, cwd=Path(__file__).parents[2], env=dict(os.environ))
    assert done.returncode == 0, done.stderr + (folder / "logs" / "r0.log").read_text(errors="replace")
    return dict(json.loads(done.stdout.splitlines()[-1]))


def about_disks(lines: list[str]) -> list[str]:
    """Which disk is full or has room again, of each line that says so."""
    return [line.split(" ", 2)[2].split("; ")[0] for line in lines if "the disk " in line]


def test_it_maps_on_and_says_once_which_disk_is_full_and_once_that_it_has_room(said: dict[str, Any]):
    full, journal = said["full"], f"{said['disk']}/r0.sqlite"
    assert full["new while full"] >= 3
    assert (
        full["failure"] == f"{journal}: agent journal: the disk is full; make room, and what waits is written"
    )
    line = f"{journal}: the disk is full (mounted at {said['disk']})"
    assert about_disks(full["lines"]) == [line]
    assert about_disks(full["lines after"]) == [line, f"{journal}: the disk has room again"]
    assert not any(line.startswith("Traceback") for line in full["lines after"])


def test_lost_on_a_full_disk_it_waits_until_it_can_begin_a_map(said: dict[str, Any]):
    full, room = about_disks(said["lost"]["lines"])
    assert full.endswith(f": the disk is full (mounted at {said['disk']})")
    assert room.endswith("r0.sqlite: the disk has room again")


def test_ended_on_a_full_disk_it_says_what_is_lost(said: dict[str, Any]):
    ended = said["ended"]
    assert ended["status"] == FAILED
    assert any(line.endswith(" changes never reached the disk") for line in ended["lines"])
    assert "cannot be written (the disk is full; " in ended["lines"][-1] and len(ended["lines"]) == 3


def test_the_server_has_just_what_the_robots_disk_has(said: dict[str, Any]):
    assert [*said["maps"]] == ["r0.1", "r0.2"]
    assert all(one["same"] and one["nodes"] >= 3 for one in said["maps"].values())

"""Child processes: none is left behind, whatever happens to their parent."""

import os
import shutil
import signal
import subprocess
import sys
import threading
from argparse import Namespace
from pathlib import Path

import pytest

from mapweave.processes import parent_watchdog
from mapweave.scenarios.children import ChildFailed, Children, free_port
from tests.quick import first_quick
from tests.waiting import eventually

PARENT = """
import sys, time
from pathlib import Path
from mapweave.scenarios.children import Children
folder, endpoint = Path(sys.argv[1]), sys.argv[2]
children = Children(folder)
children.start("server", ["server", "--listen", endpoint, "--data", str(folder)])
print(children.pid("server"), flush=True)
time.sleep(60.0)
"""


def said(folder: Path) -> str:
    log = folder / "server.log"
    return log.read_text() if log.exists() else ""


def runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    # An orphan may stay as a zombie until it is reaped.
    state = Path(f"/proc/{pid}/stat")
    return not state.exists() or state.read_text().rpartition(")")[2].split()[0] != "Z"


@pytest.mark.parametrize("how", first_quick([signal.SIGKILL, signal.SIGTERM], 1))
def test_children_of_a_process_that_is_killed_end_by_themselves(tmp_path, how: signal.Signals):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    command = [sys.executable, "-c", PARENT, str(tmp_path), endpoint]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        try:
            eventually(lambda: "listens at" in said(tmp_path))
            assert runs(child)
        finally:
            parent.send_signal(how)
    eventually(lambda: not runs(child))
    assert "Traceback" not in said(tmp_path)


@pytest.mark.slow
def test_a_child_is_ended_and_a_failed_one_is_reported(tmp_path):
    with Children(tmp_path) as children:
        children.start(
            "server", ["server", "--listen", f"tcp/127.0.0.1:{free_port()}", "--data", str(tmp_path)]
        )
        eventually(lambda: "listens at" in said(tmp_path))
        children.check()
        pid = children.pid("server")
        children.end("server")
        assert not runs(pid)
        children.start("wrong", ["map", "show", str(tmp_path / "none.mapweave")])
        with pytest.raises(ChildFailed, match=r"wrong ended with status 1: mapweave: .*none\.mapweave"):
            eventually(children.check)


LAST = """
import signal, sys, time
from pathlib import Path
folder, name = Path(sys.argv[1]), sys.argv[2]
def end(*_):
    (folder / f"{name}.asked").touch()
    while len(list(folder.glob("*.asked"))) < 3:
        time.sleep(0.01)
    print("all were asked", flush=True)
    sys.exit()
signal.signal(signal.SIGTERM, end)
print("ready", flush=True)
time.sleep(60.0)
"""
"""A child that ends only once all three have been asked to."""


def test_children_are_asked_to_end_before_any_is_waited_for(tmp_path, monkeypatch):
    """One after the other took as long as all of them together."""
    popen, command, names = subprocess.Popen, [sys.executable, "-c", LAST, str(tmp_path)], ["a", "b", "c"]
    monkeypatch.setattr(subprocess, "Popen", lambda args, **more: popen([*command, *args[3:]], **more))
    with Children(tmp_path) as children:
        for name in names:
            children.start(name, [name])
        logs = [tmp_path / f"{name}.log" for name in names]
        eventually(lambda: all("ready" in log.read_text() for log in logs))
        pids = [children.pid(name) for name in names]
        children.end(*names, "none", patience=30.0)
        assert not any(runs(pid) for pid in pids)
    assert all("all were asked" in log.read_text() for log in logs)


def test_the_stdin_of_all_others_means_nothing(monkeypatch):
    monkeypatch.delenv(parent_watchdog.NAME, raising=False)
    stop = threading.Event()
    parent_watchdog.hold(stop)
    assert not stop.wait(0.2)
    assert "parent watchdog" not in {thread.name for thread in threading.enumerate()}


def test_a_child_whose_output_finds_no_room_on_the_disk(tmp_path, monkeypatch):
    """It was said to have printed nothing, though it had said why it ended."""
    with Children(tmp_path) as children:
        children.start("server", ["no such command"])
        eventually(lambda: "no command" in said(tmp_path))
        os.waitid(os.P_PID, children.pid("server"), os.WEXITED | os.WNOWAIT)
        # As on a disk that takes no line.
        (tmp_path / "server.log").write_text("")
        with pytest.raises(ChildFailed, match=r"status 2: it printed nothing \("):
            children.check()
        monkeypatch.setattr(shutil, "disk_usage", lambda _: Namespace(total=10**9, used=10**9, free=0))
        with pytest.raises(ChildFailed, match="it printed nothing; the disk is full; make room"):
            children.check()

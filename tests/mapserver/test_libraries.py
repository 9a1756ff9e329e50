"""Libraries that take long to import are loaded behind the reading of the store, one after the other."""

import sys
import threading

import pytest

from mapweave.hybridmap.errors import InvalidFile
from mapweave.mapserver import libraries, server
from mapweave.mapserver.libraries import SLOW, library_jobs
from mapweave.mapserver.server import MapServer
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub


def test_all_are_loaded_and_the_kernels_behind_them(monkeypatch):
    loaded: list[str] = []
    monkeypatch.setattr(libraries, "import_module", loaded.append)
    monkeypatch.setattr(libraries.jit, "load", lambda: loaded.append("kernels"))
    for job in library_jobs():
        job()
    assert loaded == [*SLOW, "kernels"]


def test_a_server_loads_all_of_them(hub: MemoryHub, tmp_path):
    with MapServer(MemoryBus(hub), Keys("fleet"), tmp_path / "s0.sqlite", "s0") as running:
        assert running.settle(60)
        assert set(SLOW) <= sys.modules.keys()


def test_a_server_that_is_stopped_meanwhile_ends_without_the_rest(hub: MemoryHub, tmp_path, monkeypatch):
    """It was one job, and who stopped a server at its start waited for two seconds of it."""
    began, more, ran = threading.Event(), threading.Event(), list[int]()

    def first() -> None:
        began.set()
        more.wait(0.5)

    monkeypatch.setattr(server, "library_jobs", lambda: [first, lambda: ran.append(2), lambda: ran.append(3)])
    with MapServer(MemoryBus(hub), Keys("fleet"), tmp_path / "s0.sqlite", "s0"):
        assert began.wait(30)
    assert not ran


def test_a_server_whose_start_fails_leaves_nothing_running(hub: MemoryHub, tmp_path, monkeypatch):
    """The process aborted behind its message when the interpreter ended within such a library."""

    def fail(*parts: object, **named: object) -> None:
        raise InvalidFile("the database system is starting up")

    before = set(threading.enumerate())
    bus = MemoryBus(hub)
    with monkeypatch.context() as patch:
        patch.setattr(server, "Ingest", fail)
        with pytest.raises(InvalidFile, match="starting up"), MapServer(bus, Keys(), tmp_path / "s", "s0"):
            raise AssertionError
    left = {thread.name for thread in set(threading.enumerate()) - before}
    assert not left & {"background", "periodic"}
    # Nor does it hold its store.
    with MapServer(bus, Keys(), tmp_path / "s", "s0") as running:
        assert running.settle(60)

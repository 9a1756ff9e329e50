"""Two map servers of one name in one fleet: the second is refused, and where they meet later both say so."""

import logging
from collections.abc import Iterator

import pytest

from mapweave.exit_status import FAILED
from mapweave.hybridmap.errors import SettingsError
from mapweave.processes.server_name import NameWatch, refuse_second
from mapweave.wire.bus import Bus, Request
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.zenoh_bus import ZenohBus
from tests.mapweave.command_line import complaint
from tests.programs import python
from tests.waiting import eventually, free_port

KEYS = Keys("fleet")


@pytest.fixture
def hub() -> Iterator[MemoryHub]:
    yield MemoryHub()


def answers(bus: Bus, name: str) -> object:
    """As a server of this name does."""

    def reply(request: Request) -> None:
        request.reply(b"")

    return bus.serve(KEYS.server_status(name), reply)


def test_a_second_server_of_one_name_is_refused(hub: MemoryHub):
    first, second = MemoryBus(hub), MemoryBus(hub)
    refuse_second(second, KEYS, "s0", patience=0.01)
    answers(first, "s0")
    with pytest.raises(
        SettingsError, match="server s0 of fleet fleet is on this network already: end it, or"
    ):
        refuse_second(second, KEYS, "s0")
    refuse_second(second, KEYS, "s1", patience=0.01)


def test_servers_of_one_name_that_meet_later_say_so_once(hub: MemoryHub, caplog):
    caplog.set_level(logging.INFO, "mapweave.processes")
    own, other = MemoryBus(hub), MemoryBus(hub)
    answers(own, "s0")
    answers(other, "s1")
    watch = NameWatch(own, KEYS, "s0", first=0.01, every=0.01)
    try:
        service = other.serve(KEYS.server_status("s0"), lambda request: request.reply(b""))
        eventually(lambda: "another map server s0 of fleet fleet answers" in caplog.text)
        service.close()
        eventually(lambda: "no other map server s0 answers any more" in caplog.text)
    finally:
        watch.close()
    assert len(caplog.messages) == 2
    assert "end one of them, and start it again with another --name" in caplog.messages[0]


def test_the_command_ends_before_it_serves_under_the_name(tmp_path, capfd, signals: None):
    """As a client of the router, and as a router that joins it."""
    at = f"tcp/127.0.0.1:{free_port()}"
    bus = ZenohBus(BusSettings(mode="router", listen=(at,)))
    try:
        answers(bus, "s0")
        for more in ([], ["--listen", f"tcp/127.0.0.1:{free_port()}"]):
            words = ["server", "--fleet", "fleet", "--connect", at, "--data", tmp_path / "data", *more]
            assert "is on this network already" in complaint(capfd, *words, status=FAILED)
    finally:
        bus.close()
    assert not (tmp_path / "data").exists()


def test_a_server_looks_for_another_one_while_it_loads_its_libraries(tmp_path):
    """The look takes a third of a second, and the libraries take longer; it was a third of a restart."""
    code = (
        "import sys, threading\n"
        "class Look:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'mapweave.mapserver.base_map':\n"
        "            sys.exit(sum(one.name.startswith('server name') for one in threading.enumerate()))\n"
        "sys.meta_path.insert(0, Look())\n"
        "from mapweave.cli import main\n"
        f"main(['server', '--data', {str(tmp_path)!r}, '--connect', 'tcp/127.0.0.1:{free_port()}'])\n"
    )
    done = python("-c", code)
    assert done.returncode == 1, done.stderr

"""A running router with keys that come and go."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from mapweave.identities.authority import Authority, Issued
from mapweave.identities.key_file import read_key_file
from mapweave.identities.key_folder import KeyFolder, Profile
from mapweave.identities.key_renewal import KeyRenewal
from mapweave.wire.bus import Request
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.credentials import Credentials, Role
from mapweave.wire.keys import Keys
from mapweave.wire.senders import sent_by, sent_by_any
from mapweave.wire.zenoh_bus import ZenohBus
from tests.waiting import eventually, free_port

KEYS = Keys("demo")


@dataclass
class Running:
    """A router that takes note of its keys."""

    folder: KeyFolder
    router: ZenohBus
    renewal: KeyRenewal
    said: list[str]
    own: list[Credentials]
    clients: list[ZenohBus] = field(default_factory=list)

    def join(self, credentials: Credentials) -> ZenohBus:
        endpoints = self.folder.catalogue.endpoints
        bus = ZenohBus(BusSettings(endpoints=endpoints, credentials=credentials))
        self.clients.append(bus)
        return bus

    def key_of(self, name: str) -> Credentials:
        return read_key_file(self.folder.key_file(name)).credentials


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Running]:
    port = free_port()
    folder = KeyFolder.create(tmp_path / "keys", "demo", Profile.PRODUCTION, [], "s0", port)
    for name in ("r0", "r1"):
        folder.add(name, Role.ROBOT)
    settings = folder.router("s0", folder.catalogue.endpoints)
    router, said, own = ZenohBus(settings), list[str](), list[Credentials]()
    router.serve(sent_by_any(KEYS.route("s0")), lambda request: answer(request))
    renewal = KeyRenewal(router, KeyFolder(folder.path), "s0", settings, said.append, own.append)
    running = Running(folder, router, renewal, said, own)
    yield running
    for bus in (*running.clients, router):
        bus.close()


def answer(request: Request) -> None:
    request.reply(b"yes")


def answered(bus: ZenohBus, name: str) -> bool:
    return any(reply.payload == b"yes" for reply in bus.ask(sent_by(KEYS.route("s0"), name), b"", 1.0))


def test_revocations_hold_also_without_a_key_of_the_server(running: Running):
    """The old rules stayed, for ever, once the server's own key was revoked."""
    stolen = running.key_of("r1")
    r0, r1 = running.join(running.key_of("r0")), running.join(stolen)
    eventually(lambda: answered(r0, "r0") and answered(r1, "r1"))
    running.folder.revoke("s0", force=True)
    running.renewal.check()
    running.folder.revoke("r1")
    running.renewal.check()
    running.renewal.check()
    assert [line for line in running.said if "no good key of its own" in line] == [
        "the server has no good key of its own, and goes on with the one that it had: s0 has no key here; "
        "make one with `mapweave keys add s0 --role server`"
    ]
    assert sum("the keys have changed" in line for line in running.said) == 2
    again = running.join(stolen)
    assert again.wait_connected(20)
    eventually(lambda: answered(r0, "r0"))
    assert not answered(again, "r1") and not answered(r1, "r1")


def test_a_server_takes_its_new_key_when_that_can_be_read(running: Running):
    before = running.key_of("s0")
    running.folder.revoke("s0", force=True)
    running.renewal.check()
    assert running.own == [before]
    new = running.folder.add("s0", Role.SERVER)
    new.chmod(0o644)
    running.renewal.check()
    assert running.own[-1] == before and "chmod 600" in running.said[-1]
    new.chmod(0o600)
    running.renewal.check()
    assert running.own[-1] == running.key_of("s0") != before
    said = len(running.said)
    running.renewal.check()
    assert len(running.said) == said
    r0 = running.join(running.key_of("r0"))
    eventually(lambda: answered(r0, "r0"))


@pytest.mark.parametrize(("now", "words"), [
    (timedelta(days=-3), "the certificate of s0 expired on "),
    (timedelta(days=1), "the certificate of s0 holds from "),
])  # fmt: skip
def test_a_server_whose_own_certificate_does_not_hold_says_so_once(
    running: Running, monkeypatch, now: timedelta, words: str
):
    """It was up, and no one could connect: the reason was on the machines of the others alone."""
    running.renewal.check()
    assert not running.said
    issue = Authority.issue

    def issued(self: Authority, name: str, role: Role, life: timedelta, hosts: Iterable[str] = ()) -> Issued:
        return issue(self, name, role, timedelta(days=1), hosts, datetime.now(UTC) + now)

    monkeypatch.setattr(Authority, "issue", issued)
    running.folder.add("s0", Role.SERVER)
    for _ in range(3):
        running.renewal.check()
    (said,) = [line for line in running.said if "do not trust this server" in line]
    assert words in said
    assert not running.join(running.key_of("r0")).wait_connected(0.5)
    monkeypatch.undo()
    running.folder.add("s0", Role.SERVER)
    running.renewal.check()
    assert [line for line in running.said if "do not trust this server" in line] == [said]
    r1 = running.join(running.key_of("r1"))
    eventually(lambda: answered(r1, "r1"))

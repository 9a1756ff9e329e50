"""A running agent whose key file is replaced."""

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from mapweave.hybridmap.ids import MapId
from mapweave.identities.authority import Authority
from mapweave.identities.key_file import KeyFile, read_key_file, write_key_file
from mapweave.identities.key_folder import KeyFolder, Profile
from mapweave.identities.own_key import OwnKey
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.credentials import Credentials, Role
from mapweave.wire.keys import Keys
from mapweave.wire.zenoh_bus import ZenohBus
from tests.waiting import eventually, free_port

KEYS = Keys("demo")
LIFE = timedelta(seconds=2.5)
SELDOM = 3600.0
"""s; the test looks itself."""


class Enrolled:
    """A router with keys, and where a robot keeps its own."""

    def __init__(self, folder: Path) -> None:
        self.keys = KeyFolder.create(folder / "keys", "demo", Profile.PRODUCTION, [], "s0", free_port())
        for name in ("r0", "r1"):
            self.keys.add(name, Role.ROBOT)
        endpoints = self.keys.catalogue.endpoints
        self.router = ZenohBus(self.keys.router("s0", endpoints))
        self.path, self.said = folder / "r0.key.toml", list[str]()
        self.good = read_key_file(self.keys.key_file("r0"))

    def short_lived(self, since: timedelta = timedelta()) -> Credentials:
        """A key of the same robot that ends soon, or has ended."""
        good = self.good.credentials
        issued = Authority(good.authority, (self.keys.path / "authority.key").read_text()).issue(
            "r0", Role.ROBOT, LIFE, now=datetime.now(UTC) - since
        )
        return Credentials("r0", Role.ROBOT, good.authority, issued.certificate, issued.private_key)

    def put(self, credentials: Credentials) -> None:
        """Copy a key to the robot."""
        write_key_file(self.path, KeyFile("demo", self.good.endpoints, credentials))

    def start(self, credentials: Credentials, every: float) -> tuple[ZenohBus, OwnKey]:
        """The robot's connection with that key."""
        self.put(credentials)
        bus = ZenohBus(BusSettings(endpoints=self.good.endpoints, credentials=credentials))
        return bus, OwnKey(bus, self.path, credentials, self.said.append, every)


@pytest.fixture
def enrolled(tmp_path: Path) -> Iterator[Enrolled]:
    enrolled = Enrolled(tmp_path)
    yield enrolled
    enrolled.router.close()


def test_a_robot_goes_on_with_the_key_that_is_copied_to_it(enrolled: Enrolled):
    """It was cut off for good once its certificate had expired, until its agent was started again."""
    alive: dict[str, bool] = {}
    enrolled.router.watch(KEYS.agents_alive(), alive.__setitem__)
    bus, own = enrolled.start(enrolled.short_lived(), 0.1)
    try:
        bus.announce(KEYS.agent_alive(MapId("r0", 1)))
        bus.serve(KEYS.agent_status("r0"), lambda request: request.reply(b"here"))
        assert bus.wait_connected(10)
        eventually(lambda: not bus.connected(), 15)
        enrolled.put(enrolled.good.credentials)
        eventually(lambda: enrolled.router.ask(KEYS.agent_status("r0"), b"", 1.0))
        eventually(lambda: [*alive.values()] == [True])
        assert enrolled.said == ["has a new key: it connects again"]
    finally:
        own.close()
        bus.close()


def test_what_is_no_better_key_is_not_taken(enrolled: Enrolled):
    good = enrolled.good.credentials
    bus, own = enrolled.start(good, SELDOM)
    try:
        assert bus.wait_connected(10)
        enrolled.put(read_key_file(enrolled.keys.key_file("r1")).credentials)
        own.check()
        enrolled.put(enrolled.short_lived(since=timedelta(days=1)))
        own.check()
        enrolled.path.write_text("half of")
        own.check()
        own.check()
        enrolled.path.unlink()
        own.check()
        words = (
            "is the key of robot r1", "the certificate of r0 expired on ", "it is no key file, or not whole",
            "no such key file",
        )  # fmt: skip
        assert len(enrolled.said) == len(words)
        for said, part in zip(enrolled.said, words, strict=True):
            assert said.startswith("goes on with the key that it had: ") and part in said
        enrolled.put(good)
        own.check()
        assert len(enrolled.said) == len(words) and bus.connected()
    finally:
        own.close()
        bus.close()


def test_a_key_that_comes_while_there_is_no_router_is_used_once_there_is(enrolled: Enrolled):
    settings = enrolled.keys.router("s0", enrolled.keys.catalogue.endpoints)
    enrolled.router.close()
    stranger = KeyFolder.create(enrolled.path.parent / "others", "demo", Profile.PRODUCTION, [], "s0", 1)
    bus, own = enrolled.start(read_key_file(stranger.add("r0", Role.ROBOT)).credentials, SELDOM)
    try:
        enrolled.put(enrolled.good.credentials)
        own.check()
        enrolled.router = ZenohBus(settings)
        assert bus.wait_connected(10)
    finally:
        own.close()
        bus.close()

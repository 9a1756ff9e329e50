"""Who may do what on a router with keys: separate sessions over real TLS, and over TCP with passwords.

Denials are observed at the other end: there is a listener that may hear the message, and that hears what is
allowed before and after.
"""

import logging
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from mapweave.commands.network import server_settings
from mapweave.hybridmap.errors import InvalidValue, SettingsError
from mapweave.hybridmap.ids import MapId
from mapweave.identities.authority import Authority
from mapweave.identities.key_file import read_key_file
from mapweave.identities.key_folder import KeyFolder, Profile
from mapweave.settings import NetworkSettings
from mapweave.wire.access_rules import ASKS, COMMANDS, OF_ROBOTS, SIGNED
from mapweave.wire.bus import Request
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.credentials import Credentials, Role
from mapweave.wire.keys import Keys
from mapweave.wire.senders import sent_by, sent_by_any, serve_senders
from mapweave.wire.zenoh_bus import ZenohBus
from mapweave.wire.zenoh_entities import Queryable, Service
from tests.waiting import eventually, free_port

KEYS = Keys("demo")
SOON = 1.0
"""s in which a question is answered; what is denied takes as long."""


class Fleet:
    """A router with keys, and sessions of its members."""

    def __init__(self, folder: Path, profile: Profile) -> None:
        port = free_port()
        self.folder = KeyFolder.create(folder, "demo", profile, [], "s0", port)
        self.endpoint = self.folder.catalogue.endpoints[0]
        for name, role in (
            ("r0", Role.ROBOT), ("r1", Role.ROBOT), ("anna", Role.OPERATOR), ("bob", Role.VIEWER),
        ):  # fmt: skip
            self.folder.add(name, role)
        self.router = ZenohBus(self.folder.router("s0", [self.endpoint]))
        self.open: list[ZenohBus] = []

    def join(self, name: str) -> ZenohBus:
        return self.join_as(read_key_file(self.folder.key_file(name)).credentials)

    def join_as(self, credentials: Credentials | None, connected: bool = True) -> ZenohBus:
        bus = ZenohBus(BusSettings(endpoints=(self.endpoint,), credentials=credentials))
        self.open.append(bus)
        assert not connected or bus.wait_connected(10)
        return bus

    def renew(self) -> None:
        """As the server does when the keys have changed."""
        self.router.reopen(self.folder.router("s0", [self.endpoint]))

    def close(self) -> None:
        for bus in (*self.open, self.router):
            bus.close()


@pytest.fixture(params=list(Profile))
def fleet(request: pytest.FixtureRequest, tmp_path: Path, opened) -> Fleet:
    return opened(Fleet(tmp_path / "keys", request.param))


@pytest.fixture
def certified(tmp_path: Path, opened) -> Fleet:
    return opened(Fleet(tmp_path / "keys", Profile.PRODUCTION))


def answer(request: Request) -> None:
    request.reply(b"yes")


def claim(bus: ZenohBus, key: str) -> None:
    """Answer under exactly this key: a bus by itself declares another one, for all questions to a robot."""
    queryable = Queryable(bus.owner, key)
    queryable.add(Service(queryable, key, answer))
    bus.declare(queryable)


def asked(bus: ZenohBus, key: str) -> bool:
    return any(reply.payload == b"yes" for reply in bus.ask(key, b"", SOON))


def test_a_robot_writes_under_its_own_name_alone(fleet: Fleet):
    got: list[str] = []
    fleet.router.subscribe("mapweave/**", lambda sample: got.append(sample.key))
    r0 = fleet.join("r0")
    own = [KEYS.change(MapId("r0", 1)), KEYS.head(MapId("r0", 1)), KEYS.agent_status("r0")]
    forged = [
        KEYS.change(MapId("r1", 1)), KEYS.head(MapId("r1", 1)), KEYS.agent_status("r1"), KEYS.ack("s0", "r0"),
        KEYS.ack("s0", "r1"), KEYS.poses("s0", "r1"), KEYS.server_status("s0"),
    ]  # fmt: skip

    def all_own() -> bool:
        for key in (*own, *forged):
            r0.publish(key, b"x")
        return set(own) <= set(got)

    eventually(all_own)
    assert not set(forged) & set(got)


def test_a_robot_hears_what_is_for_it_alone(fleet: Fleet):
    r0, r1 = fleet.join("r0"), fleet.join("r1")
    got: list[str] = []
    for pattern in (KEYS.acks("r0"), KEYS.acks("r1"), "mapweave/**", KEYS.changes(), KEYS.agent_statuses()):
        r0.subscribe(pattern, lambda sample: got.append(sample.key))

    def delivered() -> bool:
        r1.publish(KEYS.change(MapId("r1", 1)), b"x")
        r1.publish(KEYS.agent_status("r1"), b"x")
        fleet.router.publish(KEYS.ack("s0", "r1"), b"x")
        fleet.router.publish(KEYS.poses("s0", "r1"), b"x")
        fleet.router.publish(KEYS.ack("s0", "r0"), b"x")
        return bool(got)

    eventually(delivered)
    assert set(got) == {KEYS.ack("s0", "r0")}


def test_a_robot_cannot_be_alive_or_answer_as_another(fleet: Fleet):
    alive: list[str] = []
    fleet.router.watch(KEYS.agents_alive(), lambda key, is_alive: alive.append(key) if is_alive else None)
    r0 = fleet.join("r0")
    r0.announce(KEYS.agent_alive(MapId("r1", 1)))
    r0.announce(KEYS.agent_alive(MapId("r0", 1)))
    of_others = [KEYS.log(MapId("r1", 1)), KEYS.agent_status("r1"), sent_by(KEYS.mission("r1"), "anna")]
    of_server = [sent_by(question, "r1") for question in (KEYS.relocalize("s0"), KEYS.route("s0"))]
    for key in (*of_others, *of_server, KEYS.relocalize("s0"), KEYS.log(MapId("r0", 1))):
        claim(r0, key)
        r0.serve(key, answer)
    serve_senders(r0, KEYS.mission("r0"), lambda request, who: answer(request))
    serve_senders(r0, KEYS.mission("r1"), lambda request, who: answer(request))
    anna, r1 = fleet.join("anna"), fleet.join("r1")
    eventually(lambda: asked(anna, sent_by(KEYS.mission("r0"), "anna")))
    eventually(lambda: asked(fleet.router, KEYS.log(MapId("r0", 1))))
    eventually(lambda: alive)
    assert alive == [KEYS.agent_alive(MapId("r0", 1))]
    questions = [(anna, key) for key in of_others[1:]]
    questions += [(fleet.router, key) for key in of_others] + [(r1, key) for key in of_server]
    with ThreadPoolExecutor(len(questions)) as pool:
        assert not any(pool.map(lambda one: asked(*one), questions))


IN_ANOTHERS_NAME = {f"{what}/{name}" for what in OF_ROBOTS for name in ("r1", "*")}


@pytest.mark.parametrize(("name", "may"), [
    ("r0", frozenset({"status", *(f"{what}/r0" for what in OF_ROBOTS)})),
    ("bob", frozenset(ASKS) - COMMANDS),
    ("anna", frozenset(ASKS)),
])  # fmt: skip
def test_each_role_asks_what_it_may(certified: Fleet, name: str, may: frozenset[str]):
    asks = {*ASKS, *IN_ANOTHERS_NAME, *(f"{what}/r0" for what in OF_ROBOTS)}
    root = f"{KEYS.root}/server/s0"
    every = {what: sent_by(f"{root}/{what}", name if what in SIGNED else "") for what in asks}
    for what, key in every.items():
        if what in SIGNED or "*" in key or not key.endswith(("/r0", "/r1")):
            certified.router.serve(key, answer)
    bus = certified.join(name)
    eventually(lambda: asked(bus, every["status"]))
    answered: set[str] = set()

    def ask(what: str) -> None:
        if asked(bus, every[what]):
            answered.add(what)

    threads = [threading.Thread(target=ask, args=(what,)) for what in every]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert answered == may


def test_a_viewer_moves_no_robot(fleet: Fleet):
    r0 = fleet.join("r0")
    r0.serve(KEYS.agent_status("r0"), answer)
    commands = KEYS.mission("r0"), KEYS.portal("r0"), KEYS.drive("r0")
    for key in commands:
        serve_senders(r0, key, lambda request, who: answer(request))
    anna, bob = fleet.join("anna"), fleet.join("bob")
    for key in commands:
        eventually(lambda key=key: asked(anna, sent_by(key, "anna")))
    eventually(lambda: asked(bob, KEYS.agent_status("r0")))
    for key in commands:
        assert not any(asked(bob, sent_by(key, who)) for who in ("", "anna", "bob"))
        assert not any(asked(anna, sent_by(key, who)) for who in ("", "bob")), "under her own name alone"


def test_a_robot_moves_no_other(certified: Fleet):
    """Neither by an order nor by a step of the wheels, whatever name it gives."""
    r1 = certified.join("r1")
    orders = KEYS.mission("r1"), KEYS.portal("r1"), KEYS.drive("r1")
    steps = KEYS.robot_describe("r1"), KEYS.robot_step("r1")
    for key in steps:
        r1.serve(key, answer)
    for key in orders:
        serve_senders(r1, key, lambda request, who: answer(request))
    own, anna, r0 = certified.join("r1"), certified.join("anna"), certified.join("r0")
    for key in steps:
        eventually(lambda key=key: asked(own, key))
    for key in orders:
        eventually(lambda key=key: asked(anna, sent_by(key, "anna")))
    forged = [*steps, *(sent_by(key, who) for key in orders for who in ("", "anna", "r0", "r1"))]
    forged += [f"{key}/**" for key in orders]
    with ThreadPoolExecutor(len(forged)) as pool:
        assert not any(pool.map(lambda key: asked(r0, key), forged))


def test_the_views_of_a_robot_are_for_servers_alone(fleet: Fleet):
    """People get them by a server, which checks them; other robots do not get them."""
    alive: list[str] = []
    fleet.router.watch(KEYS.views(), lambda key, is_alive: alive.append(key) if is_alive else None)
    r0 = fleet.join("r0")
    for name in ("r1", "r0"):
        r0.serve(KEYS.view(name), answer)
        r0.announce(KEYS.view(name))
    r0.serve(KEYS.agent_status("r0"), answer)
    eventually(lambda: asked(fleet.router, KEYS.view("r0")) and alive)
    assert alive == [KEYS.view("r0")]
    assert not asked(fleet.router, KEYS.view("r1"))
    for name in ("anna", "bob"):
        bus = fleet.join(name)
        eventually(lambda bus=bus: asked(bus, KEYS.agent_status("r0")))
        assert not asked(bus, KEYS.view("r0"))
    assert not asked(fleet.join("r1"), KEYS.view("r0"))


def test_an_operator_commands_under_the_own_name_alone(fleet: Fleet):
    """Whatever a message says, its key has the name that is recorded; patterns are no way around it."""
    senders: list[tuple[str, str]] = []

    def hear(what: str) -> Callable[[Request, str], None]:
        def handler(request: Request, who: str) -> None:
            senders.append((what, who))
            answer(request)

        return handler

    r0, carl = fleet.join("r0"), read_key_file(fleet.folder.add("carl", Role.OPERATOR)).credentials
    fleet.renew()
    serve_senders(r0, KEYS.mission("r0"), hear("order"))
    serve_senders(r0, KEYS.portal("r0"), hear("portal"))
    for key in (KEYS.constrain("s0"), KEYS.annotate("s0"), KEYS.server_mission("s0")):
        serve_senders(fleet.router, key, hear(key.rpartition("/")[2]))
    anna, second = fleet.join("anna"), fleet.join_as(carl)
    keys = {
        "order": KEYS.mission("r0"), "constrain": KEYS.any_constrain(), "annotate": KEYS.any_annotate(),
        "mission": KEYS.any_mission(), "portal": KEYS.portal("r0"),
    }  # fmt: skip
    for what, key in keys.items():
        eventually(lambda key=key: asked(anna, sent_by(key, "anna")))
        assert set(senders) == {(what, "anna")}
        threads = [
            threading.Thread(target=anna.ask, args=(forged, b"", SOON))
            for forged in (key, *(f"{key}/{end}" for end in ("carl", "s0", "*", "**")))
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert asked(second, sent_by(key, "carl"))
        assert set(senders) == {(what, "anna"), (what, "carl")}
        assert senders.count((what, "carl")) == 1
        senders.clear()


def test_who_has_no_good_key_is_not_let_in(certified: Fleet):
    good = read_key_file(certified.folder.key_file("r0")).credentials
    foreign, _ = Authority.create("demo")
    theirs = foreign.issue("r0", Role.ROBOT, timedelta(days=1))
    own = Authority(good.authority, (certified.folder.path / "authority.key").read_text())
    long_ago = datetime.now(UTC) - timedelta(days=3)
    expired = own.issue("r0", Role.ROBOT, timedelta(days=1), now=long_ago)
    strangers = [
        certified.join_as(None, connected=False),
        *(
            certified.join_as(
                Credentials("r0", Role.ROBOT, good.authority, bad.certificate, bad.private_key),
                connected=False,
            )
            for bad in (theirs, expired)
        ),
    ]
    tcp = certified.endpoint.replace("tls/", "tcp/")
    plain = ZenohBus(BusSettings(endpoints=(tcp,)))
    certified.open.append(plain)
    certified.join("r1")
    assert not any(bus.wait_connected(0.5) for bus in (*strangers, plain))


def test_a_wrong_password_is_not_let_in(tmp_path, caplog, opened):
    caplog.set_level(logging.INFO, "mapweave.wire")
    fleet = opened(Fleet(tmp_path / "keys", Profile.LAB))
    wrong = fleet.join_as(Credentials("r0", Role.ROBOT, password="guessed"), connected=False)
    keyless = fleet.join_as(None, connected=False)
    fleet.join("r0")
    assert not wrong.wait_connected(0.5)
    assert not keyless.wait_connected(0.5)
    # Zenoh does not say whose the password was.
    eventually(lambda: "a client connects from tcp/127.0.0.1:" in caplog.text)
    assert "refused" not in caplog.text


def test_a_robot_is_no_router(certified: Fleet):
    """Its certificate is none of a server, so no client connects to a router that has it."""
    endpoint = f"tls/127.0.0.1:{free_port()}"
    stolen = read_key_file(certified.folder.key_file("r0")).credentials
    false = ZenohBus(BusSettings(mode="router", listen=(endpoint,), credentials=stolen))
    certified.open.append(false)
    victim = ZenohBus(
        BusSettings(
            endpoints=(endpoint,), credentials=read_key_file(certified.folder.key_file("r1")).credentials
        )
    )
    certified.open.append(victim)
    certified.join("r1")
    assert not victim.wait_connected(0.5)


def test_a_key_that_ends_ends_its_connection(certified: Fleet):
    good = read_key_file(certified.folder.key_file("r0")).credentials
    own = Authority(good.authority, (certified.folder.path / "authority.key").read_text())
    soon = own.issue("r0", Role.ROBOT, timedelta(seconds=2.5))
    bus = certified.join_as(Credentials("r0", Role.ROBOT, good.authority, soon.certificate, soon.private_key))
    eventually(lambda: not bus.connected(), 15)
    assert not bus.wait_connected(0.5)


def test_a_revoked_key_is_of_no_use_and_nothing_else_changes(fleet: Fleet, caplog):
    caplog.set_level(logging.INFO, "mapweave.wire")
    stolen = read_key_file(fleet.folder.key_file("r0")).credentials
    got: list[bytes] = []
    fleet.router.subscribe(KEYS.changes(), lambda sample: got.append(sample.payload))
    fleet.router.serve(sent_by_any(KEYS.route("s0")), answer)
    r1 = fleet.join("r1")
    fleet.folder.revoke("r0", "stolen")
    replacement = read_key_file(fleet.folder.add("r0", Role.ROBOT)).credentials
    fleet.renew()
    old = fleet.join_as(stolen, connected=False)
    new = fleet.join_as(replacement)

    def both() -> bool:
        old.publish(KEYS.change(MapId("r0", 1)), b"old")
        new.publish(KEYS.change(MapId("r0", 1)), b"new")
        r1.publish(KEYS.change(MapId("r1", 1)), b"r1")
        return {b"new", b"r1"} <= set(got)

    eventually(both)
    assert b"old" not in got
    assert not asked(old, sent_by(KEYS.route("s0"), "r0"))
    eventually(lambda: asked(r1, sent_by(KEYS.route("s0"), "r1")))
    if fleet.folder.profile is Profile.PRODUCTION:
        eventually(lambda: "refused: r0 at" in caplog.text)
        assert "this key was revoked" in caplog.text
        assert "stolen" in caplog.text


def test_who_was_alive_is_so_after_the_keys_have_changed_unless_revoked(fleet: Fleet):
    alive: set[str] = set()

    def hear(key: str, is_alive: bool) -> None:
        (alive.add if is_alive else alive.discard)(KEYS.parse_agent_alive(key).agent)

    fleet.router.watch(KEYS.agents_alive(), hear)
    for name in ("r0", "r1"):
        fleet.join(name).announce(KEYS.agent_alive(MapId(name, 1)))
    eventually(lambda: alive == {"r0", "r1"})
    fleet.folder.revoke("r1")
    fleet.renew()
    eventually(lambda: alive == {"r0"})


@pytest.mark.parametrize("endpoint", [
    "tcp/0.0.0.0:7447", "tcp/192.168.1.7:7447", "tcp/[::]:7447", "tcp/maps.local:1", "tcp/[fe80::1%lo]:1",
    "tcp/[::ffff:127.0.0.1]:1", "tcp/127.0.0.1:1,tcp/0.0.0.0:1", "tcp/0.0.0.0:1?a=127.0.0.1:1",
])  # fmt: skip
def test_without_keys_a_router_listens_on_its_own_machine_alone(endpoint: str):
    with pytest.raises(SettingsError, match="mapweave keys init"):
        BusSettings(mode="router", listen=(endpoint,))
    BusSettings(mode="router", listen=("tcp/127.0.0.1:7447", "tcp/[::1]:7447", "tcp/localhost:7447"))


def test_without_keys_a_router_takes_no_connections_of_pages_in_a_browser():
    """Pages of any site may open WebSockets to this machine, and Zenoh answered them as all others."""
    with pytest.raises(SettingsError, match="takes no WebSockets"):
        BusSettings(mode="router", listen=("tcp/127.0.0.1:7447", "ws/127.0.0.1:7448"))
    BusSettings(endpoints=("ws/127.0.0.1:7448",))


def test_a_server_with_keys_is_a_client_of_routers(fleet: Fleet):
    """Given routers and not where to listen; robots ask it through the router."""
    fleet.folder.add("s1", Role.SERVER)
    fleet.renew()
    network = NetworkSettings(routers=(fleet.endpoint,), keys=str(fleet.folder.path))
    settings, _ = server_settings(network, "s1")
    assert (settings.mode, settings.endpoints, settings.fleet) == ("client", (fleet.endpoint,), "demo")
    server = ZenohBus(settings)
    fleet.open.append(server)
    server.serve(sent_by_any(KEYS.relocalize("s1")), answer)
    got: list[str] = []
    server.subscribe(KEYS.agent_statuses(), lambda sample: got.append(sample.key))
    r0 = fleet.join("r0")
    eventually(lambda: asked(r0, sent_by(KEYS.relocalize("s1"), "r0")))
    eventually(lambda: r0.publish(KEYS.agent_status("r0"), b"x") or got)


def test_a_server_that_listens_is_a_router():
    listens, joins = ("tcp/127.0.0.1:7448",), ("tcp/127.0.0.1:7447",)
    settings, _ = server_settings(NetworkSettings(endpoints=listens, routers=joins), "s0")
    assert (settings.mode, settings.listen, settings.routers) == ("router", listens, joins)


def test_a_map_server_needs_the_key_of_one(tmp_path):
    """Before, one with a robot's key started, and no robot took anything from it."""
    folder = KeyFolder.create(tmp_path / "keys", "demo", Profile.LAB, [], "s0", 7447)
    with pytest.raises(
        InvalidValue, match="s1 has no key here; make one with `mapweave keys add s1 --role server`"
    ):
        folder.router("s1")
    folder.add("s1", Role.ROBOT)
    with pytest.raises(InvalidValue, match="the key of s1 is that of a robot, and a map server needs"):
        folder.router("s1")
    folder.revoke("s1")
    folder.add("s1", Role.SERVER)
    assert folder.router("s1").mode == "router"


def test_routers_with_passwords_do_not_join(tmp_path):
    """Who connects would not know to which router."""
    folder = KeyFolder.create(tmp_path / "keys", "demo", Profile.LAB, [], "s0", 7447)
    with pytest.raises(SettingsError, match="with certificates, not with the passwords"):
        folder.router("s0", (), ["tcp/127.0.0.1:7448"])


def test_routers_with_keys_join_each_other_and_each_holds_to_the_rules(certified: Fleet):
    """A robot at one router, a server at the other."""
    fleet = certified
    fleet.folder.add("s1", Role.SERVER)
    fleet.renew()
    listen = f"{fleet.endpoint.partition('/')[0]}/127.0.0.1:{free_port()}"
    other = ZenohBus(fleet.folder.router("s1", [listen], [fleet.endpoint]))
    fleet.open.append(other)
    got: list[str] = []
    other.subscribe(KEYS.agent_statuses(), lambda sample: got.append(sample.key))
    other.serve(sent_by_any(KEYS.relocalize("s1")), answer)
    r0 = fleet.join("r0")
    eventually(lambda: asked(r0, sent_by(KEYS.relocalize("s1"), "r0")))
    own, forged = KEYS.agent_status("r0"), KEYS.agent_status("r1")

    def heard() -> bool:
        for key in (forged, own):
            r0.publish(key, b"x")
        return own in got

    eventually(heard)
    assert forged not in got

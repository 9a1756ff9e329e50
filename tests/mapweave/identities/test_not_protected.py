"""What is not protected, as SECURITY.md says: the page must not promise less, or more, than is true."""

import socket
import threading
from contextlib import suppress
from datetime import timedelta
from pathlib import Path

import pytest

from mapweave.hybridmap.ids import MapId
from mapweave.identities.authority import Authority
from mapweave.identities.key_file import read_key_file
from mapweave.identities.key_folder import Profile
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.credentials import Credentials, Role
from mapweave.wire.keys import Keys
from mapweave.wire.senders import sent_by, serve_senders
from mapweave.wire.zenoh_bus import ZenohBus
from tests.mapweave.identities.test_access import Fleet, answer, asked
from tests.waiting import eventually, free_port

KEYS = Keys("demo")
SECRET = b"where the safe is"


@pytest.fixture
def certified(tmp_path: Path, opened) -> Fleet:
    return opened(Fleet(tmp_path / "keys", Profile.PRODUCTION))


class Listener:
    """One in the network between a client and a router, who reads along.

    Attributes:
        port: where clients find it.
        heard: all bytes of both.
    """

    def __init__(self, router: int) -> None:
        self._router, self.heard = router, b""
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listening.getsockname()[1])
        self._open: list[socket.socket] = [self._listening]
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        with suppress(OSError):
            while True:
                client, _ = self._listening.accept()
                router = socket.create_connection(("127.0.0.1", self._router))
                self._open += [client, router]
                for source, sink in ((client, router), (router, client)):
                    threading.Thread(target=self._pass_on, args=(source, sink), daemon=True).start()

    def _pass_on(self, source: socket.socket, sink: socket.socket) -> None:
        with suppress(OSError):
            while piece := source.recv(65536):
                self.heard += piece
                sink.sendall(piece)

    def close(self) -> None:
        for one in self._open:
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()


@pytest.mark.parametrize("profile", list(Profile))
def test_who_listens_reads_a_lab_and_not_a_fleet_with_certificates(profile: Profile, tmp_path, opened):
    fleet = opened(Fleet(tmp_path / "keys", profile))
    scheme, _, place = fleet.endpoint.partition("/")
    listener = opened(Listener(int(place.rpartition(":")[2])))
    key = read_key_file(fleet.folder.key_file("r0")).credentials
    got: list[bytes] = []
    fleet.router.subscribe(KEYS.changes(), lambda sample: got.append(sample.payload))
    robot = opened(ZenohBus(BusSettings(endpoints=(f"{scheme}/127.0.0.1:{listener.port}",), credentials=key)))
    assert robot.wait_connected(10)
    eventually(lambda: robot.publish(KEYS.change(MapId("r0", 1)), SECRET) or SECRET in got)
    assert (SECRET in listener.heard) == (profile is Profile.LAB)
    assert listener.heard


def test_without_keys_any_program_of_this_machine_commands_under_any_name(opened):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    router = opened(ZenohBus(BusSettings(mode="router", listen=(endpoint,))))
    program = opened(ZenohBus(BusSettings(endpoints=(endpoint,))))
    got: list[str] = []
    router.subscribe(KEYS.changes(), lambda sample: got.append(sample.key))
    serve_senders(router, KEYS.mission("r0"), lambda request, who: answer(request))
    assert program.wait_connected(10)
    eventually(lambda: program.publish(KEYS.change(MapId("r1", 1)), b"x") or got)
    assert asked(program, sent_by(KEYS.mission("r0"), "anna"))


def test_who_has_the_key_of_the_authority_is_any_member(certified: Fleet):
    """As root on the machine of the server has it."""
    r0 = certified.join("r0")
    serve_senders(r0, KEYS.mission("r0"), lambda request, who: answer(request))
    good = read_key_file(certified.folder.key_file("r1")).credentials
    authority = Authority(good.authority, (certified.folder.path / "authority.key").read_text())
    made = authority.issue("anna", Role.OPERATOR, timedelta(days=1))
    forged = Credentials("anna", Role.OPERATOR, good.authority, made.certificate, made.private_key)
    bus = certified.join_as(forged)
    eventually(lambda: asked(bus, sent_by(KEYS.mission("r0"), "anna")))


def test_a_robot_learns_whether_others_subscribe_to_its_keys(certified: Fleet):
    """Zenoh tells a publisher, so that it need not send what has no receiver."""
    certified.router.subscribe(KEYS.changes(), lambda sample: None)
    r0 = certified.join("r0")
    with r0.using_session() as session:
        assert session is not None
        heard, unheard = (
            session.declare_publisher(key) for key in (KEYS.change(MapId("r0", 1)), KEYS.agent_status("r0"))
        )
        eventually(lambda: heard.matching_status.matching)
        assert not unheard.matching_status.matching
        heard.undeclare()
        unheard.undeclare()

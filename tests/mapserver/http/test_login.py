"""Who may do what over HTTP on a fleet with keys: tokens, sessions, roles, and pages of other sites.

`TABLE` has every route: a new one is without a line until it is decided who may ask it.
"""

import json
import logging
import select
import socket
import ssl
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from email.message import Message
from pathlib import Path

import pytest
from starlette.exceptions import HTTPException
from starlette.routing import Route, WebSocketRoute
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from mapweave.hybridmap.errors import SettingsError
from mapweave.identities.key_file import read_key_file
from mapweave.identities.key_folder import KeyFolder, Profile
from mapweave.identities.logins import Logins
from mapweave.identities.tokens import TOKENS
from mapweave.mapserver.http import sessions
from mapweave.mapserver.http.places import MOST_AT_ONCE
from mapweave.mapserver.http.rates import MOST_PEOPLE, QUESTIONS, Rates
from mapweave.mapserver.http.reply import PATIENCE
from mapweave.mapserver.http.serving import MAX_WAITING, ConnectionTimeouts
from mapweave.mapserver.http.tls import load, server_context
from mapweave.mapserver.http.web import Questions, Web
from mapweave.mapserver.quotas import BURST
from mapweave.wire.credentials import Role
from tests.mapserver.http.client import ask, raw
from tests.mapserver.stub_services import StubServices, picture
from tests.waiting import eventually

NAMES = {"vera": Role.VIEWER, "otto": Role.OPERATOR, "r0": Role.ROBOT, "s0": Role.SERVER}
READ = {"vera", "otto", "s0"}
COMMAND = {"otto", "s0"}
ANY = {*NAMES}
ALL = {"", *NAMES}
"""Also without a login."""
TABLE: dict[tuple[str, str], set[str]] = {
    ("GET", "/"): ALL, ("GET", "/why"): ALL, ("GET", "/static/{name}"): ALL,
    ("POST", "/login"): ALL, ("POST", "/logout"): ALL, ("GET", "/session"): ANY,
    ("WS", "/live"): READ,
    ("GET", "/status"): ANY, ("GET", "/history"): READ, ("GET", "/explain"): READ, ("GET", "/route"): READ,
    ("GET", "/robots"): READ, ("GET", "/missions"): READ, ("GET", "/map"): READ, ("GET", "/metrics"): READ,
    ("GET", "/nodes/{node}"): READ, ("GET", "/nodes/{node}/view"): READ,
    ("GET", "/annotations"): READ, ("POST", "/annotations"): COMMAND,
    ("GET", "/plan-images/{sha256}.png"): READ,
    ("GET", "/plans"): READ, ("GET", "/plans/{name:path}.png"): READ, ("POST", "/plans"): COMMAND,
    ("GET", "/constraints"): READ, ("POST", "/constraints"): COMMAND,
    ("POST", "/robots/{robot}/{kind}"): COMMAND, ("POST", "/stop"): COMMAND,
    ("POST", "/relocalize"): ANY,
}  # fmt: skip


class Keyed:
    """A server with the keys of a fleet."""

    def __init__(self, folder: Path, services: StubServices, patience: float = PATIENCE) -> None:
        self.folder = KeyFolder.create(folder, "demo", Profile.LAB, ["maps.example"], "s0")
        for name, role in NAMES.items():
            if role is not Role.SERVER:
                self.folder.add(name, role)
        self.tokens = {name: self.folder.token(name, 1.0) for name in NAMES}
        self.web = Web(("127.0.0.1", 0), services, patience, logins=Logins(folder))
        self.site = f"127.0.0.1:{self.web.port}"

    def ask(self, method: str, path: str, name: str = "", body: bytes | None = None, **headers: str) -> int:
        given = {"Authorization": f"Bearer {self.tokens[name]}"} if name else {}
        return ask(self.web, method, path, body, {**given, **named(headers)})[0]

    def log_in(self, token: str, **headers: str) -> tuple[int, Message, dict[str, str]]:
        body = json.dumps({"token": token}).encode()
        status, got, content = ask(
            self.web, "POST", "/login", body, {"Content-Type": "application/json", **named(headers)}
        )
        return status, got, json.loads(content)

    def session(self, name: str) -> dict[str, str]:
        """The cookie of someone who has logged in, and the page's origin."""
        cookie = self.log_in(self.tokens[name])[1]["Set-Cookie"].partition(";")[0]
        return {"Cookie": cookie, "Origin": f"http://{self.site}"}

    def watch(self, **headers: str) -> ClientConnection:
        return connect(f"ws://{self.site}/live", additional_headers=named(headers))


def named(headers: dict[str, str]) -> dict[str, str]:
    return {name.replace("_", "-"): value for name, value in headers.items()}


@pytest.fixture
def keyed(tmp_path: Path, services: StubServices) -> Iterator[Keyed]:
    keyed = Keyed(tmp_path / "keys", services)
    with keyed.web:
        yield keyed


def routes(services: StubServices) -> set[tuple[str, str]]:
    found: set[tuple[str, str]] = set()
    for route in Questions(services, 1.0).app.routes:  # type: ignore[attr-defined]
        match route:
            case WebSocketRoute():
                found.add(("WS", route.path))
            case Route():
                found |= {(method, route.path) for method in (route.methods or set()) - {"HEAD"}}
    return found


def test_every_route_is_in_the_table(services: StubServices):
    assert routes(services) == TABLE.keys()


def test_each_role_may_ask_what_the_table_says(keyed: Keyed):
    """What it may not is refused before anything of the request is looked at."""
    filled = {
        "{node}": "r0.1.1",
        "{name:path}": "flat",
        "{sha256}": "0" * 64,
        "{robot}": "r0",
        "{kind}": "stop",
        "{name}": "page.css",
    }
    for (method, path), may in TABLE.items():
        for chunk, words in filled.items():
            path = path.replace(chunk, words)
        for name in ALL:
            status = watched(keyed, name) if method == "WS" else keyed.ask(method, path, name)
            refused = status == (403 if name else 401)
            assert refused == (name not in may), (method, path, name, status)
            if method == "GET":
                assert keyed.ask("HEAD", path, name) == status


def watched(keyed: Keyed, name: str) -> int:
    given = {"Authorization": f"Bearer {keyed.tokens[name]}"} if name else {}
    try:
        with keyed.watch(**given):
            return 101
    except InvalidStatus as refused:
        return (
            refused.value.response.status_code if hasattr(refused, "value") else refused.response.status_code
        )


def test_a_session_is_a_cookie_that_pages_cannot_read_or_send_elsewhere(keyed: Keyed):
    status, headers, answer = keyed.log_in(keyed.tokens["otto"])
    cookie = headers["Set-Cookie"]
    assert (status, answer) == (200, {"name": "otto", "role": "operator"})
    assert {"HttpOnly", "SameSite=strict", "Path=/"} <= {part.strip() for part in cookie.split(";")}
    assert keyed.tokens["otto"] not in cookie and "Secure" not in cookie
    # A proxy on this machine says that it is asked by HTTPS.
    secure = keyed.log_in(keyed.tokens["otto"], X_Forwarded_Proto="https")[1]["Set-Cookie"]
    assert secure.startswith("__Host-") and "Secure" in secure
    session = keyed.session("otto")
    assert keyed.ask("GET", "/robots", **session) == 200
    assert keyed.ask("POST", "/stop", **session) == 200
    assert keyed.ask("POST", "/logout", **session) == 200
    assert keyed.ask("GET", "/robots", **session) == 401


def test_no_one_chooses_the_secret_of_a_session(keyed: Keyed):
    """Else who has planted a cookie in a browser would share the session of who logs in there."""
    name = keyed.session("otto")["Cookie"].partition("=")[0]
    planted = {"Cookie": f"{name}={'a' * 43}", "Origin": f"http://{keyed.site}"}
    assert keyed.ask("GET", "/robots", **planted) == 401
    cookies = [keyed.log_in(keyed.tokens["otto"], **planted)[1]["Set-Cookie"].partition(";")[0] for _ in "ab"]
    assert len({planted["Cookie"], *cookies}) == 3, "each login has a new one"
    assert keyed.ask("GET", "/robots", **planted) == 401


def test_a_token_in_an_address_lets_no_one_in_and_is_in_no_log(keyed: Keyed, caplog):
    caplog.set_level(logging.DEBUG)
    token = keyed.tokens["otto"]
    for path in (f"/robots?token={token}", f"/robots?access_token={token}", f"/static/{token}"):
        assert keyed.ask("GET", path) in (401, 404)
    with pytest.raises(InvalidStatus), connect(f"ws://{keyed.site}/live?token={token}"):
        pass
    assert keyed.log_in(token)[0] == 200 and keyed.log_in(token + "a")[0] == 401
    said = [one.getMessage() for one in caplog.records if one.name != "websockets.client"]
    assert any("otto logs in" in words for words in said) and not any(token in words for words in said)


@pytest.mark.parametrize("path", ["/stop", "/robots/r0/stop", "/constraints", "/annotations", "/logout"])
def test_a_page_of_another_site_cannot_use_a_session(keyed: Keyed, path: str):
    """As bytes: a browser may be old, and the cookie be sent along in spite of SameSite."""
    session = keyed.session("otto")
    other_port = session["Origin"].rpartition(":")[0] + ":1"
    foreign = ["https://evil.example", "null", other_port, "http://127.0.0.1.evil.example"]
    for origin in (*(f"Origin: {site}\r\n" for site in foreign), ""):
        head = f"POST {path} HTTP/1.1\r\nHost: {keyed.site}\r\nCookie: {session['Cookie']}\r\n{origin}"
        got = raw(keyed.web, f"{head}Content-Type: text/plain\r\nContent-Length: 2\r\n\r\n{{}}".encode())
        assert got.startswith(b"HTTP/1.1 403 "), (origin, got[:80])
    assert keyed.ask("GET", "/robots", **session) == 200, "it is not logged out, either"


def test_a_page_of_another_site_cannot_watch_by_a_session(keyed: Keyed):
    session = keyed.session("vera")
    for headers in ({"Cookie": session["Cookie"]}, {**session, "Origin": "http://evil.example"}):
        with pytest.raises(InvalidStatus) as refused, keyed.watch(**headers):
            pass
        assert refused.value.response.status_code == 403
    with keyed.watch(**session) as watching:
        hello = json.loads(watching.recv(timeout=20))
    assert (hello["name"], hello["role"], hello["commands"]) == ("vera", "viewer", False)
    assert hello["why_not"] == "You are vera, a viewer: missions and corrections need an operator."


def revoke_identity(keyed: Keyed) -> None:
    keyed.folder.revoke("vera", "left")


def revoke_tokens(keyed: Keyed) -> None:
    assert keyed.folder.end_tokens("vera") == 1


def damage_tokens(keyed: Keyed) -> None:
    (keyed.folder.path / TOKENS).write_text("{")


@pytest.mark.parametrize("end", [revoke_identity, revoke_tokens, damage_tokens])
def test_revoking_ends_tokens_sessions_and_viewers_at_once(keyed: Keyed, end: Callable[[Keyed], None]):
    session = keyed.session("vera")
    with keyed.watch(**session) as watching:
        assert json.loads(watching.recv(timeout=20))["name"] == "vera"
        end(keyed)
        assert keyed.ask("GET", "/robots", "vera") == 401
        assert keyed.ask("GET", "/robots", **session) == 401
        with pytest.raises(ConnectionClosed) as closed:
            while True:
                watching.recv(timeout=20)
        assert closed.value.rcvd is not None and closed.value.rcvd.code == 1008
    assert keyed.log_in(keyed.tokens["vera"])[0] == 401
    if end is not damage_tokens:
        assert keyed.ask("GET", "/robots", "otto") == 200


def test_a_token_and_a_session_end_by_themselves(keyed: Keyed, monkeypatch):
    keyed.tokens["vera"] = keyed.folder.token("vera", -1e-6)
    assert keyed.ask("GET", "/robots", "vera") == 401
    now = [0.0]
    open_ones = sessions.Sessions(lambda: now[0])
    secrets = [open_ones.begin(Login) for Login in range(sessions.MOST_SESSIONS + 1)]  # type: ignore[arg-type]
    assert open_ones.find(secrets[0]) is None and open_ones.find(secrets[-1]) is not None
    now[0] = sessions.LIFE
    assert open_ones.find(secrets[-1]) is None


def test_failed_logins_are_limited_and_logged(keyed: Keyed, caplog):
    caplog.set_level(logging.INFO, "mapweave.mapserver")
    assert keyed.log_in(keyed.tokens["otto"])[0] == 200
    answers = [keyed.log_in("mapweave_guess")[0] for _ in range(sessions.MOST_FAILURES + 1)]
    assert answers == [401] * sessions.MOST_FAILURES + [429]
    status, headers, _ = keyed.log_in(keyed.tokens["otto"])
    assert status == 429 and 0 < int(headers["Retry-After"]) <= sessions.WINDOW
    # Another address, as a proxy on this machine tells it.
    assert keyed.log_in(keyed.tokens["otto"], X_Forwarded_For="10.0.0.7")[0] == 200
    assert keyed.ask("GET", "/robots", "otto") == 200, "a script with a good token goes on"
    assert "operator otto logs in from 127.0.0.1" in caplog.text and "refused: a token" in caplog.text
    assert "mapweave_" not in caplog.text
    for scheme in ("Basic abc", "Bearer", "Bearer mapweave_guess", "bearer\tx"):
        assert keyed.ask("GET", "/robots", Authorization=scheme) == 401


def test_what_failed_long_ago_is_forgotten():
    now = [0.0]
    failures = sessions.FailedAttempts(lambda: now[0])
    for _ in range(sessions.MOST_FAILURES):
        failures.add("10.0.0.1")
    assert failures.wait("10.0.0.1") == sessions.WINDOW and failures.wait("10.0.0.2") == 0.0
    now[0] = sessions.WINDOW
    assert failures.wait("10.0.0.1") == 0.0
    for number in range(sessions.MOST_ADDRESSES + 1):
        failures.add(str(number))
    assert len(failures._times) == sessions.MOST_ADDRESSES


def test_addresses_of_one_ipv6_network_are_one():
    """Each of a network's 2^64 addresses had ten attempts of its own, each a line of the log."""
    failures = sessions.FailedAttempts(lambda: 0.0)
    for number in range(sessions.MOST_FAILURES):
        failures.add(f"2001:db8:0:1::{number:x}")
    assert failures.wait("2001:db8:0:1:ffff::1") == sessions.WINDOW == failures.wait("2001:db8:0:1::0%eth0")
    assert failures.wait("2001:db8:0:2::1") == 0.0
    for _ in range(sessions.MOST_FAILURES):
        failures.add("::ffff:10.0.0.1")
    assert failures.wait("10.0.0.1") == sessions.WINDOW and failures.wait("10.0.0.2") == 0.0
    assert failures.wait("no address") == 0.0


@pytest.mark.parametrize("body", [b"{}", b'{"token": 3}', b'{"token": "x", "name": "otto"}', b"\xff", b"[]"])
def test_a_login_that_is_none(keyed: Keyed, body: bytes):
    given = {"Content-Type": "application/json"}
    assert ask(keyed.web, "POST", "/login", body, given)[0] == 400
    assert ask(keyed.web, "POST", "/login", body, {"Content-Type": "text/plain"})[0] == 415
    assert ask(keyed.web, "POST", "/login", body.ljust(2000), given)[0] == 413


def test_the_name_of_the_server_is_known_with_keys(keyed: Keyed):
    assert keyed.ask("GET", "/robots", "vera", Host="maps.example") == 200
    assert keyed.ask("GET", "/robots", "vera", Host="evil.example") == 403


def test_without_keys_this_machine_alone_is_served(services: StubServices, tmp_path):
    for host in ("0.0.0.0", "192.0.2.1", "::", "maps.local"):
        with pytest.raises(SettingsError, match="without keys people are served on this machine alone"):
            Web((host, 0), services)
    lab = Logins(KeyFolder.create(tmp_path / "keys", "demo", Profile.LAB, [], "s0").path)
    with pytest.raises(SettingsError, match="no token may travel unencrypted"):
        Web(("0.0.0.0", 0), services, logins=lab)
    with Web(("127.0.0.1", 0), services) as open_one:
        assert ask(open_one, "POST", "/stop")[0] == 200
        # Other machines that a proxy lets in read.
        forwarded = {"X-Forwarded-For": "10.0.0.7"}
        assert ask(open_one, "GET", "/robots", None, forwarded)[0] == 200
        status, _, content = ask(open_one, "POST", "/stop", None, forwarded)
        assert status == 403 and "server's own machine alone" in json.loads(content)["error"]
        login = ask(open_one, "POST", "/login", b'{"token": "x"}', {"Content-Type": "application/json"})
        assert login[0] == 400 and b"no keys" in login[2]


def test_who_logs_in_over_https_sees_the_certificate_of_the_authority(services: StubServices, tmp_path):
    folder = KeyFolder.create(tmp_path / "keys", "demo", Profile.PRODUCTION, [], "s0")
    folder.add("otto", Role.OPERATOR)
    token, server = folder.token("otto", 1.0), folder.key_file("s0")
    tls = server_context(read_key_file(server).credentials)
    trusting = ssl.create_default_context(cafile=str(folder.path / "authority.pem"))
    # As Python does from 3.13 on.
    trusting.verify_flags |= ssl.VERIFY_X509_STRICT
    with Web(
        ("0.0.0.0", 0), services, limits=ConnectionTimeouts(head=0.5), logins=Logins(folder.path), tls=tls
    ) as web:
        address = f"https://127.0.0.1:{web.port}/status"
        asked = urllib.request.Request(address, headers={"Authorization": f"Bearer {token}"})
        assert json.load(urllib.request.urlopen(asked, context=trusting, timeout=20))["nodes"] == 12
        with pytest.raises(OSError, match="CERTIFICATE_VERIFY_FAILED"):
            urllib.request.urlopen(asked, context=ssl.create_default_context(), timeout=20)
        # A handshake that is never begun, a head that never ends, and what is no HTTP.
        assert raw(web, b"") == b""
        assert encrypted(web, trusting, b"GET /status HTTP/1.1\r\nX: ") == b""
        assert encrypted(web, trusting, b"\x00\x01\r\n\r\n").startswith(b"HTTP/1.1 400")
        eventually(lambda: web.connections == 0)
        folder.add("s0", Role.SERVER)
        load(tls, read_key_file(server).credentials)
        assert json.load(urllib.request.urlopen(asked, context=trusting, timeout=20))["nodes"] == 12


@pytest.mark.parametrize("version", [ssl.TLSVersion.TLSv1, ssl.TLSVersion.TLSv1_1])
@pytest.mark.filterwarnings("ignore:ssl.TLSVersion:DeprecationWarning")
def test_https_is_of_this_day(version: ssl.TLSVersion, services: StubServices, tmp_path):
    """Older versions of TLS, and plain HTTP, are given nothing."""
    folder = KeyFolder.create(tmp_path / "keys", "demo", Profile.PRODUCTION, ["127.0.0.1"], "s0")
    context = server_context(read_key_file(folder.key_file("s0")).credentials)
    old = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    old.check_hostname, old.verify_mode = False, ssl.CERT_NONE
    with Web(("127.0.0.1", 0), services, logins=Logins(folder.path), tls=context) as web:
        with socket.create_connection(("127.0.0.1", web.port)) as tcp, old.wrap_socket(tcp) as tls:
            assert tls.version() in ("TLSv1.2", "TLSv1.3")
        old.set_ciphers("ALL:@SECLEVEL=0")
        old.minimum_version = old.maximum_version = version
        with socket.create_connection(("127.0.0.1", web.port)) as tcp, pytest.raises(ssl.SSLError):
            old.wrap_socket(tcp)
        with socket.create_connection(("127.0.0.1", web.port)) as tcp:
            tcp.settimeout(20)
            tcp.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
            with suppress(ConnectionError):
                assert b"HTTP" not in tcp.recv(1000)


def test_handshakes_that_are_never_begun_make_room(services: StubServices, tmp_path):
    """Hundreds were held until their time was over: with the limit of open files no one else got in."""
    folder = KeyFolder.create(tmp_path / "keys", "demo", Profile.PRODUCTION, [], "s0")
    tls = server_context(read_key_file(folder.key_file("s0")).credentials)
    trusting = ssl.create_default_context(cafile=str(folder.path / "authority.pem"))
    more = 60
    with (
        Web(
            ("127.0.0.1", 0),
            services,
            limits=ConnectionTimeouts(head=120.0),
            logins=Logins(folder.path),
            tls=tls,
        ) as web,
        ExitStack() as opened,
    ):
        half = [
            opened.enter_context(socket.create_connection(("127.0.0.1", web.port), timeout=20))
            for _ in range(MAX_WAITING + more)
        ]
        eventually(lambda: sum(ended(one) for one in half[:more]) == more)
        assert not any(ended(one) for one in half[more:])
        answer = encrypted(web, trusting, b"GET /session HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        assert answer.startswith(b"HTTP/1.1 401 ")


def ended(connection: socket.socket) -> bool:
    """Whether the other side has closed it."""
    poll = select.poll()
    poll.register(connection, select.POLLIN | select.POLLHUP)
    return bool(poll.poll(0))


def encrypted(web: Web, context: ssl.SSLContext, data: bytes) -> bytes:
    with (
        socket.create_connection(("127.0.0.1", web.port), timeout=20) as plain,
        context.wrap_socket(plain, server_hostname="127.0.0.1") as connection,
    ):
        connection.sendall(data)
        got = b""
        try:
            while piece := connection.recv(65536):
                got += piece
        except (ssl.SSLError, ConnectionError):
            pass  # cut off
        return got


def test_one_who_asks_without_end_gets_the_time_to_retry_and_no_other_waits(
    tmp_path, services: StubServices, monkeypatch
):
    """By name, whatever the way of logging in; what costs nothing is not counted."""
    now = 0.0
    monkeypatch.setattr("mapweave.mapserver.http.web.Rates", lambda: Rates(clock=lambda: now))
    keyed = Keyed(tmp_path / "keys", services)
    with keyed.web:
        session = keyed.session("otto")
        for _ in range(round(BURST * QUESTIONS)):
            assert keyed.ask("GET", "/explain", "otto") == 200
        given = {"Authorization": f"Bearer {keyed.tokens['otto']}"}
        status, headers, content = ask(keyed.web, "POST", "/relocalize", picture(), given)
        assert status == 429 and headers["Retry-After"] == "1"
        assert json.loads(content)["error"] == "otto asks more than 2 questions a second: try again in 1 s"
        assert keyed.ask("GET", "/explain", **session) == 429
        assert keyed.ask("GET", "/robots", "otto") == keyed.ask("GET", "/explain", "vera") == 200
        now = 0.6
        assert keyed.ask("GET", "/explain", "otto") == 200
        assert keyed.ask("GET", "/explain", "otto") == 429


@pytest.mark.parametrize(("path", "name"), [("/login", ""), ("/constraints", "otto")])
def test_bodies_that_never_arrive_hold_up_no_other(tmp_path, services: StubServices, path: str, name: str):
    """Neither a stranger's nor a member's: other questions are answered, and other bodies arrive."""
    keyed = Keyed(tmp_path / "keys", services, patience=600.0)
    token = f"Authorization: Bearer {keyed.tokens[name]}\r\n" if name else ""
    head = f"POST {path} HTTP/1.1\r\nHost: {keyed.site}\r\n{token}Content-Type: application/json\r\n"
    with keyed.web, ExitStack() as opened:
        slow = [
            opened.enter_context(socket.create_connection(("127.0.0.1", keyed.web.port), timeout=20))
            for _ in range(MOST_AT_ONCE + 1)
        ]
        for connection in slow:
            connection.sendall(f"{head}Content-Length: 500\r\n\r\n{{".encode())
        assert keyed.ask("GET", "/status", "vera") == 200
        answered = select.select(slow, [], [], 5.0)[0]
        assert answered == slow[:1], "the oldest makes room for the newest"
        assert slow[0].recv(65536).startswith(b"HTTP/1.1 408")
        assert keyed.ask("POST", "/stop", "otto") == 200
        assert keyed.ask("POST", "/relocalize", "vera", picture()) == 200
        assert keyed.log_in(keyed.tokens["vera"])[0] == 200


def test_a_route_counts_as_many_questions_as_it_has_legs(tmp_path, services: StubServices, monkeypatch):
    """Else one question by way of sixteen places would be worth seventeen."""
    now = 0.0
    monkeypatch.setattr("mapweave.mapserver.http.web.Rates", lambda: Rates(clock=lambda: now))
    keyed = Keyed(tmp_path / "keys", services)
    way = "/route?a=r0.1.1&b=r1.1.1" + 15 * "&via=r1.1.7"
    with keyed.web:
        asked = [keyed.ask("GET", way, "otto") for _ in range(4)]
        assert asked == [200, 200, 429, 429]
        assert keyed.ask("GET", way, "vera") == 200
        # A way that is refused takes nothing away from the next attempt, but for itself.
        now = 5.5
        assert keyed.ask("GET", way, "otto") == 200


def test_without_keys_addresses_have_rates():
    now = 0.0
    rates = Rates(clock=lambda: now)

    def admitted(who: str, times: int) -> int:
        count = 0
        for _ in range(times):
            with suppress(HTTPException):
                rates.ask(who)
                count += 1
        return count

    assert admitted("10.0.0.1", 500) == BURST * QUESTIONS
    assert admitted("10.0.0.2", 5) == 5
    total = 0
    for tick in range(100):
        now = 0.1 * (tick + 1)
        total += admitted("10.0.0.1", 3)
    assert abs(total - 10.0 * QUESTIONS) <= 1, "its rate in the long run"
    for k in range(MOST_PEOPLE):
        rates.ask(f"host {k}")
    assert len(rates._buckets) == MOST_PEOPLE

"""Which clients a router with keys refuses, and why: lines of its log in both formats, over real TLS."""

import json
import signal
import socket
import ssl
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from mapweave.identities.authority import Authority
from mapweave.identities.key_file import read_key_file
from mapweave.identities.key_folder import KeyFolder, Profile
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.credentials import Credentials, Role
from mapweave.wire.zenoh_bus import ZenohBus
from tests.waiting import eventually, free_port

FORMATS = pytest.mark.parametrize("log_format", ["text", "json"])


class Router:
    """`mapweave router` with keys, as a process.

    Attributes:
        folder: of its keys; r0 has one.
        good: the key of r0.
        lines: what it has logged so far.
    """

    def __init__(self, folder: Path, log_format: str) -> None:
        self._port, self._path = free_port(), folder / "log.txt"
        self.folder = KeyFolder.create(folder / "keys", "demo", Profile.PRODUCTION, [], "s0", self._port)
        self.folder.add("r0", Role.ROBOT)
        self.good = read_key_file(self.folder.key_file("r0")).credentials
        self._json = log_format == "json"
        words = [sys.executable, "-m", "mapweave", "router", "--keys", "keys", "--log-format", log_format]
        words += ["--listen", f"tls/127.0.0.1:{self._port}"]
        with self._path.open("a") as output:
            self.process = subprocess.Popen(words, stdout=output, stderr=output, cwd=folder)
        eventually(lambda: "router listens" in self._path.read_text())

    def lines(self) -> list[str]:
        """Messages, without their times."""
        lines = self._path.read_text().splitlines()
        if self._json:
            return [json.loads(line)["message"] for line in lines]
        for line in lines:
            datetime.strptime(line[:19], "%Y-%m-%d %H:%M:%S")
        return [line[20:] for line in lines]

    def fields(self) -> list[dict[str, str]]:
        """Of a JSON log."""
        return [json.loads(line) for line in self._path.read_text().splitlines()]

    def connect(self, how: str, credentials: Credentials | None, seconds: float = 0.5) -> bool:
        """A Mapweave client that tries for so long; returns whether it was let in."""
        endpoint = f"{how}/127.0.0.1:{self._port}"
        client = ZenohBus(BusSettings(endpoints=(endpoint,), credentials=credentials))
        try:
            return client.wait_connected(seconds)
        finally:
            client.close()

    def of_another_program(self, authority: str) -> None:
        """A TLS client that trusts the fleet's authority and has no certificate."""
        context = ssl.create_default_context(cadata=authority)
        context.check_hostname = False
        raw = socket.create_connection(("127.0.0.1", self._port))
        with suppress(OSError), context.wrap_socket(raw) as client:
            client.recv(1)

    def end(self) -> None:
        self.process.send_signal(signal.SIGTERM)
        assert self.process.wait(30) == 0


@contextmanager
def running(folder: Path, log_format: str) -> Iterator[Router]:
    router = Router(folder, log_format)
    try:
        yield router
    finally:
        router.process.kill()
        router.process.wait()


def with_certificate(good: Credentials, authority: Authority, age: timedelta = timedelta(0)) -> Credentials:
    """A key of r0 for a day, by an authority, that was made some time ago."""
    issued = authority.issue("r0", Role.ROBOT, timedelta(days=1), now=datetime.now(UTC) - age)
    return Credentials("r0", Role.ROBOT, good.authority, issued.certificate, issued.private_key)


@FORMATS
def test_each_refused_client_is_logged_with_the_reason(log_format: str, tmp_path):
    with running(tmp_path, log_format) as router:
        own = Authority(router.good.authority, (router.folder.path / "authority.key").read_text())
        foreign, _ = Authority.create("demo")
        of_another_name, _ = Authority.create("other")
        reasons = {}

        def refused(reason: str) -> None:
            """And by no other words, whatever was refused before."""
            eventually(lambda: f"refused a client: {reason}" in router.lines())
            new = {line for line in router.lines() if line.startswith("refused a client: ")}
            new = {line for line in new if " more within " not in line} - set(reasons)
            assert new == {f"refused a client: {reason}"}
            reasons[f"refused a client: {reason}"] = True

        router.of_another_program(router.good.authority)
        refused("it has no certificate of this fleet")
        assert not router.connect("tls", None)
        refused("it does not know this fleet's authority: it has no key of this fleet")
        assert not router.connect("tls", with_certificate(router.good, foreign))
        refused("its certificate is of another authority")
        assert not router.connect("tls", with_certificate(router.good, of_another_name))
        assert not router.connect("tls", with_certificate(router.good, own, timedelta(days=3)))
        refused("its certificate has expired")
        assert not router.connect("tls", with_certificate(router.good, own, timedelta(days=-3)))
        refused("its certificate is not valid yet: check clocks")
        assert not router.connect("tcp", None)
        refused("it speaks plain TCP, not TLS")
        router.folder.revoke("r0", "stolen")
        eventually(lambda: "the keys have changed" in " ".join(router.lines()))
        router.connect("tls", router.good, 5.0)
        eventually(lambda: any("this key was revoked" in line for line in router.lines()))
        (revoked,) = {line.partition("revoked")[0] for line in router.lines() if "was revoked" in line}
        assert revoked.startswith("refused: r0 at tls/127.0.0.1:")
        if log_format == "json":
            reported = [line for line in router.fields() if line["message"] in reasons]
            assert {line["level"] for line in reported} == {"warning"}
            assert all(line["message"] == f"refused a client: {line['reason']}" for line in reported)
        router.end()


def test_a_client_that_tries_on_is_counted(tmp_path):
    """It tries each second, for ever."""
    with running(tmp_path, "text") as router:
        assert not router.connect("tcp", None, 2.5)
        reason = "it speaks plain TCP, not TLS"
        eventually(lambda: router.lines()[1:] == [f"refused a client: {reason}"])
        router.end()
        _, first, more = router.lines()
        assert first == f"refused a client: {reason}"
        count, _, rest = more.removeprefix(f"{first} (").partition(" more within ")
        assert int(count) >= 2 and rest.endswith(" s)")

"""`mapweave keys`, and who may read what it writes."""

import base64
import errno
import json
import os
import resource
import socket
import stat
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from cryptography import x509

from mapweave.cli import main
from mapweave.connection import no_server, not_let_in
from mapweave.exit_status import FAILED, NO, USAGE
from mapweave.identities.key_file import read_key_file
from mapweave.identities.key_folder import KeyFolder, Profile
from mapweave.identities.logins import Logins
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.credentials import Role
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from tests.mapweave.command_line import complaint
from tests.programs import ran


@pytest.fixture(params=["production", "lab"])
def keys(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    folder = tmp_path / "keys"
    where = ["--keys", str(folder)]
    assert (
        main(["keys", "init", *where, "--fleet", "f1", "--at", "10.0.0.5", "--profile", request.param]) == 0
    )
    assert main(["keys", "add", "r0", *where]) == 0
    return folder


def test_secrets_are_their_owners_alone(keys: Path):
    public = {"fleet.json", "authority.pem"}
    assert stat.S_IMODE(keys.stat().st_mode) == 0o700
    for path in keys.iterdir():
        assert path.name in public or stat.S_IMODE(path.stat().st_mode) == 0o600, path
    text = (keys / "fleet.json").read_text()
    assert "PRIVATE" not in text
    assert (read_key_file(keys / "r0.key.toml").credentials.password or "PRIVATE") not in text


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root")
def test_what_root_adds_to_a_servers_keys_the_server_can_read(keys: Path):
    """Systemd runs the server as a user of its own, which owns the folder; people add keys with sudo."""
    for path in (keys, *keys.iterdir()):
        os.chown(path, 64_999, 64_998)
    where = ["--keys", str(keys)]
    assert main(["keys", "add", "anna", "--role", "operator", *where]) == 0
    assert main(["keys", "token", "anna", *where]) == 0
    assert main(["keys", "revoke", "r0", *where]) == 0
    owners = {path.name: (path.stat().st_uid, path.stat().st_gid) for path in keys.iterdir()}
    assert {"fleet.json", "tokens.json", "anna.key.toml"} <= owners.keys()
    assert set(owners.values()) == {(64_999, 64_998)}, owners


def test_a_key_file_is_refused_if_others_may_read_it(keys: Path, capfd):
    path = keys / "r0.key.toml"
    path.chmod(0o640)
    assert f"chmod 600 {path}" in complaint(capfd, "status", "--keys", path)
    # The advice was to hide the certificate that all may read.
    authority = path.with_name("others.pem")
    authority.write_text("-----BEGIN CERTIFICATE-----\n")
    authority.chmod(0o644)
    assert "is no key file" in complaint(capfd, "status", "--keys", authority)


def test_a_key_says_where_the_server_is_and_is_for_one_name_and_fleet(keys: Path, capfd, tmp_path):
    path = keys / "r0.key.toml"
    assert "10.0.0.5:7447" in read_key_file(path).endpoints[0]
    assert "is the key of r0, not of r1" in complaint(
        capfd, "agent", "r1", "--keys", path, "--data", tmp_path / "data"
    )
    assert "fleet f1, not of other" in complaint(capfd, "status", "--keys", path, "--fleet", "other")


def test_who_has_a_key_is_listed(keys: Path, capsys):
    where = ["--keys", str(keys)]
    assert main(["keys", "revoke", "r0", "--because", "lost", *where]) == 0
    capsys.readouterr()
    assert main(["keys", "list", "--json", *where]) == 0
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)["identities"]}
    assert (rows["s0"]["role"], rows["s0"]["state"]) == ("server", "good")
    assert rows["r0"]["state"].startswith("revoked 20") and rows["r0"]["state"].endswith("UTC: lost")
    assert not (keys / "r0.key.toml").exists()


def test_a_token_is_shown_once_and_its_hash_alone_is_kept(keys: Path, capfd):
    where = ["--keys", str(keys)]
    assert main(["keys", "token", "r0", *where]) == 0
    token = capfd.readouterr().out.strip()
    assert len(token) > 43 and not any(token in path.read_text() for path in keys.iterdir())
    login = Logins(keys).login(token)
    assert login is not None and (login.name, login.role) == ("r0", Role.ROBOT)
    assert main(["keys", "list", "--json", *where]) == 0
    rows = {row["name"]: row for row in json.loads(capfd.readouterr().out)["identities"]}
    assert len(rows["r0"]["tokens"]) == 1 and rows["s0"]["tokens"] == []
    assert main(["keys", "list", *where]) == 0
    assert f"token of {rows['r0']['tokens'][0]['issued'][:10]}, until 2" in capfd.readouterr().out
    assert main(["keys", "revoke", "r0", "--tokens", *where]) == 0
    assert Logins(keys).login(token) is None and (keys / "r0.key.toml").exists()
    assert "r0 has no token" in complaint(capfd, "keys", "revoke", "r0", "--tokens", *where, status=NO)
    assert "r9 has no good key" in complaint(capfd, "keys", "token", "r9", *where, status=NO)


def test_a_question_with_a_robots_key_is_said_to_need_anothers(keys: Path):
    """The router drops it without a word: it looks like a server that is not there."""
    robot, nowhere = read_key_file(keys / "r0.key.toml").credentials, MemoryBus(MemoryHub())
    assert "its key is a robot's, use a viewer's or an operator's" in str(
        no_server(nowhere, Keys("f1"), robot)
    )
    assert "a robot's" not in str(no_server(nowhere, Keys("f1"), replace(robot, role=Role.VIEWER)))


def test_a_robot_that_is_not_let_in_hears_that_its_key_may_be_no_longer_good(keys: Path):
    """An agent heard that it should use an operator's key."""
    robot = read_key_file(keys / "r0.key.toml").credentials
    with socket.create_server(("127.0.0.1", 0)) as there:
        scheme = "tls" if robot.certified else "tcp"
        endpoint = f"{scheme}/127.0.0.1:{there.getsockname()[1]}"
        advice = not_let_in(BusSettings(endpoints=(endpoint,), credentials=robot))
    assert "or the key of r0 was revoked or has expired: `mapweave keys list`" in advice
    assert "operator" not in advice


@pytest.mark.parametrize("role", ["viewer", "robot"])
@pytest.mark.parametrize("words", [
    "map link r0.1.1 r1.1.1", "map unmerge r0.1 r1.1", "map retire r0.1", "map retire r0.1 --undo",
    "map retire r0.1 --check", "map undo 1", "place add kitchen r0.1.1", "drive r0 --gamepad /dev/null",
])  # fmt: skip
def test_a_command_with_a_viewers_key_is_said_to_need_anothers(keys: Path, words: str, role: str, capfd):
    """The router drops it without a word: it was said that no map server answers."""
    assert main(["keys", "add", "vic", "--role", role, "--keys", str(keys)]) == 0
    said = complaint(capfd, *words.split(), "--keys", keys / "vic.key.toml")
    assert f"this is the key of a {role}: missions and corrections need an operator's" in said


def test_mistakes_are_one_line(keys: Path, tmp_path, capfd):
    where = ("--keys", keys)
    assert "there are keys already" in complaint(capfd, "keys", "init", *where)
    assert "no keys are here" in complaint(capfd, "keys", "list", "--keys", tmp_path)
    assert "r9 has no key" in complaint(capfd, "keys", "revoke", "r9", *where, status=NO)
    assert "r0 is a robot already" in complaint(
        capfd, "keys", "add", "r0", "--role", "viewer", *where, status=NO
    )
    assert main(["keys", "add", "ann", "--role", "operator", *map(str, where)]) == 0
    said = complaint(capfd, "keys", "add", "ann", "--role", "viewer", *where, status=NO)
    assert "ann is an operator already; revoke that key first: mapweave keys revoke ann" in said
    assert "no keys are here" in complaint(capfd, "server", "--keys", tmp_path, "--data", tmp_path / "d")
    fresh = ("--keys", tmp_path / "fresh")
    for host in ('a"b', "a b", "-x", "a/b", ""):
        assert "write a name or an address" in complaint(
            capfd, "keys", "init", *fresh, f"--at={host}", status=USAGE
        )
    assert not (tmp_path / "fresh").exists()
    cut = tmp_path / "cut.key.toml"
    whole = (keys / "r0.key.toml").read_bytes()
    for length in (0, len(whole) // 2):
        cut.touch(mode=0o600)
        cut.write_bytes(whole[:length])
        assert "copy it once more" in complaint(capfd, "status", "--keys", cut)
    (keys / "fleet.json").write_text('{"fleet": 3}')
    assert "fleet.json" in complaint(capfd, "keys", "list", *where)


def test_a_copy_is_the_same_key(keys: Path, tmp_path):
    copy = tmp_path / "r0.key.toml"
    assert main(["keys", "bundle", "r0", "-o", str(copy), "--keys", str(keys)]) == 0
    assert read_key_file(copy) == read_key_file(keys / "r0.key.toml")
    assert stat.S_IMODE(copy.stat().st_mode) == 0o600


def test_no_copy_is_made_of_a_key_that_lets_no_one_in(keys: Path, tmp_path, capsys):
    """What is left in the folder by commands that were killed half-way, and what has expired."""
    copy, left = tmp_path / "copy.key.toml", (keys / "r0.key.toml").read_bytes()
    folder = KeyFolder(keys)
    folder.revoke("r0", "stolen")
    folder.add("r1", Role.ROBOT, days=1e-9)
    for name in ("r0", "r9"):
        (keys / f"{name}.key.toml").write_bytes(left)
        (keys / f"{name}.key.toml").chmod(0o600)
    expected = {"r0": "revoked 20", "r9": "not in the list of identities"}
    if folder.profile is Profile.PRODUCTION:
        expected["r1"] = "expired"
    for name, words in expected.items():
        assert main(["keys", "bundle", name, "-o", str(copy), "--keys", str(keys)]) == NO
        error = capsys.readouterr().err
        assert error.startswith(f"mapweave: the key of {name} is {words}")
        assert f"`mapweave keys add {name} --role robot` makes a new one" in error
        assert not copy.exists()


def test_a_key_that_ends_before_the_one_of_before_does_not_end_that(tmp_path, capsys):
    """The list said that all ended tomorrow, and the router let in the key of before for a year."""
    where = ["--keys", str(tmp_path / "keys")]
    assert main(["keys", "init", *where]) == 0
    assert main(["keys", "add", "r0", *where]) == 0
    folder = KeyFolder(tmp_path / "keys")
    before = folder.find("r0")
    capsys.readouterr()
    assert main(["keys", "add", "r0", "--days", "1", *where]) == 0
    assert f"an earlier key of r0 is good until {before.expires[:10]}" in capsys.readouterr().out
    assert main(["keys", "list", *where]) == 0
    assert f"r0  robot     good, until {before.expires[:10]}" in capsys.readouterr().out
    assert main(["keys", "revoke", "r0", *where]) == 0
    assert main(["keys", "add", "r0", "--days", "1", *where]) == 0
    assert "an earlier key" not in capsys.readouterr().out
    assert folder.changed() and folder.find("r0").expires < before.expires


def test_an_authority_signs_nothing_with_the_key_of_another(tmp_path, capsys):
    """The certificate comes from another backup: who got a key by it was let in nowhere."""
    mine, other = tmp_path / "mine", tmp_path / "other"
    for folder in (mine, other):
        assert main(["keys", "init", "--keys", str(folder)]) == 0
    before = {path.name for path in mine.iterdir()}
    kept = (mine / "authority.pem").read_bytes()
    (mine / "authority.pem").write_bytes((other / "authority.pem").read_bytes())
    capsys.readouterr()
    assert main(["keys", "add", "r0", "--keys", str(mine)]) == FAILED
    assert "authority.pem and authority.key do not belong together" in capsys.readouterr().err
    assert {path.name for path in mine.iterdir()} == before
    (mine / "authority.pem").write_bytes(kept)
    assert main(["keys", "add", "r0", "--keys", str(mine)]) == 0


def test_certificates_are_what_they_say(tmp_path):
    """Read by the library of certificates itself: the chain, the name, what it may be used for, the hosts."""
    assert main(["keys", "init", "--keys", str(tmp_path), "--at", "maps.local", "--at", "10.0.0.5"]) == 0
    folder = KeyFolder(tmp_path)
    authority = x509.load_pem_x509_certificate((tmp_path / "authority.pem").read_bytes())
    for name, role, server in (("r0", Role.ROBOT, False), ("s0", Role.SERVER, True)):
        folder.add(name, role)
        text = read_key_file(folder.key_file(name)).credentials.certificate
        certificate = x509.load_pem_x509_certificate(text.encode())
        certificate.verify_directly_issued_by(authority)
        assert certificate.subject.rfc4514_string() == f"CN={name}"
        usage = certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
        assert (x509.ExtendedKeyUsageOID.SERVER_AUTH in usage) == server
        assert not certificate.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        assert ("maps.local" in names.get_values_for_type(x509.DNSName)) == server


class FullDisk:
    """Takes so many files, and then none."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.left = 1000
        sync = os.fsync

        def fsync(handle: int) -> None:
            if stat.S_ISREG(os.fstat(handle).st_mode):
                self.left -= 1
                if self.left < 0:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            sync(handle)

        monkeypatch.setattr("mapweave.storage.atomic_file.os.fsync", fsync)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()} if folder.exists() else {}


@pytest.mark.parametrize("profile", ["production", "lab"])
def test_a_full_disk_leaves_no_half_authority(profile: str, tmp_path, monkeypatch, capfd):
    """With a catalogue and without a server's key `init` said that there are keys already."""
    folder, disk, count = tmp_path / "keys", FullDisk(monkeypatch), 0
    while True:
        disk.left = count
        words = ["keys", "init", "--keys", str(folder), "--at", "10.0.0.5", "--profile", profile]
        if main(words) == 0:
            break
        (line,) = capfd.readouterr().err.splitlines()
        assert "the disk is full" in line and str(folder) in line
        assert not folder.exists()
        count += 1
    assert count >= 3
    assert KeyFolder(folder).key_file("s0").exists()


@pytest.mark.parametrize("name", ["r0", "r1"])
def test_a_full_disk_leaves_keys_as_they_were(name: str, keys: Path, monkeypatch, capfd):
    """Of a robot that has a key and of one that has none: half of a new one is a key that no server knows."""
    disk, before, count = FullDisk(monkeypatch), contents(keys), 0
    while True:
        disk.left = count
        if main(["keys", "add", name, "--keys", str(keys)]) == 0:
            break
        (line,) = capfd.readouterr().err.splitlines()
        assert "the disk is full" in line
        assert contents(keys) == before
        count += 1
    assert count >= 2
    assert not [path for path in keys.iterdir() if path.name.startswith(".")]


def test_a_disk_that_is_really_full_is_one_line(tmp_path):
    words = [sys.executable, "-m", "mapweave", "keys", "init", "--keys", "keys", "--profile", "lab"]
    # No bytecode: on a disk that takes half of a file, Python keeps the half, and no process starts again.
    done = ran(
        *words, cwd=tmp_path, env=os.environ | {"PYTHONDONTWRITEBYTECODE": "1"},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100)),
    )  # fmt: skip
    assert done.returncode == 1 and done.stderr.count("\n") == 1 and "cannot be written" in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "host", ["127.0.0.1:7447", "10.0.0.5/24", "fe80::1%eth0", "-x", "a b", "192.168.1.300", "192.168.1"]
)
def test_a_host_is_a_name_or_an_address_without_a_port(host: str, capfd, tmp_path):
    where = tmp_path / "keys"
    assert "without a port" in complaint(capfd, "keys", "init", f"--at={host}", "--keys", where, status=USAGE)
    assert not where.exists()


def test_a_key_that_is_not_there_is_named(capfd, tmp_path):
    said = complaint(capfd, "status", "--keys", tmp_path / "r0.key.toml")
    assert "r0.key.toml: no such key file; `mapweave keys add NAME` at the server makes one" in said


def test_a_folder_is_no_key_file(keys: Path, capfd):
    assert "is a folder; give one of the key files in it" in complaint(capfd, "status", "--keys", keys)


def test_a_second_router_has_a_key_of_its_own(keys: Path, capfd):
    """On another machine there is no key of the first server."""
    assert main(["keys", "add", "s1", "--role", "server", "--keys", str(keys)]) == 0
    (keys / "s0.key.toml").unlink()
    capfd.readouterr()
    assert main(["router", "--print-config", "--keys", str(keys), "--name", "s1"]) == 0
    written = capfd.readouterr().out
    own = read_key_file(keys / "s1.key.toml").credentials
    secret = base64.b64encode(own.private_key.encode()).decode() if own.certified else own.password
    assert secret in written


def test_a_password_that_would_not_expire_is_not_promised_to(tmp_path, capfd):
    keys = tmp_path / "lab"
    assert main(["keys", "init", "--keys", str(keys), "--at", "10.0.0.5", "--profile", "lab"]) == 0
    capfd.readouterr()
    said = complaint(capfd, "keys", "add", "guest", "--days", 1, "--keys", keys, status=USAGE)
    assert "do not expire" in said and not (keys / "guest.key.toml").exists()


def test_a_server_that_comes_later_may_be_on_another_machine(keys: Path, capfd):
    """The fleet's keys were made for one machine: they stay as they are."""
    where = ["--keys", str(keys)]
    before = (keys / "r0.key.toml").read_bytes()
    assert (
        main(["keys", "add", "s1", "--role", "server", "--at", "maps2.local", "--at", "fd00::7", *where]) == 0
    )
    scheme = "tls" if KeyFolder(keys).profile == "production" else "tcp"
    endpoints = tuple(f"{scheme}/{host}:7447" for host in ("10.0.0.5", "maps2.local", "[fd00::7]"))
    assert ", ".join(endpoints) in capfd.readouterr().out
    assert main(["keys", "add", "r1", *where]) == 0
    for name in ("s1", "r1"):
        assert read_key_file(keys / f"{name}.key.toml").endpoints == endpoints
    assert (keys / "r0.key.toml").read_bytes() == before
    assert Logins(keys).hosts[-2:] == ("maps2.local", "fd00::7"), "its page is served under these names"
    if scheme == "tls":
        text = read_key_file(keys / "s1.key.toml").credentials.certificate
        certificate = x509.load_pem_x509_certificate(text.encode())
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        assert "maps2.local" in names.get_values_for_type(x509.DNSName)
        assert "fd00::7" in [str(one) for one in names.get_values_for_type(x509.IPAddress)]
    assert main(["keys", "add", "s1", "--role", "server", "--at", "maps2.local", *where]) == 0
    assert KeyFolder(keys).catalogue.endpoints == endpoints, "said again, it is there once"


@pytest.mark.parametrize(("words", "said"), [
    (["s1", "--role", "server", "--at", "maps2:7447"], "without a port"),
    (["r1", "--at", "maps2"], "is for a server"),
])  # fmt: skip
def test_where_a_server_is_reached_is_said_of_servers_alone(keys: Path, capfd, words: list[str], said: str):
    before = contents(keys)
    capfd.readouterr()
    assert said in complaint(capfd, "keys", "add", *words, "--keys", keys, status=USAGE)
    assert contents(keys) == before

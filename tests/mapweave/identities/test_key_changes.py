"""Changes of a folder of keys: by several processes at once, with files moved away or damaged."""

import errno
import fcntl
import json
import os
import stat
from collections.abc import Callable
from pathlib import Path

import pytest

from mapweave.exit_status import NO
from mapweave.hybridmap.errors import InvalidFile, InvalidValue, SettingsError
from mapweave.identities import folder_changes, key_folder
from mapweave.identities.folder_changes import locked
from mapweave.identities.key_folder import KeyFolder, Profile
from mapweave.identities.logins import Logins
from mapweave.identities.tokens import TOKENS, read_tokens
from mapweave.wire.credentials import Role
from tests.mapweave.command_line import complaint
from tests.programs import python


@pytest.fixture
def folder(tmp_path: Path) -> KeyFolder:
    """Of the lab profile: passwords are kept in a file of their own, too."""
    folder = KeyFolder.create(tmp_path / "keys", "demo", Profile.LAB, [], "s0")
    for name in ("r0", "r1", "r2"):
        folder.add(name, Role.ROBOT)
    return folder


AT_ONCE = """
import json, os, sys, traceback
from pathlib import Path
from mapweave.identities.key_folder import KeyFolder, Profile
from mapweave.wire.credentials import Role

path, actions = Path(sys.argv[1]), json.loads(sys.argv[2])
(ready, all_ready), (go, begin) = os.pipe(), os.pipe()
for action in actions:
    if not os.fork():
        os.close(begin)
        folder = KeyFolder(path) if path.exists() else None
        os.write(all_ready, b"1")
        os.read(go, 1)
        try:
            exec(action)
        except BaseException:
            traceback.print_exc()
            sys.stderr.flush()
            os._exit(1)
        os._exit(0)
for _ in actions:
    assert os.read(ready, 1)
os.close(begin)
sys.exit(sum(os.waitstatus_to_exitcode(os.wait()[1]) for _ in actions))
"""
"""Processes that have imported alike, each of which opens the folder by itself and waits for the others."""


def at_once(folder: Path, *actions: str) -> None:
    """Run each action in a process of its own, when all have read the folder."""
    done = python("-c", AT_ONCE, folder, json.dumps(actions))
    assert (done.returncode, done.stderr) == (0, "")


def users(folder: KeyFolder) -> list[str]:
    """Who has a password."""
    return [line.partition(":")[0] for line in (folder.path / "passwords").read_text().splitlines()]


def test_changes_of_several_processes_are_all_kept(folder: KeyFolder):
    new = [f"a{k}" for k in range(4)]
    at_once(folder.path, "folder.revoke('r1')", *(f"folder.add('{name}', Role.ROBOT)" for name in new))
    good = {one.name for one in KeyFolder(folder.path).catalogue.identities if not one.revoked}
    assert good == {"s0", "r0", "r2", *new}
    assert sorted(users(folder)) == sorted(good)
    assert {path.name.partition(".")[0] for path in folder.path.glob("*.key.toml")} == good


@pytest.mark.slow
def test_tokens_of_several_processes_are_all_kept(folder: KeyFolder):
    folder.token("r1", 1.0)
    tokens = [f"[folder.token('{name}', 1.0) for _ in range(10)]" for name in ("r0", "r2", "s0")]
    at_once(folder.path, "folder.end_tokens('r1')", *tokens)
    names = [one.name for one in read_tokens(folder.path)]
    assert {name: names.count(name) for name in names} == {"r0": 10, "r2": 10, "s0": 10}


def test_to_make_keys_again_changes_nothing(folder: KeyFolder):
    """The mode of the folder neither: the server of another user may read it by its group."""
    folder.path.chmod(0o750)
    with pytest.raises(InvalidFile, match="there are keys already"):
        KeyFolder.create(folder.path, "demo", Profile.LAB, [], "s0")
    assert folder.path.stat().st_mode & 0o777 == 0o750


def test_of_two_authorities_at_once_one_is_made(tmp_path):
    create = (
        "try:\n    KeyFolder.create(path, 'demo', Profile.PRODUCTION, [], 's0')\n"
        "    Path(f'{path}.made').open('x')\n"
        "except Exception as error:\n    assert 'there are keys already' in str(error), error\n"
    )
    at_once(tmp_path / "keys", *[create] * 3)
    assert (tmp_path / "keys.made").exists()
    folder = KeyFolder(tmp_path / "keys")
    certificate = folder.router("s0").credentials
    assert certificate is not None and certificate.authority == (folder.path / "authority.pem").read_text()


def test_a_share_that_locks_no_folders_takes_keys(tmp_path, monkeypatch):
    """NFS locks only what is open for writing, which no folder is."""
    flock = fcntl.flock

    def as_nfs(handle: int, operation: int) -> None:
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(errno.EBADF, "Bad file descriptor")
        flock(handle, operation)

    monkeypatch.setattr(fcntl, "flock", as_nfs)
    folder = KeyFolder.create(tmp_path / "keys", "demo", Profile.LAB, [], "s0")
    folder.add("r0", Role.ROBOT)
    folder.revoke("r0")
    names = {"fleet.json", "passwords", "s0.key.toml"}
    assert {path.name for path in folder.path.iterdir()} == names, "no lock is left"


def test_who_waits_in_vain_for_another_command_changes_no_keys(folder: KeyFolder, monkeypatch, capfd):
    monkeypatch.setattr(folder_changes, "PATIENCE", 0.05)
    before = {path.name: path.read_bytes() for path in folder.path.iterdir()}
    with locked(folder.path):
        line = complaint(capfd, "keys", "revoke", "r1", "--keys", folder.path)
    assert "another command is changing the keys; say it again" in line
    assert {path.name: path.read_bytes() for path in folder.path.iterdir()} == before


@pytest.mark.skipif(os.geteuid() != 0, reason="only root acts as another user")
def test_what_root_leaves_when_it_is_killed_holds_up_no_server(folder: KeyFolder):
    """Its lock belongs to the folder's owner, the server's user, as what it writes does."""
    os.chown(folder.path, 12345, 12345)
    before = {*folder.path.iterdir()}
    with locked(folder.path):
        assert [path.stat().st_uid for path in {*folder.path.iterdir()} - before] == [12345]


def test_a_key_file_that_was_moved_holds_up_no_change(folder: KeyFolder, tmp_path):
    """To its robot, instead of a copy: its own password stays good."""
    (folder.path / "r0.key.toml").rename(tmp_path / "r0.key.toml")
    folder.revoke("r1")
    folder.add("r9", Role.ROBOT)
    assert users(folder) == ["s0", "r0", "r2", "r9"]
    folder.revoke("r0")
    assert users(folder) == ["s0", "r2", "r9"]
    (folder.path / "passwords").unlink()
    folder.revoke("r9")
    assert users(folder) == ["s0", "r2"], "as the key files say"


@pytest.mark.parametrize("file", ["passwords", "fleet.json"])
def test_a_revocation_that_fails_changes_nothing(file: str, folder: KeyFolder, monkeypatch):
    folder.token("r1", 1.0)
    before = {path.name: path.read_bytes() for path in folder.path.iterdir()}

    def refusing(write: Callable[..., None]) -> Callable[..., None]:
        def refuse(path: Path, *content: object) -> None:
            if path.name == file:
                raise InvalidFile("full")
            write(path, *content)

        return refuse

    for name in ("write_whole", "write_private"):
        monkeypatch.setattr(key_folder, name, refusing(getattr(key_folder, name)))
    with pytest.raises(InvalidFile, match="full"):
        folder.revoke("r1")
    assert {path.name: path.read_bytes() for path in folder.path.iterdir()} == before
    monkeypatch.undo()
    folder.revoke("r1")
    assert read_tokens(folder.path) == () and not (folder.path / "r1.key.toml").exists()


def test_tokens_that_a_broken_off_revocation_left_do_not_come_back(folder: KeyFolder, monkeypatch):
    token = folder.token("r1", 1.0)

    def interrupted(folder: Path, name: str) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(key_folder, "end_tokens", interrupted)
    with pytest.raises(KeyboardInterrupt):
        folder.revoke("r1")
    monkeypatch.undo()
    assert Logins(folder.path).login(token) is None
    folder.add("r1", Role.VIEWER)
    assert Logins(folder.path).login(token) is None


def test_the_only_server_is_revoked_by_force_alone(folder: KeyFolder, capfd):
    """A running router keeps its key, and no other could be started."""
    assert "s0 is the only server: add another one first" in complaint(
        capfd, "keys", "revoke", "s0", "--keys", folder.path, status=NO
    )
    with pytest.raises(InvalidValue, match="only server"):
        folder.revoke("s0")
    folder.revoke("s0", force=True)
    with pytest.raises(InvalidValue, match="mapweave keys add s0 --role server"):
        folder.key_file("s0")
    folder.add("s1", Role.SERVER)
    folder.add("s2", Role.SERVER)
    folder.revoke("s1")


def test_what_is_no_text_is_one_line_and_lets_no_client_in(folder: KeyFolder, capfd):
    token = folder.token("r1", 1.0)
    logins = Logins(folder.path)
    for name in (TOKENS, "fleet.json"):
        good = (folder.path / name).read_bytes()
        (folder.path / name).write_bytes(good.replace(b"r1", b"r\xff"))
        assert name in complaint(capfd, "keys", "list", "--keys", folder.path)
        assert logins.login(token) is None
        (folder.path / name).write_bytes(good)
        assert logins.login(token) is not None


@pytest.mark.parametrize("expires", ["2027-01-01T00:00:00x", "2027-01-01T00:00:00", "soon"])
def test_a_damaged_date_is_one_line_and_lets_no_client_in(expires: str, folder: KeyFolder, capfd):
    token = folder.token("r1", 1.0)
    logins = Logins(folder.path)
    assert logins.login(token) is not None
    for name in (TOKENS, "fleet.json"):
        content = json.loads((folder.path / name).read_text())
        rows = content if name == TOKENS else content["identities"]
        rows[-1]["expires"] = expires
        good = (folder.path / name).read_bytes()
        (folder.path / name).write_text(json.dumps(content))
        line = complaint(capfd, "keys", "list", "--keys", folder.path)
        assert name in line and expires in line
        assert logins.login(token) is None
        (folder.path / name).write_bytes(good)
        assert logins.login(token) is not None
    with pytest.raises(SettingsError, match="no keys are here"):
        KeyFolder(folder.path / "elsewhere")


@pytest.mark.parametrize(("field", "value"), [
    ("name", "../r1"),
    ("name", "*"),
    ("name", "r/1"),
    ("fleet", "**"),
    ("listen", []),
    ("listen", ["here"]),
])  # fmt: skip
def test_a_name_that_leaves_its_folder_or_key_is_one_line(
    field: str, value: object, folder: KeyFolder, capfd
):
    """Names are parts of files and of the keys in the router's rules. Before, any was taken."""
    path = folder.path / "fleet.json"
    content = json.loads(path.read_text())
    row = content["identities"][-1] if field == "name" else content
    row[field] = value
    path.write_text(json.dumps(content))
    line = complaint(capfd, "keys", "list", "--keys", folder.path)
    assert "fleet.json" in line and ("use 1 to 32 of a-z" in line or "give endpoints" in line)

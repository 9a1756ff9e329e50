"""A real Patroni cluster on loopback: etcd and PostgreSQL as docs/operations.md configures them."""

import json
import os
import pwd
import re
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.error import URLError
from urllib.request import urlopen

import pytest
from ruamel.yaml import YAML

from synthetic.postgres_server import binaries
from tests.waiting import eventually, free_port

PAGE = Path(__file__).parents[1] / "docs" / "operations.md"
TTL = 20
"""s after which a primary that says nothing is replaced; the page's figures are with it."""
STARTS = 120.0
"""s in which a cluster comes up."""


def page_configuration() -> dict[str, Any]:
    """What the page gives of Patroni's configuration."""
    (block,) = re.findall(r"```yaml\n(etcd3:.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    found = YAML(typ="safe").load(block)
    assert isinstance(found, dict)
    return found


class PatroniMember:
    """One machine of the database: Patroni and the PostgreSQL that it starts.

    Attributes:
        port: of its PostgreSQL.
        process: of Patroni, once it was started.
    """

    process: subprocess.Popen[bytes] | None = None

    def __init__(self, name: str, folder: Path, user: str | None, etcd: str) -> None:
        """Write its configuration; nothing runs yet."""
        bin_dir = binaries()
        assert bin_dir is not None
        self.name, self.port, self._rest_port = name, free_port(), free_port()
        self._folder, self._user = folder, user
        given = page_configuration()
        given["etcd3"]["hosts"] = etcd
        # Members look about once a second: what is waited for here is the time to live, not their pause.
        given["bootstrap"]["dcs"] |= {"ttl": TTL, "loop_wait": 1, "retry_timeout": 5}
        # The page leaves out what is of a machine: names, addresses, folders, passwords.
        given |= {
            "scope": "maps",
            "name": name,
            "restapi": {"listen": f"127.0.0.1:{self._rest_port}"},
            "postgresql": {
                "listen": f"127.0.0.1:{self.port}",
                "connect_address": f"127.0.0.1:{self.port}",
                "data_dir": str(folder / name),
                "bin_dir": str(bin_dir),
                "authentication": {
                    "superuser": {"username": "postgres", "password": "super"},
                    "replication": {"username": "replicator", "password": "follows"},
                },
                "parameters": {"unix_socket_directories": str(folder)},
                "pg_hba": ["host all all 127.0.0.1/32 trust", "host replication all 127.0.0.1/32 trust"],
            },
        }
        with self._settings.open("w", encoding="utf-8") as file:
            YAML().dump(given, file)

    @property
    def _settings(self) -> Path:
        return self._folder / f"{self.name}.yml"

    @property
    def log(self) -> str:
        """What Patroni and PostgreSQL have said."""
        return (self._folder / f"{self.name}.log").read_text(errors="replace")

    def start(self) -> None:
        """Start Patroni, which starts PostgreSQL; does not wait for them."""
        with (self._folder / f"{self.name}.log").open("ab") as log:
            self.process = subprocess.Popen(
                ["patroni", self._settings], user=self._user, cwd=self._folder,
                env=_environment(self._folder), stdout=log, stderr=log, start_new_session=True,
            )  # fmt: skip

    def kill(self) -> None:
        """As a loss of power: Patroni, PostgreSQL and all its sessions."""
        assert self.process is not None
        self.process.kill()
        self.process.wait()
        with suppress(FileNotFoundError, ProcessLookupError):
            postmaster = int((self._folder / self.name / "postmaster.pid").read_text().split()[0])
            os.kill(postmaster, signal.SIGSTOP)  # starts no more
            children = Path(f"/proc/{postmaster}/task/{postmaster}/children").read_text().split()
            for process in (postmaster, *map(int, children)):
                with suppress(ProcessLookupError):
                    os.kill(process, signal.SIGKILL)
            eventually(lambda: not Path(f"/proc/{postmaster}").exists())

    def terminate(self) -> None:
        """Ask it to end; PostgreSQL ends with it."""
        if self.process is not None and self.process.poll() is None:
            self.process.terminate()

    def end(self) -> None:
        """Wait until it has ended, and kill it if it does not."""
        if self.process is not None:
            try:
                self.process.wait(60)
            except subprocess.TimeoutExpired:
                self.kill()

    @property
    def runs(self) -> bool:
        """Whether its Patroni runs."""
        return self.process is not None and self.process.poll() is None

    def cluster(self) -> list[dict[str, Any]]:
        """What it knows of all members: name, role, state ...; nothing while it does not answer."""
        try:
            with urlopen(f"http://127.0.0.1:{self._rest_port}/cluster", timeout=5.0) as answer:
                members = json.load(answer)["members"]
        except (URLError, OSError, ValueError):
            return []
        assert isinstance(members, list)
        return members


class PatroniCluster:
    """Three members, and three etcd for them.

    Attributes:
        members: by name.
    """

    def __init__(self, folder: Path, user: str | None) -> None:
        """Choose ports; nothing runs yet."""
        self._folder, self._user = folder, user
        self._ports = [(free_port(), free_port()) for _ in range(3)]
        self._etcd: list[subprocess.Popen[bytes]] = []
        etcd = ",".join(f"127.0.0.1:{client}" for client, _ in self._ports)
        self.members = {name: PatroniMember(name, folder, user, etcd) for name in ("db1", "db2", "db3")}

    def start(self) -> None:
        """Start everything; returns once there are a primary and a synchronous standby."""
        peers = ",".join(f"e{k}=http://127.0.0.1:{peer}" for k, (_, peer) in enumerate(self._ports))
        for k, pair in enumerate(self._ports):
            self._etcd.append(self._started_etcd(f"e{k}", *pair, peers))
        for member in self.members.values():
            member.start()
        self.wait_complete()

    def address(self, database: str, role: str = "mapweave") -> str:
        """Of a database, with all machines, as the page names them."""
        hosts = ",".join(f"127.0.0.1:{member.port}" for member in self.members.values())
        return f"postgresql://{role}@{hosts}/{database}"

    def roles(self) -> Mapping[str, str]:
        """By the name of each member that runs: leader, sync_standby or replica."""
        for member in self.members.values():
            if member.runs and (known := member.cluster()):
                return {one["name"]: one["role"] for one in known if one["state"] in ("running", "streaming")}
        return {}

    def primary(self) -> PatroniMember:
        """The one that takes writes; waits for it."""
        eventually(lambda: "leader" in self.roles().values(), STARTS)
        return next(self.members[name] for name, role in self.roles().items() if role == "leader")

    def wait_complete(self) -> None:
        """Wait until all are there, one as the primary and one as its synchronous standby."""
        end = time.monotonic() + STARTS
        while sorted(self.roles().values()) != ["leader", "replica", "sync_standby"]:
            ended = [one for one in self.members.values() if not one.runs]
            assert not ended and time.monotonic() < end, "\n".join(
                one.log[-2000:] for one in self.members.values()
            )
            time.sleep(0.2)

    def end(self) -> None:
        """End all, etcd last."""
        for member in self.members.values():
            member.terminate()
        for member in self.members.values():
            member.end()
        for etcd in self._etcd:
            etcd.kill()
            etcd.wait()

    def _started_etcd(self, name: str, client: int, peer: int, peers: str) -> subprocess.Popen[bytes]:
        urls = {"client": f"http://127.0.0.1:{client}", "peer": f"http://127.0.0.1:{peer}"}
        with (self._folder / f"{name}.log").open("ab") as log:
            return subprocess.Popen(
                ["etcd", "--name", name, "--data-dir", self._folder / name,
                 "--listen-client-urls", urls["client"], "--advertise-client-urls", urls["client"],
                 "--listen-peer-urls", urls["peer"], "--initial-advertise-peer-urls", urls["peer"],
                 "--initial-cluster", peers],
                user=self._user, cwd=self._folder, env=_environment(self._folder), stdout=log, stderr=log,
                start_new_session=True,
            )  # fmt: skip


@contextmanager
def patroni_cluster() -> Iterator[PatroniCluster]:
    """A cluster; skips the test where its programs are missing."""
    if find_spec("psycopg") is None:
        pytest.skip("the extra `postgres` is not installed")
    if missing := [name for name in ("patroni", "etcd") if shutil.which(name) is None]:
        pytest.skip(f"there is no {' and no '.join(missing)}: Debian's packages patroni and etcd-server")
    folder = binaries()
    if folder is None or not all((folder / name).exists() for name in ("pg_basebackup", "pg_rewind")):
        pytest.skip("there is no PostgreSQL with pg_basebackup and pg_rewind: Debian's package postgresql")
    user = None
    if os.geteuid() == 0:
        # PostgreSQL refuses to run as root.
        user = "postgres" if "postgres" in {one.pw_name for one in pwd.getpwall()} else "daemon"
    # Not below pytest's folder: that is its user's alone.
    place = Path(tempfile.mkdtemp(prefix="patroni-"))
    try:
        if user:
            os.chown(place, pwd.getpwnam(user).pw_uid, pwd.getpwnam(user).pw_gid)
        cluster = PatroniCluster(place, user)
        try:
            cluster.start()
            yield cluster
        finally:
            cluster.end()
    finally:
        shutil.rmtree(place, ignore_errors=True)


def _environment(home: Path) -> dict[str, str]:
    return {"PATH": os.environ["PATH"], "LC_ALL": "C", "HOME": str(home)}

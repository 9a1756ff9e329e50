"""Map servers as processes: one with a file of its own, or two front servers on one PostgreSQL."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from benchmarks.shards.askers import ASK_WITHIN, PATIENCE
from benchmarks.shards.fleet import FLEET
from benchmarks.shards.ray_nodes import RayNodes, descendants
from benchmarks.shards.shared_store import SharedStore
from mapweave.hybridmap.change import EdgePut
from mapweave.hybridmap.node import EdgeKind
from mapweave.scenarios.children import Children, free_port
from mapweave.storage.map_file import MapFile, unpack_map_file
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import decode_record
from mapweave.wire.zenoh_bus import ZenohBus

ROUTER = "router"


class MapServers:
    """`mapweave server` processes; two of them have a router beside them. A context manager.

    Attributes:
        endpoint: where robots connect.
        names: of the servers.
        address: of their store.
    """

    def __init__(
        self, folder: Path, shards: int, cluster: RayNodes | None, store: SharedStore | None = None
    ) -> None:
        """Choose a folder; nothing runs yet.

        Args:
            folder: for all their files.
            shards: parts of the place index of each.
            cluster: None: without Ray.
            store: shared by two of them; None: one server with SQLite.
        """
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.names = ("s0",) if store is None else ("s0", "s1")
        self.address: Path | str = folder / "s0.sqlite" if store is None else store.database()
        self._folder, self._shards, self._cluster = folder, shards, cluster
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "server.toml").write_text(f"[cluster]\nshards = {shards}\n")
        self._children = Children(folder / "logs")

    def __enter__(self) -> MapServers:
        """Start them."""
        if len(self.names) > 1:
            self._children.start(ROUTER, ["router", "--fleet", FLEET, "--listen", self.endpoint])
        for name in self.names:
            self._start(name)
        self._bus = ZenohBus(BusSettings(endpoints=(self.endpoint,)))
        return self

    def __exit__(self, *_: object) -> None:
        """End them."""
        self._bus.close()
        self._children.end(*self.names)
        self._children.end(ROUTER)

    def restart(self, name: str) -> None:
        """Kill -9, and start it again."""
        self._children.kill(name)
        self._start(name)

    def gateway(self) -> int:
        """The process between the first of them and Ray."""
        ours = descendants(self._children.pid(self.names[0]))
        return next(pid for pid in ours if b"gateway_process" in Path(f"/proc/{pid}/cmdline").read_bytes())

    def wait(self, nodes: int) -> None:
        """Wait until each has merged so many nodes, and shards, if there are any, answer themselves.

        Raises:
            SystemExit: one is not ready in time.
        """
        end = time.monotonic() + PATIENCE
        for name in self.names:
            status: dict[str, Any] = {}
            while not self._ready(status, nodes):
                if time.monotonic() > end:
                    raise SystemExit(f"server {name} is not ready in {PATIENCE:g} s: {status}")
                self._children.check()
                time.sleep(0.1)
                for reply in self._bus.ask(Keys(FLEET).server_status(name), b"", ASK_WITHIN):
                    if not reply.error:
                        status = decode_record(reply.payload)

    def maps(self, edges: int) -> list[MapFile]:
        """The merged map of each, with so many edges of robots, once it is settled.

        An edge comes behind its nodes. What one server acknowledges, another one that shares its store may
        not have read yet.

        Raises:
            SystemExit: one does not have them in time.
        """
        return [self._map(name, edges, time.monotonic() + PATIENCE) for name in self.names]

    def _map(self, name: str, edges: int, end: float) -> MapFile:
        while True:
            content = unpack_map_file(self._bus.ask(Keys(FLEET).server_map(name), b"", PATIENCE)[0].payload)
            puts = (body.edge.kind for body in content.changes if isinstance(body, EdgePut))
            known = sum(kind is not EdgeKind.MERGED for kind in puts)
            if known >= edges:
                return content
            if time.monotonic() > end:
                raise SystemExit(f"server {name} has {known} of {edges} edges after {PATIENCE:g} s")
            time.sleep(0.1)
            self.wait(0)

    def _start(self, name: str) -> None:
        ray = [] if self._cluster is None else ["--ray", self._cluster.address]
        store = ["--store", self.address] if isinstance(self.address, str) else []
        self._children.start(name, [
            "server", "--name", name, "--fleet", FLEET, "--connect" if store else "--listen", self.endpoint,
            "--data", str(self._folder), "--settings", str(self._folder / "server.toml"), *ray, *store,
        ])  # fmt: skip

    def _ready(self, status: dict[str, Any], nodes: int) -> bool:
        wanted = f"{self._shards} of {self._shards} shards" if self._cluster else ""
        return bool(
            status.get("settled") and int(status["nodes"]) >= nodes and status.get("cluster") == wanted
        )

"""The map server: keeps every robot's log, merges the maps, answers lost robots."""

from __future__ import annotations

import logging
import math
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from hybridmap.change import Change
from hybridmap.errors import MapweaveError, NotConnected
from mapserver.blockages import Blockages, BlockageSettings
from mapserver.ingest import Ingest
from mapserver.known import Known
from mapserver.merger import Merger
from mapserver.relocalization import Relocalizer
from mapserver.routes import Router
from mapserver.store import Store
from merge.merged import MergedMap
from wire.bus import Bus, Closing, Request
from wire.keys import Keys
from wire.log_messages import encode_record
from wire.mapfile import MapFile, pack_map_file
from wire.messages import (
    decode_known_request,
    decode_route_request,
    decode_view,
    encode_known_answer,
    encode_relocalize_answer,
    encode_route_answer,
)

log = logging.getLogger(__name__)

SETTLE_PATIENCE = 120.0
"""In lock-step: how long a question waits for the merged map, s."""


@dataclass(frozen=True)
class ServerSettings:
    """How the server shares its time.

    Attributes:
        status_every: seconds between two status messages.
        merge_share: at most this share of the time is spent making the merged map anew.
        lockstep: answer only when everything that came is merged, so that an answer does not depend on the
            machine's speed, and merge only when asked (simulation only; a robot's question must not wait).
    """

    status_every: float = 0.5
    merge_share: float = 0.4
    lockstep: bool = False


@dataclass(frozen=True, eq=False)
class Answers:
    """What answers questions between two merges."""

    merged: MergedMap
    relocalizer: Relocalizer
    router: Router
    known: Known


class MapServer:
    """Store, ingest, merger and services around one bus. A context manager."""

    def __init__(
        self, bus: Bus, keys: Keys, path: Path, name: str, settings: ServerSettings | None = None
    ) -> None:
        """Open the store and take up where it was left.

        Args:
            bus: the connection.
            keys: of the fleet.
            path: of the store; its folder is made.
            name: of this server in the fleet.
            settings: how it shares its time.

        Raises:
            InvalidFile: the store is damaged or is none.
        """
        self._bus = bus
        self._keys = keys
        self._name = name
        self._settings = settings or ServerSettings()
        path.parent.mkdir(parents=True, exist_ok=True)
        self._store = Store(path)
        self._merger = Merger()
        self._lock = threading.Lock()
        self._changes: queue.SimpleQueue[Change | threading.Event | None] = queue.SimpleQueue()
        # Wall time says nothing of simulated time, and what it decided would not repeat itself.
        forget = BlockageSettings(forget=math.inf) if self._settings.lockstep else BlockageSettings()
        self._blockages = Blockages(forget)
        self._answers = self._new_answers(MergedMap.empty())
        self._dirty = False
        self._stop = threading.Event()
        self._worker = threading.Thread(target=self._work, name="merge", daemon=True)
        self._teller = threading.Thread(target=self._tell, name="status", daemon=True)
        self._closing: list[Closing] = []

    def __enter__(self) -> MapServer:
        """Begin to serve."""
        self._worker.start()
        self._ingest = Ingest(self._bus, self._keys, self._store, self._name, self._changes.put)
        keys, name = self._keys, self._name
        self._closing = [
            self._bus.serve(keys.relocalize(name), self._guarded(self._relocalize)),
            self._bus.serve(keys.route(name), self._guarded(self._route)),
            self._bus.serve(keys.known(name), self._guarded(self._known)),
            self._bus.serve(keys.server_map(name), self._guarded(self._map)),
            self._bus.serve(keys.server_status(name), self._guarded(self._tell_status)),
            self._bus.announce(keys.server_alive(name)),
        ]
        self._teller.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop serving; everything that was acknowledged is on the disk already."""
        for closing in self._closing:
            closing.close()
        self._ingest.close()
        self._stop.set()
        self._changes.put(None)
        self._worker.join(30.0)
        self._teller.join(5.0)
        self._store.close()

    def summary(self) -> str:
        """One line for people."""
        return self._answers.merged.summary()

    def settle(self, timeout: float) -> bool:
        """Wait until everything that came before this call is merged; False if the time is over first."""
        merged = threading.Event()
        self._changes.put(merged)
        return merged.wait(timeout)

    # The merged map is kept up to date beside the questions.

    def _work(self) -> None:
        rest_until = 0.0
        while True:
            pause = max(rest_until - time.monotonic(), 0.0)
            try:
                by_itself = self._dirty and not self._settings.lockstep
                change = self._changes.get(timeout=pause + 0.02 if by_itself else None)
            except queue.Empty:
                began = time.monotonic()
                self._merge()
                spent = time.monotonic() - began
                rest_until = time.monotonic() + spent * (1.0 / self._settings.merge_share - 1.0)
                continue
            if change is None:
                return
            if isinstance(change, threading.Event):
                if self._dirty:
                    self._merge()
                change.set()
                continue
            with self._lock:
                try:
                    self._merger.on_change(change)
                except MapweaveError as error:
                    log.warning("change %s of %s is not merged: %s", change.sequence, change.map, error)
            self._dirty = True
            if time.monotonic() > rest_until + 2.0:
                rest_until = time.monotonic()

    def _merge(self) -> None:
        with self._lock:
            self._dirty = False
            merged = self._merger.merged()
        self._answers = self._new_answers(merged)

    def _new_answers(self, merged: MergedMap) -> Answers:
        relocalizer = Relocalizer(self._merger.index, self._merger.node, merged)
        return Answers(merged, relocalizer, Router(merged), Known(merged))

    # Questions

    def _guarded(self, answer: Callable[[bytes], bytes]) -> Callable[[Request], None]:
        """Answer, or refuse with the reason: an asker must never wait for its time to run out."""

        def handle(request: Request) -> None:
            try:
                request.reply(answer(request.payload))
            except MapweaveError as error:
                request.refuse(str(error))
            except Exception as error:  # a defect here must not leave a robot waiting
                log.exception("no answer to %s", request.key)
                request.refuse(f"the server failed: {error}")

        return handle

    def _in_step(self) -> None:
        if self._settings.lockstep and not self.settle(SETTLE_PATIENCE):
            raise NotConnected(f"the merged map was not up to date within {SETTLE_PATIENCE:g} s")

    def _relocalize(self, payload: bytes) -> bytes:
        view = decode_view(payload)
        self._in_step()
        with self._lock:
            return encode_relocalize_answer(self._answers.relocalizer.answer(view))

    def _route(self, payload: bytes) -> bytes:
        request = decode_route_request(payload)
        self._in_step()
        with self._lock:
            self._blockages.report(request.blocked, time.monotonic())
            wary = self._blockages.known(time.monotonic())
        answer = self._answers.router.route(
            request.start, request.goal, request.blocked, wary, request.start_from_robot
        )
        return encode_route_answer(answer)

    def _known(self, payload: bytes) -> bytes:
        request = decode_known_request(payload)
        self._in_step()
        answer = self._answers.known.answer(request.map, (request.x, request.y), request.reach)
        return encode_known_answer(answer)

    def _map(self, payload: bytes) -> bytes:
        self._in_step()
        merged = self._answers.merged
        changes = tuple(merged.union().contents())
        return pack_map_file(MapFile("merged", merged.summary(), changes, dict(merged.postures)))

    # Status

    def _tell(self) -> None:
        while not self._stop.wait(self._settings.status_every):
            self._bus.publish(self._keys.server_status(self._name), encode_record(self._status()))

    def _tell_status(self, payload: bytes) -> bytes:
        self._in_step()
        return encode_record(self._status())

    def _status(self) -> dict[str, str | int | float | bool]:
        merged = self._answers.merged
        between = [link for link in merged.links if link.a.map != link.b.map]
        traffic = self._store.traffic()
        return {
            "nodes": len(merged.postures),
            "maps": len(merged.maps),
            "components": len(merged.components),
            "links": len(between),
            "refused": sum(refusal.link is not None for refusal in merged.refused),
            "settled": not self._dirty and self._changes.empty(),
            "bytes": traffic.payload_bytes,
            "node_puts": traffic.node_puts,
            "summary": merged.summary(),
        }

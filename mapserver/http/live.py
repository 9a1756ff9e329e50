"""What viewers see live, over a WebSocket: the merged map, the robots, and what happens to the maps.

A viewer gets the whole map and then differences. Between two messages it is sent nothing, so one that is slow
gets the newest state when it is ready, and no queue grows.
"""

import asyncio
import contextlib
import logging
import math
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.websockets import WebSocket, WebSocketDisconnect

from mapweave.hybridmap.agent_status import LONGEST_STATUS_PERIOD
from mapweave.hybridmap.errors import MapweaveError
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.map_event import History, MapEvent
from mapweave.mapserver.http.answering import Answering
from mapweave.mapserver.http.json_values import json_values
from mapweave.mapserver.http.last_shown import NOTHING, LastShown
from mapweave.mapserver.http.live_map import LiveMap, Pair
from mapweave.mapserver.http.login import Person, RequestAuthorization
from mapweave.mapserver.http.reply import refusal
from mapweave.mapserver.http.serving import json_bytes
from mapweave.merge.outlier_rejection.link_probability import link_probabilities
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.wire.log_messages import Scalar

log = logging.getLogger(__name__)

EVERY = 0.5
"""Time between two looks at the server, s; robots report as often."""
RATING_SHARE = 0.1
"""Largest share of the time in which the links' probabilities are worked out."""
MOST_RATED = 5000
"""Nodes of a component whose links get probabilities: 4000 nodes with 600 links take 2 s, and the time grows
with the square. An explanation of a link has it in any case."""
EXPECTED = 5.0
"""s in which a browser that has asked for the page opens its WebSocket."""
SAID_AGAIN = 10.0
"""s after which an unchanged state is sent again: so a viewer knows that the server is there."""
MOST_VIEWERS = 64
"""More are refused."""
LOADING = "loading"
BEFORE = "; all is as last shown"
NOT_THERE, NOT_MERGED = LOADING + BEFORE, "merging; the map is as last shown"
"""What is said meanwhile: until the server is there, and until it has merged."""
SERVER_FIELDS = ("summary", "settled", "event", "loading", "unattended")
"""Of the server's status, which are sent along."""


class LiveUpdates:
    """Sends changes of the shown map to the viewers' pages; idle while there are none."""

    def __init__(self, server: Answering, access: RequestAuthorization, before: LastShown = NOTHING) -> None:
        """Begin with no viewer.

        Args:
            server: what viewers see.
            access: who may see it.
            before: what is shown until the server has merged a map of its own; see `shown`.
        """
        self._server, self._access = server, access
        self._before = before
        self._unheard, self._unheard_until = NOTHING, -math.inf
        self._turn = threading.Lock()
        self._map = LiveMap()
        self._shown: MergedMap | None = None
        self._rated: MergedMap | None = None
        self._rest_until = 0.0
        self._probabilities: Mapping[Pair, float] = {}
        self._floors: Mapping[MapId, str] = {}
        self._events: dict[MapEvent, int] = {}
        self._counted = 0
        self._state = ""
        self._viewers, self._expected_until = 0, -math.inf
        self._looked = asyncio.Event()
        self._looking: asyncio.Task[None] | None = None
        self._rating: asyncio.Task[None] | None = None

    async def serve(self, viewer: WebSocket) -> None:
        """Show a viewer everything until it goes, or is let in no more."""
        try:
            person = self._access.check(viewer, "robots")
        except HTTPException as error:
            await viewer.send_denial_response(refusal(error.status_code, error.detail, error.headers))
            return
        await viewer.accept()
        if self._viewers >= MOST_VIEWERS:
            await viewer.close(1013, f"{MOST_VIEWERS} watch already")
            return
        self._viewers += 1
        self._begin()
        hearing = asyncio.create_task(_until_gone(viewer))
        showing = asyncio.create_task(self._show(viewer, person))
        tasks = {hearing, showing}
        if not self._access.described(person, self._server.read_only)["why_not"]:
            tasks.add(asyncio.create_task(self._attend()))
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            self._viewers -= 1
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _attend(self) -> None:
        """A page of an operator is open, whatever becomes of what it shows."""
        while True:
            self._server.attend()
            await asyncio.sleep(EVERY)

    def expect(self) -> None:
        """A viewer comes soon: look at the server already. In the server's thread."""
        self._expected_until = time.monotonic() + EXPECTED
        self._begin()

    def _begin(self) -> None:
        if self._looking is None or self._looking.done():
            self._looking = asyncio.create_task(self._look_on())

    async def _show(self, viewer: WebSocket, person: Person) -> None:
        hello = {"kind": "hello", **self._access.described(person, self._server.read_only)}
        await viewer.send_text(json_bytes(hello).decode())
        version, events, state, said = 0, 0, "", 0.0
        if before := self._before:
            await viewer.send_text(before.map)
        while True:
            looked = self._looked
            if not self._access.holds(person):
                await viewer.close(1008, "this login has ended")
                return
            if self._map.version > version:
                text, version = await run_in_threadpool(self._map_since, version)
                await viewer.send_text(text)
            if self._counted > events:
                text, events = self._events_since(events)
                await viewer.send_text(text)
            if self._state != state or (state and time.monotonic() >= said + SAID_AGAIN):
                state, said = self._state, time.monotonic()
                await viewer.send_text(state)
            await looked.wait()

    def _map_since(self, version: int) -> tuple[str, int]:
        with self._turn:
            return self._map.message(version), self._map.version

    def _events_since(self, first: int) -> tuple[str, int]:
        fresh = tuple(event for event, number in self._events.items() if number >= first)
        content = {"kind": "events", **json_values(History(fresh))}
        return json_bytes(content).decode(), self._counted

    async def _look_on(self) -> None:
        while self._viewers or time.monotonic() < self._expected_until:
            try:
                fresh = await run_in_threadpool(self.look)
            except MapweaveError as error:
                log.warning("nothing new is shown: %s", error)
            except Exception:  # viewers keep what they have; the next look may succeed
                log.exception("nothing new is shown")
            else:
                if fresh and (self._rating is None or self._rating.done()):
                    self._rating = asyncio.create_task(run_in_threadpool(self.rate))
            looked, self._looked = self._looked, asyncio.Event()
            looked.set()
            await asyncio.sleep(EVERY)

    def look(self) -> bool:
        """Take over what is new; returns whether the links' probabilities are due."""
        status = self._server.status()
        if self._holds(status):
            self._hold(status)
            return False
        merged, floors = self._server.merged(), self._server.annotations().floors
        with self._turn:
            if merged is not self._shown or floors != self._floors:
                self._shown, self._floors = merged, floors
                self._map.show(merged, self._probabilities, floors)
        self._count(dict.fromkeys(self._server.history()))
        self._tell(
            {name: status[name] for name in SERVER_FIELDS if name in status},
            self._robots(merged),
        )
        return merged is not self._rated and time.monotonic() >= self._rest_until

    def _holds(self, status: Mapping[str, Scalar]) -> bool:
        """Whether the map of before is shown still, or none: maps that are not merged yet lie apart."""
        if status.get("loading"):
            return True
        if status.get("merged", True) and self._before:
            # A robot that is there reports by then.
            self._unheard, self._before = self._before, NOTHING
            self._unheard_until = time.monotonic() + LONGEST_STATUS_PERIOD
        return bool(self._before)

    def _robots(self, merged: MergedMap) -> list[Mapping[str, Any]]:
        """All robots; for a moment those of before, too, that the server may not have heard of yet."""
        fleet = self._server.robots()
        robots: list[Mapping[str, Any]] = json_values(fleet)["robots"]
        if time.monotonic() >= self._unheard_until:
            self._unheard = NOTHING
        elif unheard := self._unheard.unheard_on(merged, fleet):
            names = {robot["robot"] for robot in unheard}
            heard = (robot for robot in robots if robot["robot"] not in names)
            robots = sorted((*heard, *unheard), key=lambda robot: str(robot["robot"]))
        return robots

    def _hold(self, status: Mapping[str, Scalar]) -> None:
        """Show what was there before, with the robots and events that are known by now."""
        before, loading = self._before, bool(status.get("loading"))
        robots, history = before.unheard, before.history
        summary = f"{status['summary']}{BEFORE if before else ''}" if loading else NOT_MERGED
        if not loading:
            robots, history = (
                before.fleet(self._server.robots(), self._server.merged()),
                self._server.history(),
            )
        self._count(dict.fromkeys(history))
        self._tell({"summary": summary, "loading": True}, robots)

    def _tell(self, server: Mapping[str, Scalar], robots: Sequence[Mapping[str, Any]]) -> None:
        self._state = json_bytes({"kind": "state", "server": server, "robots": robots}).decode()

    def shown(self) -> LastShown:
        """What is shown at present; nothing until the server has merged. From any thread."""
        if self._before or self._server.status().get("loading") or not self._server.merged().maps:
            return NOTHING
        merged = self._server.merged()
        with self._turn:
            self._map.show(merged, self._probabilities, self._server.annotations().floors)
            message = self._map.message(0)
        robots = json_values(self._server.robots())["robots"]
        return LastShown(message, tuple(robots), self._server.history())

    def _count(self, history: Mapping[MapEvent, None]) -> None:
        """Number what is new. What the server keeps no longer is not kept here either."""
        known = self._events
        self._events = {event: known[event] for event in history if event in known}
        for event in history:
            if event not in known:
                self._events[event], self._counted = self._counted, self._counted + 1

    def rate(self) -> None:
        """Work out the links' probabilities, which takes long in a large map."""
        began = time.monotonic()
        merged = self._rated = self._shown
        if merged is None:
            return
        try:
            small = tuple(graph for graph in merged.graphs if len(graph.nodes) <= MOST_RATED)
            probabilities = link_probabilities(replace(merged, graphs=small))
        except Exception:  # the map is shown without
            log.exception("the links have no probabilities")
            return
        finally:
            now = time.monotonic()
            self._rest_until = now + (now - began) * (1.0 / RATING_SHARE - 1.0)
        with self._turn:
            self._probabilities = probabilities
            if self._shown is merged:
                self._map.show(merged, probabilities, self._floors)


async def _until_gone(viewer: WebSocket) -> None:
    """Viewers say nothing; what they say is not read."""
    with contextlib.suppress(WebSocketDisconnect):
        while (await viewer.receive())["type"] != "websocket.disconnect":
            pass

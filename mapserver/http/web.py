"""The map server for people: a photograph in, JSON out, explanations of merges and routes, and pages.

    GET /             the page: the merged map live, robots, and where a photograph was taken
    GET /why          the same page, with an explanation: ?a=r0.1.17&b=r1.1.5
    WebSocket /live   what the page draws, see live.py
    GET /nodes/NODE   one node, JSON
    GET /status       what the server holds, JSON
    GET /history      joins, splits and manual constraints, with dates, JSON
    GET /explain      why maps are one, or are not; with ?a=r0.1.17&b=r1.1.5 two nodes or two maps, JSON
    GET /route        explanation of the route from a to b: ?a=r0.1.17&b=r1.1.5, JSON
    GET /robots       what every robot is doing, JSON
    GET /missions     the missions that are known, JSON
    GET /map          the merged map, a map file
    GET /annotations  what people say about the map: named places and so on, JSON
    POST /annotations JSON: adds an annotation, or withdraws one
    GET /plans        floor plans, and where they lie under the merged map, JSON; /plans/NAME.png is the image
    POST /plans       an image: keeps it for a plan that an annotation adds; JSON: its name and size
                      (/plan-images/NAME.png is the image again)
    GET /constraints  what people have linked, unmerged and retired, JSON
    POST /robots/ROBOT/go?goal=GOAL, .../explore, .../stop   a mission; .../portal-done   it is through, JSON
    POST /stop        stops every robot, JSON
    POST /constraints links, unmerges, retires, or takes back, JSON in and out; see constraint_request.py
    POST /relocalize  an image (the body itself, or a form's part `image`) -> where it was taken, JSON

An error comes back as one JSON object with `error`. A busy server answers 503 with
Retry-After in whole seconds and `retry_after` exactly. The pages are in `static/`.
"""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections.abc import Awaitable, Callable, Mapping
from concurrent.futures import Future
from http import HTTPStatus
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Receive, Scope, Send

from mapweave.hybridmap.constraint_subject import EXAMPLE, Ends
from mapweave.hybridmap.errors import Busy, InvalidValue, MapweaveError, NotConnected, SettingsError
from mapweave.hybridmap.manual_constraint import ManualConstraints
from mapweave.hybridmap.map_event import History
from mapweave.hybridmap.mission_order import MissionKind, Missions
from mapweave.hybridmap.node import NodeId
from mapweave.hybridmap.query import ExplainRequest
from mapweave.mapserver.http.annotations import annotate, annotations_json, ends_of_words
from mapweave.mapserver.http.answering import Answering
from mapweave.mapserver.http.constraint_request import read_request
from mapweave.mapserver.http.form import read_photo
from mapweave.mapserver.http.json_values import constraint_values, json_values
from mapweave.mapserver.http.live import Live
from mapweave.mapserver.http.node_details import node_details
from mapweave.mapserver.http.plans import plan_routes
from mapweave.mapserver.http.same_site import SameSite, is_loopback
from mapweave.mapserver.http.serving import LINGER, HttpThread, Limits, json_bytes

log = logging.getLogger(__name__)

STATIC = Path(__file__).with_name("static")
PAGES = ("/", "/why")
MOST_BYTES = 16 * 2**20
"""Longest body, 16 MiB."""
PATIENCE = 10.0
"""Time limit for a body, and for an answer, s."""
MOST_AT_ONCE = 32
"""Questions that are served at once; the next one is refused."""
WHOLE = "mapweave.whole"
"""Set in the scope of a request whose body is complete."""
MISSION = "/robots/ROBOT/go?goal=GOAL"
OF_ROBOTS = tuple(f"/robots/ROBOT/{word}" for word in ("explore", "stop", "portal-done"))
METHODS = {
    **dict.fromkeys(
        (*PAGES, "/status", "/history", "/explain", "/route", "/robots", "/missions", "/map"), "GET"
    ),
    **dict.fromkeys(("/nodes/NODE", "/plans/NAME.png", "/plan-images/SHA256.png"), "GET"),
    **dict.fromkeys(("/constraints", "/annotations", "/plans"), "GET or POST"),
    **dict.fromkeys(("/relocalize", MISSION, *OF_ROBOTS, "/stop"), "POST"),
}
BY = "http"
"""Gives a mission, if the request does not say."""


Answer = Callable[[Request], Awaitable[Mapping[str, Any] | Response]]


def parse_address(text: str) -> tuple[str, int]:
    """`PORT` (loopback only) or `HOST:PORT`.

    Raises:
        SettingsError: it is neither.
    """
    host, colon, port = text.rpartition(":")
    host = host.strip("[]") if colon else "127.0.0.1"
    if not host or not port.isascii() or not port.isdigit() or not 1 <= int(port) <= 65535:
        raise SettingsError(f"http {text!r}: write a port, or HOST:PORT, for example 8080 or 0.0.0.0:8080")
    return host, int(port)


class Web(HttpThread):
    """The map server for people. Listens from the start until closed."""

    def __init__(
        self,
        address: tuple[str, int],
        server: Answering,
        patience: float = PATIENCE,
        limits: Limits | None = None,
        commands: bool = False,
    ) -> None:
        """Open the port and serve on a thread of its own.

        Args:
            address: host and port; port 0 takes any.
            server: answers.
            patience: time limit for a body, and for an answer, s.
            limits: of connections.
            commands: whether other machines may move robots and correct the map, too.

        Raises:
            NotConnected: the port cannot be used, for example since it is taken.
        """
        app = SameSite(Questions(server, patience, commands).app, address[0])
        try:
            super().__init__(app, address, limits)
        except NotConnected as error:
            raise NotConnected(f"cannot listen at http {address[0]}:{address[1]}: {error}") from None


class Reply(Response):
    """One JSON object on a line.

    A refusal is sent at once, and what the peer is still sending is read to its end and thrown away: a
    connection that is reset loses the answer too.
    """

    def __init__(
        self, content: Mapping[str, Any], status: int = 200, headers: Mapping[str, str] | None = None
    ) -> None:
        """Encode it."""
        super().__init__(json_bytes(content), status, dict(headers or {}), "application/json")

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send it."""
        start = {"type": "http.response.start", "status": self.status_code, "headers": self.raw_headers}
        await send(start)
        await send({"type": "http.response.body", "body": bytes(self.body), "more_body": True})
        if self.status_code >= HTTPStatus.BAD_REQUEST and scope["method"] == "POST" and WHOLE not in scope:
            await _hear_out(scope, receive)
        await send({"type": "http.response.body", "body": b"", "more_body": False})


async def _hear_out(scope: Scope, receive: Receive) -> None:
    # Reading from a peer that waits for "100 Continue" would send it.
    if any(name == b"expect" for name, _ in scope["headers"]):
        return
    try:
        async with asyncio.timeout(PATIENCE):
            while True:
                async with asyncio.timeout(LINGER):
                    message = await receive()
                if not message.get("more_body", False):
                    return
    except TimeoutError:
        return


def refusal(status: int, error: str) -> Reply:
    """Why there is no answer, on one line."""
    return Reply({"error": " ".join(error.split())}, status)


class Questions:
    """What can be asked over HTTP.

    Attributes:
        app: the application.
    """

    def __init__(self, server: Answering, patience: float, commands: bool) -> None:
        """Make the application."""
        self._server = server
        self._commands = commands
        self._patience = patience
        self._open = 0
        answering: dict[str, Answer] = {
            "/status": self._status, "/history": self._history, "/explain": self._explain,
            "/route": self._explain, "/robots": self._robots, "/missions": self._missions, "/map": self._map,
            "/nodes/{node}": self._node,
        }  # fmt: skip
        routes = [
            *(Route(path, _page("index.html")) for path in PAGES),
            WebSocketRoute("/live", Live(server, self._may_command).serve),
            *(Route(path, self._answering(answer)) for path, answer in answering.items()),
            Route("/annotations", self._answering(self._annotations), methods=["GET", "POST"]),
            *plan_routes(server, self._answering, self._command_body),
            Route("/relocalize", self._answering(self._relocalize), methods=["POST"]),
            Route("/robots/{robot}/{kind}", self._answering(self._give), methods=["POST"]),
            Route("/stop", self._answering(self._stop), methods=["POST"]),
            Route("/constraints", self._answering(self._constraints), methods=["GET", "POST"]),
            Mount("/static", StaticFiles(directory=STATIC)),
        ]
        app = Starlette(routes=routes, exception_handlers={HTTPException: _no_such})
        app.router.redirect_slashes = False
        self.app: ASGIApp = app

    def _answering(self, answer: Answer) -> Callable[[Request], Awaitable[Response]]:
        """Answer a question, or refuse it with a reason."""

        async def endpoint(request: Request) -> Response:
            if self._open >= MOST_AT_ONCE:
                return _busy(Busy(1.0))
            self._open += 1
            try:
                content = await answer(request)
                return content if isinstance(content, Response) else Reply(content)
            except HTTPException as error:
                return refusal(error.status_code, error.detail)
            except Busy as busy:
                return _busy(busy)
            except InvalidValue as error:
                return refusal(HTTPStatus.BAD_REQUEST, str(error))
            except MapweaveError as error:
                return refusal(HTTPStatus.SERVICE_UNAVAILABLE, str(error))
            except TimeoutError:
                words = f"no whole image, or no answer, within {self._patience:g} s"
                return refusal(HTTPStatus.REQUEST_TIMEOUT, words)
            except ClientDisconnect:
                return refusal(HTTPStatus.BAD_REQUEST, "the request is cut off")
            except Exception as error:  # a defect here must not look like a broken network
                log.exception("no answer to %s", request.url.path)
                return refusal(HTTPStatus.INTERNAL_SERVER_ERROR, f"the server failed: {error}")
            finally:
                self._open -= 1

        return endpoint

    async def _status(self, _: Request) -> Mapping[str, Any]:
        return await run_in_threadpool(self._server.status)

    async def _history(self, _: Request) -> Mapping[str, Any]:
        return await run_in_threadpool(lambda: json_values(History(self._server.history())))

    async def _robots(self, _: Request) -> Mapping[str, Any]:
        return await run_in_threadpool(lambda: json_values(self._server.robots()))

    async def _missions(self, _: Request) -> Mapping[str, Any]:
        return await run_in_threadpool(lambda: json_values(self._server.missions()))

    async def _annotations(self, request: Request) -> Mapping[str, Any]:
        if request.method != "POST":
            return await run_in_threadpool(annotations_json, self._server)
        body = await self._command_body(request, "JSON")
        return await run_in_threadpool(annotate, self._server, body, request.query_params.get("by", BY))

    async def _node(self, request: Request) -> Mapping[str, Any]:
        node = NodeId.parse(request.path_params["node"])
        return await run_in_threadpool(lambda: json_values(node_details(self._server.merged(), node)))

    async def _map(self, _: Request) -> Response:
        data = await self._result(self._server.map_file)
        headers = {"Content-Disposition": 'attachment; filename="merged.mapweave"'}
        return Response(data, headers=headers, media_type="application/octet-stream")

    async def _give(self, request: Request) -> Mapping[str, Any]:
        self._check_commands(request)
        robot, kind = request.path_params["robot"], request.path_params["kind"]
        query = request.query_params
        if kind == "portal-done":
            return {"said": await run_in_threadpool(self._server.portal_done, robot, query.get("by", BY))}
        if kind not in (MissionKind.GO, MissionKind.EXPLORE, MissionKind.STOP):
            raise HTTPException(HTTPStatus.NOT_FOUND, f"there is no mission {kind!r}: go, explore, stop")
        goal, by, mission_id = query.get("goal", ""), query.get("by", BY), query.get("id", "")
        report = await run_in_threadpool(
            self._server.give, robot, MissionKind(kind), goal.strip(), by, mission_id,
            tuple(query.getlist("via")),
        )  # fmt: skip
        return json_values(report)

    async def _stop(self, request: Request) -> Mapping[str, Any]:
        self._check_commands(request)
        by = request.query_params.get("by", BY)

        def stop() -> Mapping[str, Any]:
            names = [entry.robot for entry in self._server.robots().robots if entry.alive]
            return json_values(
                Missions(tuple(self._server.give(name, MissionKind.STOP, "", by, "", ()) for name in names))
            )

        return await run_in_threadpool(stop)

    async def _constraints(self, request: Request) -> Mapping[str, Any]:
        if request.method != "POST":
            return await run_in_threadpool(
                lambda: constraint_values(ManualConstraints(self._server.constraints().made))
            )
        body = await self._command_body(request, "JSON")

        def constrain() -> Mapping[str, Any]:
            record = self._server.constraints().made
            return {"said": self._server.constrain(read_request(body, BY, time.time_ns(), record))}

        return await run_in_threadpool(constrain)

    async def _command_body(self, request: Request, what: str = "a JPEG or PNG image") -> bytes:
        self._check_commands(request)
        return await self._body(request, what)

    def _may_command(self, host: str) -> bool:
        return self._commands or is_loopback(host)

    def _check_commands(self, request: Request) -> None:
        """There is no password: robots are moved and maps corrected from this machine, unless it is set."""
        host = "" if request.client is None else request.client.host
        if not self._may_command(host):
            raise HTTPException(
                HTTPStatus.FORBIDDEN,
                "missions and corrections are taken from this machine alone: start the server with "
                "--http-commands",
            )

    async def _explain(self, request: Request) -> Mapping[str, Any]:
        ends: Ends | None = None
        path, query = request.url.path, dict(request.query_params)
        route = path == "/route"
        if query or route:
            if query.keys() != {"a", "b"}:
                raise InvalidValue(f"write {path}?a=r0.1.17&b=r1.1.5: {EXAMPLE}")
            words = query["a"].strip(), query["b"].strip()
            ends = await run_in_threadpool(ends_of_words, self._server, words)
        asked = ExplainRequest(ends, route)
        explanation = await self._result(lambda: self._server.explain(asked))
        return await run_in_threadpool(json_values, explanation)

    async def _relocalize(self, request: Request) -> Mapping[str, Any]:
        body = await self._body(request)
        content_type, query = request.headers.get("Content-Type", ""), dict(request.query_params)
        photo = await run_in_threadpool(read_photo, content_type, body, query)
        photo.check()
        ticket = hash(photo.data)
        return json_values(await self._result(lambda: self._server.locate(photo.view, ticket)))

    async def _result(self, ask: Callable[[], Future[Any]]) -> Any:
        """Ask on a thread, since in lock-step the asking thread does the work; then wait for the answer."""
        async with asyncio.timeout(self._patience):
            return await asyncio.wrap_future(await run_in_threadpool(ask))

    async def _body(self, request: Request, what: str = "a JPEG or PNG image") -> bytes:
        """All of it, in the time that a body may take; refused before it is sent if it is too long."""
        length = _length(request, what)
        body = bytearray()
        async with asyncio.timeout(self._patience):
            async for piece in request.stream():
                body += piece
        request.scope[WHOLE] = True
        if len(body) < length:
            raise InvalidValue(f"only {len(body)} of {length} bytes came")
        return bytes(body)


def _length(request: Request, what: str) -> int:
    text = request.headers.get("Content-Length", "")
    if "Transfer-Encoding" in request.headers or not (text.isascii() and text.isdigit()):
        raise HTTPException(HTTPStatus.LENGTH_REQUIRED, "give the length of the body with Content-Length")
    if len(text) > 12 or int(text) > MOST_BYTES:
        raise HTTPException(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"at most {MOST_BYTES >> 20} MiB are taken")
    if int(text) == 0:
        raise InvalidValue(f"send {what} as the body")
    return int(text)


def _page(name: str) -> Callable[[Request], Awaitable[Response]]:
    content = (STATIC / name).read_bytes()

    async def endpoint(_: Request) -> Response:
        return Response(content, media_type="text/html")

    return endpoint


async def _no_such(request: Request, error: Exception) -> Response:
    status = error.status_code if isinstance(error, HTTPException) else HTTPStatus.INTERNAL_SERVER_ERROR
    if status == HTTPStatus.METHOD_NOT_ALLOWED and request.url.path in METHODS:
        return refusal(status, f"use {METHODS[request.url.path]} for {request.url.path}")
    return refusal(status, f"there are {', '.join(f'{method} {path}' for path, method in METHODS.items())}")


def _busy(busy: Busy) -> Reply:
    content = {"error": str(busy), "retry_after": round(busy.retry_after, 2)}
    headers = {"Retry-After": str(math.ceil(busy.retry_after))}
    return Reply(content, HTTPStatus.SERVICE_UNAVAILABLE, headers)

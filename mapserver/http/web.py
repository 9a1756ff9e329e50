"""The map server for people: a photograph in, JSON out, explanations of merges and routes, and pages.

    POST /login       a token -> a session, for browsers; /logout ends it, GET /session says whose it is
    GET /             the page: the merged map live, robots, and where a photograph was taken
    GET /why          the same page, with an explanation: ?a=r0.1.17&b=r1.1.5
    WebSocket /live   what the page draws, see live.py
    GET /nodes/NODE   one node, JSON; /nodes/NODE/view its image, if its robot has kept one
    GET /status       what the server holds, JSON
    GET /history      joins, splits and manual constraints, with dates, JSON
    GET /explain      why maps are one, or are not; with ?a=r0.1.17&b=r1.1.5 two nodes or two maps, JSON
    GET /route        explanation of the route from a to b: ?a=r0.1.17&b=r1.1.5&via=kitchen, JSON
    GET /robots       what every robot is doing, JSON; ?plan=NAME: also where they are on a floor plan
    GET /missions     the missions that are known, JSON
    GET /metrics      what Prometheus scrapes
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
Retry-After in whole seconds and `retry_after` exactly; who asks more than `rates.QUESTIONS` gets 429 with
Retry-After. The pages are in `static/`.
"""

import asyncio
import logging
import ssl
import time
from collections.abc import Awaitable, Callable, Mapping
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from http import HTTPStatus
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp

from mapweave.hybridmap.errors import Busy, InvalidValue, MapweaveError, NotConnected, SettingsError
from mapweave.hybridmap.explanation import PairExplanation, route_over
from mapweave.hybridmap.floor_plan import PlacedPlan
from mapweave.hybridmap.manual_constraint import ManualConstraints
from mapweave.hybridmap.map_event import History
from mapweave.hybridmap.mission_order import MAX_BECAUSE, MissionKind, MissionReport, Missions
from mapweave.identities.logins import Logins
from mapweave.mapserver.http.annotations import annotate, annotations_json
from mapweave.mapserver.http.answering import Answering
from mapweave.mapserver.http.body import FORM, IMAGE, JSON, read_body
from mapweave.mapserver.http.constraint_request import read_request
from mapweave.mapserver.http.explain_request import read_questions
from mapweave.mapserver.http.form import read_photo
from mapweave.mapserver.http.json_values import constraint_values, json_values
from mapweave.mapserver.http.last_shown import NOTHING, LastShown
from mapweave.mapserver.http.live import LiveUpdates
from mapweave.mapserver.http.login import PERSON, PUBLIC, RequestAuthorization, address_of
from mapweave.mapserver.http.nodes import node_answers
from mapweave.mapserver.http.pages import page, static
from mapweave.mapserver.http.places import PLACE, Place, Places
from mapweave.mapserver.http.plans import plan_answers
from mapweave.mapserver.http.rates import LIMITED, Rates
from mapweave.mapserver.http.reply import PATIENCE, JsonLine, busy, refusal
from mapweave.mapserver.http.request_site import is_loopback
from mapweave.mapserver.http.same_site import SameSite
from mapweave.mapserver.http.serving import ConnectionTimeouts, HttpThread
from mapweave.mapserver.plan_answers import answer_on_plan, component_of, goal_on_plan, status_on_plan
from mapweave.wire.each_robot import each_robot

log = logging.getLogger(__name__)

PAGES = ("/", "/why")
MISSION = "/robots/ROBOT/go?goal=GOAL"
OF_ROBOTS = tuple(f"/robots/ROBOT/{word}" for word in ("explore", "stop", "portal-done"))
METHODS = {
    **dict.fromkeys((*PAGES, "/session", "/status", "/history", "/explain", "/route", "/robots"), "GET"),
    **dict.fromkeys(("/missions", "/map", "/metrics", "/nodes/NODE", "/nodes/NODE/view"), "GET"),
    **dict.fromkeys(("/plans/NAME.png", "/plan-images/SHA256.png"), "GET"),
    **dict.fromkeys(("/constraints", "/annotations", "/plans"), "GET or POST"),
    **dict.fromkeys(("/relocalize", MISSION, *OF_ROBOTS, "/stop", "/login", "/logout"), "POST"),
}
PACKING = 120.0
"""Time limit for the map as a file, s, as over Zenoh: a large one takes much longer than other answers."""
CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
"""Of the text format of Prometheus."""
GIVEN = "goal", "via", "by", "id", "plan", "because"
"""What may be said of a mission behind the `?`."""
BY = "http"
"""Gives a mission, if the request does not say."""


Answer = Callable[[Request], Awaitable[Mapping[str, Any] | Response]]


def parse_address(text: str) -> tuple[str, int]:
    """`PORT` (loopback only) or `HOST:PORT`; port 0 takes a free one.

    Raises:
        SettingsError: it is neither.
    """
    host, colon, port = text.rpartition(":")
    host = host.strip("[]") if colon else "127.0.0.1"
    if not host or not port.isascii() or not port.isdigit() or not int(port) <= 65535:
        raise SettingsError(f"http {text!r}: write a port, or HOST:PORT, for example 8080 or 0.0.0.0:8080")
    return host, int(port)


class Web(HttpThread):
    """The map server for people. Listens from the start until closed.

    Attributes:
        shown: gives what the page shows; see `LiveUpdates.shown`.
    """

    def __init__(
        self,
        address: tuple[str, int],
        server: Answering,
        patience: float = PATIENCE,
        limits: ConnectionTimeouts | None = None,
        logins: Logins | None = None,
        tls: ssl.SSLContext | None = None,
        before: LastShown = NOTHING,
    ) -> None:
        """Open the port and serve on a thread of its own.

        Args:
            address: host and port; port 0 takes any.
            server: answers.
            patience: time limit for a body, and for an answer, s.
            limits: of connections.
            logins: of the fleet's members; None: this machine alone is served.
            tls: serves HTTPS.
            before: what the page shows until the server has merged; see `LiveUpdates`.

        Raises:
            SettingsError: other machines would be served without a login, or unencrypted.
            NotConnected: the port cannot be used, for example since it is taken.
        """
        check_reach(address, logins is not None, tls is not None)
        hosts = () if logins is None else logins.hosts
        questions = Questions(server, patience, logins, before=before)
        self.shown = questions.live.shown
        app = SameSite(questions.app, address[0], hosts)
        try:
            super().__init__(app, address, limits, tls=tls)
        except NotConnected as error:
            raise NotConnected(f"cannot listen at http {address[0]}:{address[1]}: {error}") from None


def check_reach(address: tuple[str, int], logins: bool, tls: bool) -> None:
    """Refuse to serve other machines without a login, or with tokens that can be read on their way.

    Raises:
        SettingsError: what to do instead.
    """
    where = f"http {address[0]}:{address[1]}"
    if address[0] == "localhost" or is_loopback(address[0]):
        return
    if not logins:
        raise SettingsError(
            f"{where}: without keys people are served on this machine alone: make keys with "
            "`mapweave keys init`, and give them with --keys, or give the port alone"
        )
    if not tls:
        raise SettingsError(
            f"{where}: keys of the lab profile serve no HTTPS, and no token may travel unencrypted: use the "
            "production profile, or give the port alone, for a proxy on this machine that serves HTTPS"
        )


class Questions:
    """What can be asked over HTTP.

    Attributes:
        app: the application.
        live: what viewers see.
    """

    def __init__(
        self,
        server: Answering,
        patience: float,
        logins: Logins | None = None,
        rates: Rates | None = None,
        before: LastShown = NOTHING,
    ) -> None:
        """Make the application.

        Args:
            server: answers.
            patience: time limit for a body, and for an answer, s.
            logins: of the fleet's members; None on a fleet without keys.
            rates: of people's questions; the usual ones by default.
            before: see `LiveUpdates`.
        """
        self._server = server
        self._access = access = RequestAuthorization(logins, patience)
        self.live = LiveUpdates(server, access, before)
        self._patience = patience
        self._places, self._rates = Places(), rates or Rates()
        # The question is the router's word for it, by which roles decide.
        answering: list[tuple[str, str, str, Answer]] = [
            ("GET", "/status", "status", self._status),
            ("GET", "/history", "history", self._history),
            ("GET", "/explain", "explain", self._explain),
            ("GET", "/route", "explain", self._explain),
            ("GET", "/robots", "robots", self._robots),
            ("GET", "/missions", "missions", self._missions),
            ("GET", "/metrics", "robots", self._metrics),
            ("GET", "/map", "map", self._map),
            *node_answers(server),
            ("GET", "/annotations", "annotations", self._annotations),
            ("POST", "/annotations", "annotate", self._annotate),
            *plan_answers(server, lambda request: read_body(request, (*IMAGE, FORM), patience)),
            ("POST", "/relocalize", "relocalize", self._relocalize),
            ("POST", "/robots/{robot}/{kind}", "mission", self._give),
            ("POST", "/stop", "mission", self._stop),
            ("GET", "/constraints", "constraints", self._constraints),
            ("POST", "/constraints", "constrain", self._constrain),
        ]
        routes = [
            *(Route(path, page("index.html", self.live.expect)) for path in PAGES),
            *access.routes(lambda: server.read_only, self._answering),
            WebSocketRoute("/live", self.live.serve),
            *(
                Route(path, self._answering(answer, question), methods=[method])
                for method, path, question, answer in answering
            ),
            Route("/static/{name}", static()),
        ]
        app = Starlette(routes=routes, exception_handlers={HTTPException: _no_such})
        app.router.redirect_slashes = False
        self.app: ASGIApp = app

    def _answering(self, answer: Answer, question: str) -> Callable[[Request], Awaitable[Response]]:
        """Answer a question, or refuse it with a reason."""

        async def endpoint(request: Request) -> Response:
            place = request.scope[PLACE] = Place(self._places)
            place.sent_by(address_of(request), member=False)
            try:
                place.take()
                if question != PUBLIC:
                    request.scope[PERSON] = self._access.check(request, question)
                    place.sent_by(_asker(request), member=True)
                    if question in LIMITED:
                        self._rates.ask(_asker(request))
                content = await answer(request)
                return content if isinstance(content, Response) else JsonLine(content)
            except HTTPException as error:
                return refusal(error.status_code, error.detail, error.headers)
            except Busy as error:
                return busy(error)
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
                place.leave()

        return endpoint

    async def _status(self, _: Request) -> Mapping[str, Any]:
        return await run_in_threadpool(self._server.status)

    async def _history(self, _: Request) -> Mapping[str, Any]:
        return await run_in_threadpool(lambda: json_values(History(self._server.history())))

    async def _robots(self, request: Request) -> Mapping[str, Any]:
        def robots() -> Mapping[str, Any]:
            plan, status = self._plan(request.query_params.get("plan")), self._server.robots()
            return json_values(status if plan is None else status_on_plan(status, plan))

        return await run_in_threadpool(robots)

    def _plan(self, name: str | None) -> PlacedPlan | None:
        """The plan in whose coordinates the answer is to be; None if no plan is named.

        Raises:
            Refused: there is none of this name.
        """
        return None if name is None else self._server.plans().plan(name)

    async def _missions(self, _: Request) -> Mapping[str, Any]:
        return await run_in_threadpool(lambda: json_values(self._server.missions()))

    async def _metrics(self, _: Request) -> Response:
        return Response(await run_in_threadpool(self._server.metrics), media_type=CONTENT_TYPE)

    async def _annotations(self, _: Request) -> Mapping[str, Any]:
        return await run_in_threadpool(annotations_json, self._server)

    async def _annotate(self, request: Request) -> Mapping[str, Any]:
        body = await read_body(request, JSON, self._patience)
        by = request.query_params.get("by", BY)
        return await run_in_threadpool(annotate, self._server, body, by, request.scope[PERSON].name)

    async def _map(self, _: Request) -> Response:
        try:
            data = await self._result(self._server.map_file, PACKING)
        except TimeoutError:
            words = f"the map is not packed after {PACKING:g} s; the server goes on: ask again"
            raise HTTPException(HTTPStatus.REQUEST_TIMEOUT, words) from None
        headers = {"Content-Disposition": 'attachment; filename="merged.mapweave"'}
        return Response(data, headers=headers, media_type="application/octet-stream")

    async def _give(self, request: Request) -> Mapping[str, Any]:
        robot, kind = request.path_params["robot"], request.path_params["kind"]
        query = request.query_params
        if kind == "portal-done":
            return {"said": await run_in_threadpool(self._server.portal_done, robot, _author(request))}
        if kind not in (MissionKind.GO, MissionKind.EXPLORE, MissionKind.STOP):
            raise HTTPException(HTTPStatus.NOT_FOUND, f"there is no mission {kind!r}: go, explore, stop")
        # A stop stops whatever is said with it.
        if kind != MissionKind.STOP and (unknown := sorted(query.keys() - set(GIVEN))):
            raise InvalidValue(f"{unknown[0]!r:.40}: there is no such value; give {', '.join(GIVEN)}")
        if len(query.getlist("goal")) > 1:
            raise InvalidValue("goal is given twice: `via` names places on the way")
        goal, by, mission_id = query.get("goal", "").strip(), _author(request), query.get("id", "")
        because = _because(request) if kind == MissionKind.STOP else query.get("because", "").strip()

        def give() -> MissionReport:
            words = [goal, *query.getlist("via")]
            if kind == MissionKind.GO and (plan := self._plan(query.get("plan"))) is not None:
                component = component_of(robot, self._server.robots())
                words = [goal_on_plan(word, plan, component, self._server.resolve) for word in words]
            return self._server.give(
                robot, MissionKind(kind), words[0], by, mission_id, tuple(words[1:]), because
            )

        return json_values(await run_in_threadpool(give))

    async def _stop(self, request: Request) -> Mapping[str, Any]:
        by, because = _author(request), _because(request)

        def stop() -> Mapping[str, Any]:
            names = {entry.robot for entry in self._server.robots().robots if entry.alive}
            names |= self._server.missions().awaited()

            def one(name: str) -> MissionReport:
                return self._server.give(name, MissionKind.STOP, "", by, "", (), because)

            return json_values(Missions(tuple(each_robot(sorted(names), one))))

        return await run_in_threadpool(stop)

    async def _constraints(self, _: Request) -> Mapping[str, Any]:
        return await run_in_threadpool(
            lambda: constraint_values(ManualConstraints(self._server.constraints().made))
        )

    async def _constrain(self, request: Request) -> Mapping[str, Any]:
        body, who = await read_body(request, JSON, self._patience), request.scope[PERSON].name

        def constrain() -> Mapping[str, Any]:
            record = self._server.constraints().made
            asked = read_request(
                body, BY, time.time_ns(), record, self._server.annotations, self._server.resolve
            )
            if who:
                asked = replace(asked, constraint=replace(asked.constraint, who=who))
            return {"said": self._server.constrain(asked)}

        return await run_in_threadpool(constrain)

    async def _explain(self, request: Request) -> Mapping[str, Any]:
        path, query, resolve = request.url.path, request.query_params, self._server.resolve
        asked = await run_in_threadpool(read_questions, path, query, resolve)
        if more_legs := len(asked) - 1:
            # Each leg of a route is as much work as a question of its own; one is counted already.
            self._rates.ask(_asker(request), more_legs)
        async with asyncio.timeout(self._patience):
            first, *more = [await self._result(partial(self._server.explain, one)) for one in asked]
        values = await run_in_threadpool(json_values, route_over([first, *more]) if more else first)
        if isinstance(first, PairExplanation):
            missing = {str(node): self._server.why_no_view(node) for node in (first.a.id, first.b.id)}
            views = [node for node, why in missing.items() if not why]
            return {**values, "views": views, "no_views": {node: why for node, why in missing.items() if why}}
        return values

    async def _relocalize(self, request: Request) -> Mapping[str, Any]:
        body = await read_body(request, (*IMAGE, FORM), self._patience)
        content_type, query = request.headers.get("Content-Type", ""), dict(request.query_params)
        photo = await run_in_threadpool(read_photo, content_type, body, query)
        optics = dict(photo.optics)
        plan = await run_in_threadpool(self._plan, optics.pop("plan", None))
        photo = replace(photo, optics=optics)
        photo.check()
        ticket = hash(photo.data)
        answer = await self._result(lambda: self._server.locate(photo.view, ticket))
        return json_values(answer if plan is None else answer_on_plan(answer, plan))

    async def _result(self, ask: Callable[[], Future[Any]], patience: float | None = None) -> Any:
        """Ask on a thread, since in lock-step the asking thread does the work; then wait for the answer."""
        async with asyncio.timeout(self._patience if patience is None else patience):
            return await asyncio.wrap_future(await run_in_threadpool(ask))


def _asker(request: Request) -> str:
    """The person whose questions are counted."""
    return request.scope[PERSON].name or address_of(request)


def _author(request: Request) -> str:
    """Who gives a mission: the person who has logged in, without keys the one that the request names."""
    return request.scope[PERSON].name or request.query_params.get("by", BY)


def _because(request: Request) -> str:
    """Why a robot is stopped; cut where it is too long, since a stop stops whatever is said with it."""
    words = request.query_params.get("because", "").strip()
    return "".join(c if c.isprintable() else " " for c in words)[:MAX_BECAUSE]


async def _no_such(request: Request, error: Exception) -> Response:
    status = error.status_code if isinstance(error, HTTPException) else HTTPStatus.INTERNAL_SERVER_ERROR
    if status == HTTPStatus.METHOD_NOT_ALLOWED and request.url.path in METHODS:
        return refusal(status, f"use {METHODS[request.url.path]} for {request.url.path}")
    return refusal(status, f"there are {', '.join(f'{method} {path}' for path, method in METHODS.items())}")

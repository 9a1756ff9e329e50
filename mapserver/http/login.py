"""Who asks over HTTP, and what that one may do: the identities and roles of the router.

Without keys there is no login: this machine may do everything, other machines that a proxy lets in only read.
With keys a token is needed: scripts send it with each request (`Authorization: Bearer`), people once, for a
session in a cookie that pages cannot read and that pages of other sites cannot send.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any

import msgspec
from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection, Request
from starlette.responses import Response
from starlette.routing import Route

from mapweave.hybridmap.errors import InvalidValue
from mapweave.identities.logins import Login, Logins
from mapweave.mapserver.http.body import JSON, read_body
from mapweave.mapserver.http.reply import JsonLine
from mapweave.mapserver.http.request_site import is_loopback
from mapweave.mapserver.http.sessions import LIFE, FailedAttempts, Sessions
from mapweave.wire.access_rules import COMMANDS, may_ask
from mapweave.wire.conversion import json_value
from mapweave.wire.credentials import Role

log = logging.getLogger(__name__)

LONGEST_LOGIN = 1024
"""Of the body of a login, bytes."""
PUBLIC = ""
"""In place of a question: it needs no login."""
READ_ONLY = (
    "This is a map file, which is only shown. In a shell, mapweave map link, retire and others write a "
    "corrected copy."
)
PERSON = "mapweave.person"
"""In the scope of a request: who asks."""


@dataclass(frozen=True, slots=True)
class Person:
    """Who asks.

    Attributes:
        name: of the identity; empty without keys.
        role: what it may do.
        login: by which this is known; None without keys.
        session: secret of the session; empty without one.
    """

    name: str
    role: Role
    login: Login | None = None
    session: str = ""


class _Posted(msgspec.Struct, forbid_unknown_fields=True):
    token: str


class RequestAuthorization:
    """Decides what each HTTP request may do. Used by the server's thread alone."""

    def __init__(self, logins: Logins | None, patience: float) -> None:
        """Begin without sessions.

        Args:
            logins: of the fleet's members; None on a fleet without keys.
            patience: time limit for a body, s.
        """
        self._logins, self._patience = logins, patience
        self._sessions = Sessions()
        # Apart, so that a script with an old token does not keep its neighbour from logging in.
        self._failed_logins, self._failed_tokens = FailedAttempts(), FailedAttempts()

    def person(self, connection: HTTPConnection) -> Person:
        """Who asks.

        Raises:
            HTTPException: 401 without a good login, 403 if a page of another site may be asking, 429 after
                too many attempts.
        """
        if self._logins is None:
            return Person("", Role.OPERATOR if is_loopback(address_of(connection)) else Role.VIEWER)
        given = connection.headers.get("Authorization")
        if given is not None:
            scheme, _, token = given.partition(" ")
            if scheme.lower() != "bearer":
                raise _unauthorized("only Authorization: Bearer TOKEN is known here")
            login = self._checked(connection, token.strip(), self._failed_tokens)
            return Person(login.name, login.role, login)
        secret = connection.cookies.get(_cookie(connection), "")
        session = self._sessions.find(secret)
        if session is None or not self._logins.good(session):
            self._sessions.end(secret)
            raise _unauthorized("log in: send Authorization: Bearer TOKEN, see `mapweave keys token`")
        reads = connection.scope["type"] == "http" and connection.scope["method"] in ("GET", "HEAD")
        # That it is this server's own is checked before, see SameSite.
        if not reads and "Origin" not in connection.headers:
            words = "a session is for pages of this server: send Authorization: Bearer TOKEN instead"
            raise HTTPException(HTTPStatus.FORBIDDEN, words)
        return Person(session.name, session.role, session, secret)

    def check(self, connection: HTTPConnection, question: str) -> Person:
        """Who asks, and may ask this.

        Args:
            connection: a request, or a WebSocket that is to be opened.
            question: as at the router, see `mapweave.wire.access_rules.ASKS`.

        Raises:
            HTTPException: see `person`; 403 if the role may not.
        """
        person = self.person(connection)
        if question not in may_ask(person.role):
            raise HTTPException(HTTPStatus.FORBIDDEN, why_not(person, question))
        return person

    def holds(self, person: Person) -> bool:
        """Whether someone who was let in is still: not logged out, nor revoked."""
        if person.login is None or self._logins is None:
            return True
        return self._logins.good(person.login) and (
            not person.session or self._sessions.find(person.session) is not None
        )

    def described(self, person: Person, read_only: bool) -> Mapping[str, Any]:
        """What a page shows of who asks."""
        why = READ_ONLY if read_only else why_not(person, "mission")
        return {
            "name": person.name, "role": str(person.role) if person.name else "", "read_only": read_only,
            "commands": not why, "why_not": why,
        }  # fmt: skip

    def routes(self, read_only: Callable[[], bool], guarded: Guard) -> list[Route]:
        """Routes of logging in and out.

        Args:
            read_only: whether the server takes no commands at all.
            guarded: makes an endpoint of an answer, with its refusals.
        """

        async def session(request: Request) -> Mapping[str, Any]:
            return self.described(self.person(request), read_only())

        async def login(request: Request) -> Response:
            return self._log_in(request, await read_body(request, JSON, self._patience, LONGEST_LOGIN))

        async def logout(request: Request) -> Response:
            return self._log_out(request)

        return [
            Route("/session", guarded(session, PUBLIC), methods=["GET"]),
            Route("/login", guarded(login, PUBLIC), methods=["POST"]),
            Route("/logout", guarded(logout, PUBLIC), methods=["POST"]),
        ]

    def _log_in(self, request: Request, body: bytes) -> Response:
        if self._logins is None:
            raise InvalidValue("this server has no keys, and needs no login")
        try:
            token = json_value(body, _Posted).token.strip()
        except (msgspec.MsgspecError, UnicodeDecodeError):
            raise InvalidValue('send JSON: {"token": "mapweave_..."}') from None
        login = self._checked(request, token, self._failed_logins)
        log.info("%s %s logs in from %s", login.role, login.name, address_of(request))
        reply = JsonLine({"name": login.name, "role": str(login.role)})
        reply.set_cookie(
            _cookie(request), self._sessions.begin(login), max_age=int(LIFE), path="/",
            secure=_secure(request), httponly=True, samesite="strict",
        )  # fmt: skip
        return reply

    def _log_out(self, request: Request) -> Response:
        name = _cookie(request)
        secret = request.cookies.get(name, "")
        login = self._sessions.find(secret)
        if login is not None:
            # Who can end a session is its page alone.
            self.person(request)
            self._sessions.end(secret)
            log.info("%s %s logs out", login.role, login.name)
        reply = JsonLine({"said": "logged out"})
        reply.delete_cookie(name, path="/", secure=_secure(request), httponly=True, samesite="strict")
        return reply

    def _checked(self, connection: HTTPConnection, token: str, failures: FailedAttempts) -> Login:
        """Whose token it is; too many bad ones of an address are not looked at for a while."""
        assert self._logins is not None
        address = address_of(connection)
        if wait := failures.wait(address):
            raise HTTPException(
                HTTPStatus.TOO_MANY_REQUESTS,
                f"too many failed logins from {address}: try again in {math.ceil(wait)} s",
                {"Retry-After": str(math.ceil(wait))},
            )
        login = self._logins.login(token)
        if login is None:
            failures.add(address)
            log.warning("refused: a token at http from %s is unknown, revoked or expired", address)
            raise _unauthorized("this token is unknown, revoked or expired: `mapweave keys list` tells")
        return login


Guard = Callable[
    [Callable[[Request], Awaitable[Mapping[str, Any] | Response]], str],
    Callable[[Request], Awaitable[Response]],
]


def why_not(person: Person, question: str) -> str:
    """Why someone may not ask this; empty if that one may."""
    if question in may_ask(person.role):
        return ""
    if not person.name:
        return "Missions and corrections come from the server's own machine alone, until the server has keys."
    if question in COMMANDS:
        return f"You are {person.name}, a {person.role}: missions and corrections need an operator."
    return f"You are {person.name}, a {person.role}, which may not ask for {question}."


def _unauthorized(words: str) -> HTTPException:
    return HTTPException(HTTPStatus.UNAUTHORIZED, words, {"WWW-Authenticate": "Bearer"})


def address_of(connection: HTTPConnection) -> str:
    """The address of the client, or, behind a proxy on this machine, of the one for which that asks."""
    return "" if connection.client is None else connection.client.host[:64]


def _secure(connection: HTTPConnection) -> bool:
    return connection.scope["scheme"] in ("https", "wss")


def _cookie(connection: HTTPConnection) -> str:
    """Name of the cookie: two servers on one machine share its cookies, whatever their ports."""
    port = (connection.scope.get("server") or ("", 0))[1]
    return f"{'__Host-' if _secure(connection) else ''}mapweave-{port}"

"""A server that refuses what pages of other sites ask."""

from collections.abc import Iterable
from http import HTTPStatus

from starlette.datastructures import Headers
from starlette.responses import Response
from starlette.types import ASGIApp, Receive, Scope, Send

from mapweave.hybridmap.errors import InvalidValue
from mapweave.mapserver.http.request_site import check_part, check_site, own_names
from mapweave.mapserver.http.serving import json_bytes


class SameSite:
    """An application that refuses what pages of other sites ask."""

    def __init__(self, app: ASGIApp, listens_at: str, hosts: Iterable[str] = ()) -> None:
        """Wrap an application.

        Args:
            app: answers everything else.
            listens_at: host at which the server listens.
            hosts: further names of the server.
        """
        self._app = app
        self._names = own_names(listens_at) | {host.lower() for host in hosts}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, or refuse."""
        headers = Headers(scope=scope)
        answer, encrypted = self._app, scope["scheme"] in ("https", "wss")
        try:
            check_site(headers.get("Host"), headers.get("Origin"), self._names, encrypted)
            check_part(headers.get("Sec-Fetch-Site"), headers.get("Sec-Fetch-Dest"))
        except InvalidValue as error:
            content = json_bytes({"error": str(error)})
            answer = Response(content, HTTPStatus.FORBIDDEN, media_type="application/json")
        await answer(scope, receive, send)

"""Metrics over HTTP on this machine alone, refused to pages of other sites as the map server's are."""

import threading
from collections.abc import Callable, Iterable
from typing import Any
from wsgiref.simple_server import WSGIRequestHandler, make_server

from prometheus_client import CollectorRegistry, make_wsgi_app
from prometheus_client.exposition import ThreadingWSGIServer

from mapweave.hybridmap.errors import InvalidValue
from mapweave.mapserver.http.request_site import check_part, check_site, own_names

HOST = "127.0.0.1"
"""This machine alone: there are no logins here, and no encryption."""
PATIENCE = 10.0
"""s that a connection may be silent, or take nothing of its answer."""


def serve_metrics(port: int, registry: CollectorRegistry) -> Callable[[], None]:
    """Answer on a port of this machine, on threads of its own; returns what ends that.

    Raises:
        OSError: the port is taken, or not for this user.
    """
    server = make_server(HOST, port, _own_pages_alone(make_wsgi_app(registry)), _Server, _Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()

    def close() -> None:
        server.shutdown()
        server.server_close()
        thread.join()

    return close


class _Server(ThreadingWSGIServer):
    """A thread for each connection."""

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Log nothing of connections that break or stand still."""


class _Handler(WSGIRequestHandler):
    """Reads one request."""

    timeout = PATIENCE

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing: a request is nothing that a person needs to know."""


def _own_pages_alone(app: Callable[..., Iterable[bytes]]) -> Callable[..., Iterable[bytes]]:
    """An application that refuses what pages of other sites ask."""
    names = own_names(HOST)

    def checked(environ: dict[str, Any], start_response: Callable[..., Any]) -> Iterable[bytes]:
        header = environ.get
        try:
            check_site(header("HTTP_HOST"), header("HTTP_ORIGIN"), names)
            check_part(header("HTTP_SEC_FETCH_SITE"), header("HTTP_SEC_FETCH_DEST"))
        except InvalidValue as error:
            start_response("403 Forbidden", [("Content-Type", "text/plain; charset=utf-8")])
            return [f"{error}\n".encode()]
        return app(environ, start_response)

    return checked

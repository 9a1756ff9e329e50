"""What tests of the HTTP server ask it with."""

import http.client
import json
import socket
from email.message import Message

from mapweave.mapserver.http.web import Web
from tests.mapserver.stub_services import picture


def ask(
    served: Web, method: str, path: str, body: bytes | None = None, headers: dict[str, str] | None = None
) -> tuple[int, Message, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", served.port, timeout=20)
    kind = "application/json" if body and body.startswith((b"{", b"[")) else "image/png"
    connection.request(method, path, body, {"Content-Type": kind, **(headers or {})})
    reply = connection.getresponse()
    content = reply.read()
    connection.close()
    return reply.status, reply.headers, content


def post(served: Web, query: str = "", body: bytes | None = None, **headers: str) -> tuple[int, dict]:
    status, got, content = ask(served, "POST", f"/relocalize{query}", body or picture(), headers)
    assert got["Content-Type"] == "application/json"
    assert content.endswith(b"\n")
    assert content.count(b"\n") == 1
    return status, json.loads(content)


def raw(served: Web, data: bytes, close: bool = False) -> bytes:
    """Send bytes as they are and read to the end."""
    with socket.create_connection(("127.0.0.1", served.port), timeout=20) as connection:
        connection.sendall(data)
        if close:
            connection.shutdown(socket.SHUT_WR)
        got = b""
        while piece := connection.recv(65536):
            got += piece
    return got

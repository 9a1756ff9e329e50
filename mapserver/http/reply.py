"""Answers as one JSON object on a line, and refusals."""

import asyncio
import math
from collections.abc import Mapping
from http import HTTPStatus
from typing import Any

from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from mapweave.hybridmap.errors import Busy
from mapweave.mapserver.http.serving import LINGER, json_bytes

PATIENCE = 10.0
"""Time limit for a body, and for an answer, s."""
WHOLE = "mapweave.whole"
"""Set in the scope of a request whose body is complete."""


class JsonLine(Response):
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
        if scope["type"] == "websocket":
            await super().__call__(scope, receive, send)
            return
        start = {"type": "http.response.start", "status": self.status_code, "headers": self.raw_headers}
        await send(start)
        await send({"type": "http.response.body", "body": bytes(self.body), "more_body": True})
        if self.status_code >= HTTPStatus.BAD_REQUEST and scope["method"] == "POST" and WHOLE not in scope:
            await _hear_out(scope, receive)
        await send({"type": "http.response.body", "body": b"", "more_body": False})


def refusal(status: int, error: str, headers: Mapping[str, str] | None = None) -> JsonLine:
    """Why there is no answer, on one line."""
    return JsonLine({"error": " ".join(error.split())}, status, headers)


def busy(error: Busy) -> JsonLine:
    """When to ask again."""
    content = {"error": str(error), "retry_after": round(error.retry_after, 2)}
    headers = {"Retry-After": str(math.ceil(error.retry_after))}
    return JsonLine(content, HTTPStatus.SERVICE_UNAVAILABLE, headers)


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

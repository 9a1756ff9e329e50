"""Requests of the W3C WebDriver protocol, which drivers of all browsers speak."""

import http.client
import json
from typing import Any


def ask(port: int, method: str, path: str, body: object = None) -> Any:
    """What the driver at a port of this machine answers.

    Raises:
        OSError: it does not listen yet.
        RuntimeError: it refuses.
    """
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    try:
        connection.request(method, path, None if body is None else json.dumps(body))
        value = json.loads(connection.getresponse().read())["value"]
    finally:
        connection.close()
    if isinstance(value, dict) and "error" in value:
        raise RuntimeError(f"{value['error']}: {value['message']}")
    return value

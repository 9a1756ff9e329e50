"""Why a stream does not open: its server is asked once, for OpenCV does not say."""

import base64
import socket
from http import HTTPStatus
from typing import NamedTuple
from urllib.parse import SplitResult, unquote, urlsplit

PATIENCE = 2.0
"""s for the connection, and for the answer."""
LONGEST_ANSWER = 4096
"""Bytes of the answer that are read; its first lines tell."""
PORTS = {"rtsp": 554, "rtsps": 322, "http": 80, "https": 443, "tcp": None}
"""Of the schemes whose servers are reached by TCP; the last has no usual one."""
ASKED = ("rtsp", "http")
"""The schemes in which a question is put here."""
PLAYER = "does a player show images of this address?"


class StreamRefusal(NamedTuple):
    """What is wrong with the URL of a stream that does not open.

    Attributes:
        words: in words; a question if nothing is.
        may_pass: whether it may open later as it stands: its server is not reached, or not ready, as after a
            power cut. A wrong path or password does not pass.
        login: whether the server refuses the user name and password.
    """

    words: str
    may_pass: bool = False
    login: bool = False


def without_password(source: str) -> str:
    """The source of a camera, as it may stand in a log: `***` for the password in a URL."""
    scheme, mark, rest = source.partition("://")
    place, slash, path = rest.partition("/")
    credentials, at, host = place.rpartition("@")
    user, colon, _ = credentials.partition(":")
    return f"{scheme}{mark}{user}:***{at}{host}{slash}{path}" if mark and colon else source


def refusal(url: str) -> StreamRefusal:
    """What is wrong with the URL of a stream that does not open.

    Never raises. Waits for the server, at most twice `PATIENCE`.
    """
    try:
        parts = urlsplit(url)
        if parts.scheme not in PORTS:
            return StreamRefusal(PLAYER)
        port = parts.port or PORTS[parts.scheme]
        if not parts.hostname or port is None:
            return StreamRefusal("is its address complete, with the port?")
        return _asked(parts, parts.hostname, port)
    except ValueError:
        return StreamRefusal("its address is no URL")


def _asked(parts: SplitResult, host: str, port: int) -> StreamRefusal:
    place = f"{host}:{port}"
    try:
        with socket.create_connection((host, port), PATIENCE) as connection:
            if parts.scheme not in ASKED:
                return StreamRefusal(PLAYER)
            connection.sendall(_question(parts, place))
            answer = connection.recv(LONGEST_ANSWER).decode("latin-1")
    except socket.gaierror:
        return StreamRefusal(f"no computer is known by the name {host}", may_pass=True)
    except ConnectionRefusedError:
        return StreamRefusal(f"no server listens at {place}: start it, or mend the port", may_pass=True)
    except TimeoutError:
        words = f"{place} does not answer: is that computer on, and does its server hang?"
        return StreamRefusal(words, may_pass=True)
    except OSError as error:
        return StreamRefusal(f"{place}: {error.strerror or error}", may_pass=True)
    return _in_words(parts, place, answer)


def _question(parts: SplitResult, place: str) -> bytes:
    """The request that a player would begin with, RTSP's DESCRIBE or HTTP's GET."""
    target = f"{parts.path or '/'}{'?' if parts.query else ''}{parts.query}"
    lines = [f"GET {target} HTTP/1.1", f"Host: {place}"]
    if parts.scheme == "rtsp":
        lines = [f"DESCRIBE rtsp://{place}{target} RTSP/1.0", "CSeq: 1", "Accept: application/sdp"]
    if parts.username is not None:
        secret = f"{unquote(parts.username)}:{unquote(parts.password or '')}"
        lines.append(f"Authorization: Basic {base64.b64encode(secret.encode()).decode()}")
    return "".join(f"{line}\r\n" for line in (*lines, "")).encode()


def _in_words(parts: SplitResult, place: str, answer: str) -> StreamRefusal:
    head = answer.split("\r\n", 1)[0].split(" ", 2)
    if len(head) < 2 or not head[0].startswith(("RTSP/", "HTTP/")):
        return StreamRefusal(f"what listens at {place} does not speak {parts.scheme.upper()}")
    status = int(head[1]) if head[1].isdecimal() else 0
    if status in (HTTPStatus.UNAUTHORIZED, HTTPStatus.FORBIDDEN):
        if parts.username is None:
            address = f"{parts.scheme}://USER:PASSWORD@{place}/..."
            return StreamRefusal(f"{place} asks for a user name and a password: {address}")
        # A digest is not answered here, and the path may be what is wrong.
        digest = "www-authenticate: digest" in answer.lower()
        path = ", or has no such path" if digest else ""
        return StreamRefusal(f"{place} refuses this user name and password{path}", login=True)
    if status == HTTPStatus.NOT_FOUND:
        return StreamRefusal(f"{place} has nothing at {parts.path or '/'}: mend the path")
    if status == HTTPStatus.OK:
        return StreamRefusal(PLAYER)
    busy = status == HTTPStatus.SERVICE_UNAVAILABLE
    return StreamRefusal(f"{place} answers {' '.join(head[1:])}", may_pass=busy)

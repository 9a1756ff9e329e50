"""What comes with a POST: an image as the body itself, or in a form beside what is known of its camera."""

from __future__ import annotations

import json
import tomllib
from email.message import Message
from email.parser import BytesHeaderParser
from typing import Any

from hybridmap.errors import InvalidValue
from mapserver.people.photo import Photo

MOST_PARTS = 32
LONGEST_FIELD = 65536


def read_photo(content_type: str, body: bytes, query: dict[str, str]) -> Photo:
    """Take a POST apart.

    Args:
        content_type: as the header says it. Anything but a form is the image itself.
        body: all of it.
        query: camera values behind the `?`; they come before those in the form.

    Returns:
        The image and what was said about its camera. In a form, the image is the part named `image`, `camera`
        may be a camera.toml or the same as JSON, and any other part is a value of the camera.

    Raises:
        InvalidValue: it is no such form.
    """
    header = Message()
    header["Content-Type"] = content_type or "application/octet-stream"
    if header.get_content_type() != "multipart/form-data":
        return Photo(body, query)
    boundary = header.get_param("boundary")
    if not isinstance(boundary, str) or not 1 <= len(boundary) <= 70 or not boundary.isascii():
        raise InvalidValue("the form has no boundary")
    parts = _parts(body, boundary.encode())
    image = parts.pop("image", None)
    if image is None:
        raise InvalidValue("the form has no part named image")
    optics: dict[str, Any] = _camera(parts.pop("camera")) if "camera" in parts else {}
    for name, value in parts.items():
        optics[name] = _text(name, value)
    return Photo(image, {**optics, **query})


def _parts(body: bytes, boundary: bytes) -> dict[str, bytes]:
    """Contents by name (RFC 7578). Behind each boundary stand headers, an empty line and the content."""
    parts: dict[str, bytes] = {}
    pieces = (b"\r\n" + body).split(b"\r\n--" + boundary)
    if len(pieces) < 3 or not pieces[-1].startswith(b"--"):
        raise InvalidValue("the form is cut off")
    if len(pieces) > MOST_PARTS + 2:
        raise InvalidValue(f"the form has more than {MOST_PARTS} parts")
    for piece in pieces[1:-1]:
        head, found, content = piece.partition(b"\r\n\r\n")
        headers = BytesHeaderParser().parsebytes(head.lstrip(b"\r\n"))
        name = headers.get_param("name", header="content-disposition")
        if not found or not isinstance(name, str):
            raise InvalidValue("a part of the form has no name")
        parts[name] = content
    return parts


def _camera(data: bytes) -> dict[str, Any]:
    text = _text("camera", data)
    try:
        values = json.loads(text) if text.lstrip().startswith("{") else tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise InvalidValue(f"camera is neither TOML nor JSON: {error}") from None
    return dict(values)


def _text(name: str, data: bytes) -> str:
    if len(data) > LONGEST_FIELD:
        raise InvalidValue(f"{name[:40]} is too long")
    return data.decode("utf-8", errors="replace")

"""What comes with a POST: an image as the body itself, or in a form beside what is known of its camera."""

from __future__ import annotations

import json
import re
from email.message import Message
from typing import Any

from hybridmap.errors import InvalidValue
from mapserver.people.photo import Photo

MOST_PARTS = 32
LONGEST_FIELD = 4096
LONGEST_CAMERA = 4096
"""Bytes. A camera.toml has about 200."""
LONGEST_HEAD = 2048
LONGEST_TYPE = 256
NAME = re.compile(rb'(?:^|;)[ \t]*name="?([^";\r\n]{1,64})"?[ \t]*(?=;|$)')
"""Parameter of a part's Content-Disposition, as browsers and curl write it."""


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
    if len(content_type) > LONGEST_TYPE:
        raise InvalidValue("Content-Type is too long")
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
    optics: dict[str, Any] = camera_values(parts.pop("camera")) if "camera" in parts else {}
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
        lines = head[:LONGEST_HEAD].split(b"\r\n") if found else []
        named = [line for line in lines if line.lower().startswith(b"content-disposition:")]
        name = NAME.search(named[0].partition(b";")[2]) if named and len(head) <= LONGEST_HEAD else None
        if name is None:
            raise InvalidValue("a part of the form has no name")
        parts[name[1].decode("utf-8", errors="replace")] = content
    return parts


def camera_values(data: bytes) -> dict[str, Any]:
    """What a camera.toml, or the same as JSON, says of a camera. Both are flat: a name and a value a line.

    Raises:
        InvalidValue: it is too long, or neither.
    """
    if len(data) > LONGEST_CAMERA:
        raise InvalidValue(f"camera has {len(data)} bytes, at most {LONGEST_CAMERA} are read")
    text = data.decode("utf-8", errors="replace").lstrip("\ufeff")
    if text.lstrip().startswith("{"):
        try:
            return dict(json.loads(text))
        except (ValueError, TypeError, RecursionError) as error:
            raise InvalidValue(f"camera is neither TOML nor JSON: {error}") from None
    values: dict[str, Any] = {}
    for line in text.splitlines():
        if words := line.partition("#")[0].strip():
            name, _, value = (word.strip() for word in words.partition("="))
            if not value or not name.isidentifier():
                raise InvalidValue(f"camera is neither TOML nor JSON: {words[:40]!r} is no name = number")
            values[name] = value.removeprefix("[").removesuffix("]").strip(" ,")
    return values


def _text(name: str, data: bytes) -> str:
    if len(data) > LONGEST_FIELD:
        raise InvalidValue(f"{name[:40]} is too long")
    return data.decode("utf-8", errors="replace")

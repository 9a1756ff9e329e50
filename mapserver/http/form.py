"""The content of a POST: an image as the body itself, or in a form with values of its camera."""

import json
import logging
from typing import Any

from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header

from mapweave.hybridmap.errors import InvalidValue
from mapweave.mapserver.http.photo import Photo

# What is wrong with a form is said to who has sent it, and to no log.
logging.getLogger("python_multipart").setLevel(logging.CRITICAL)

MOST_PARTS = 32
"""Of a form. A limit for requests."""
LONGEST_FIELD = 4096
"""Bytes of a field that is text."""
LONGEST_CAMERA = 4096
"""Bytes. A camera.toml has about 200."""
LONGEST_HEADER = 1024
"""Of Content-Type, and each header of a part, bytes."""
MOST_HEADERS = 8
"""Of a part."""


def read_photo(content_type: str, body: bytes, query: dict[str, str]) -> Photo:
    """Take a POST apart.

    Args:
        content_type: of the header. Anything but a form is the image itself.
        body: all of it.
        query: camera values behind the `?`; they come before those in the form.

    Returns:
        The image and the values of its camera. In a form, the image is the part named `image`, `camera`
        may be a camera.toml or the same as JSON, and any other part is a value of the camera.

    Raises:
        InvalidValue: it is no such form.
    """
    parts = form_parts(content_type, body)
    image = parts.pop("image")
    optics: dict[str, Any] = camera_values(parts.pop("camera")) if "camera" in parts else {}
    for name, value in parts.items():
        optics[name] = _text(name, value)
    return Photo(image, {**optics, **query})


def form_parts(content_type: str, body: bytes) -> dict[str, bytes]:
    """The parts of a form by name, among them `image`. A body that is no form is the image itself.

    Raises:
        InvalidValue: it is no such form.
    """
    if len(content_type) > LONGEST_HEADER:
        raise InvalidValue("Content-Type is too long")
    kind, options = parse_options_header(content_type)
    if kind != b"multipart/form-data":
        return {"image": body}
    boundary = options.get(b"boundary", b"")
    if not boundary:
        raise InvalidValue("the form has no boundary")
    parts = _parts(body, boundary)
    if "image" not in parts:
        raise InvalidValue("the form has no part named image")
    return parts


def camera_values(data: bytes) -> dict[str, Any]:
    """The values of a camera.toml, or of the same as JSON. Both are flat: a name and a value a line.

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


class _Parts:
    """Contents by name, as the parser finds them (RFC 7578)."""

    def __init__(self) -> None:
        self.contents: dict[str, bytes] = {}
        self.ended = False
        self._count = 0
        self._name: str | None = None
        self._header, self._value = bytearray(), bytearray()
        self._content = bytearray()

    def begin_part(self) -> None:
        self._count += 1
        if self._count > MOST_PARTS:
            raise InvalidValue(f"the form has more than {MOST_PARTS} parts")
        self._name = None
        self._content = bytearray()

    def begin_header(self) -> None:
        self._header, self._value = bytearray(), bytearray()

    def header_field(self, data: bytes, start: int, end: int) -> None:
        self._header += data[start:end]

    def header_value(self, data: bytes, start: int, end: int) -> None:
        self._value += data[start:end]

    def end_header(self) -> None:
        if self._header.lower() == b"content-disposition":
            name = parse_options_header(bytes(self._value))[1].get(b"name")
            self._name = None if name is None else name.decode("utf-8", errors="replace")

    def data(self, data: bytes, start: int, end: int) -> None:
        self._content += data[start:end]

    def end_part(self) -> None:
        if self._name is None:
            raise InvalidValue("a part of the form has no name")
        self.contents[self._name] = bytes(self._content)

    def end(self) -> None:
        self.ended = True


def _parts(body: bytes, boundary: bytes) -> dict[str, bytes]:
    parts = _Parts()
    try:
        parser = MultipartParser(
            boundary,
            {
                "on_part_begin": parts.begin_part, "on_part_data": parts.data, "on_part_end": parts.end_part,
                "on_header_begin": parts.begin_header, "on_header_field": parts.header_field,
                "on_header_value": parts.header_value, "on_header_end": parts.end_header, "on_end": parts.end,
            },
            max_header_count=MOST_HEADERS,
            max_header_size=LONGEST_HEADER,
        )  # fmt: skip
        parser.write(body)
    except FormParserError as error:
        raise InvalidValue(f"the form is damaged: {error}") from None
    if not parts.ended:
        raise InvalidValue("the form is cut off")
    return parts.contents


def _text(name: str, data: bytes) -> str:
    if len(data) > LONGEST_FIELD:
        raise InvalidValue(f"{name[:40]} is too long")
    return data.decode("utf-8", errors="replace")
